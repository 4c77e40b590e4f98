"""What the commands share: an error that a user can mend is one line, a level of noise a number, a device here."""

from __future__ import annotations

import argparse
import math

from straightpcf.model.train.command import (
    device,
    errors_in_one_line,
    file_to_write,
    noise_level,
    positive,
    seed_number,
)

__all__ = [
    "coverage",
    "device",
    "errors_in_one_line",
    "file_to_write",
    "noise_level",
    "positive",
    "seed_number",
    "share_of_two",
]


def coverage(text: str) -> float:
    """Read how many patches a point is to have, for argparse, within what the filter takes."""
    value = float(text)
    if not 1 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is no coverage, which is 1 or more")
    return value


def share_of_two(text: str) -> float:
    """Read the share of one of two, for argparse: a mean of weights with NaN would be written as weights."""
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} is no share, which is 0 to 1")
    return value
