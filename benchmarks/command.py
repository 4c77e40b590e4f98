"""What the commands share: an error that a user can mend is one line, and a level of noise is a number."""

from __future__ import annotations

import argparse
import math

from straightpcf.model.train.command import errors_in_one_line, file_to_write, positive, seed_number

__all__ = ["errors_in_one_line", "file_to_write", "noise_level", "positive", "seed_number"]


def noise_level(text: str) -> float:
    """Read a level of noise, for argparse: NaN would run for minutes and measure nothing."""
    value = float(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is no level of noise, which is 0 or more")
    return value
