"""What the commands share: an error that a user can mend is one line, and a level of noise is a number."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager

from straightpcf.points.errors import StraightPCFError

__all__ = ["errors_in_one_line", "noise_level"]


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """End in one line where a file is missing or is not what it should be."""
    try:
        yield
    except (OSError, StraightPCFError) as error:
        raise SystemExit(str(error)) from error


def noise_level(text: str) -> float:
    """Read a level of noise, for argparse: NaN would run for minutes and measure nothing."""
    value = float(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is no level of noise, which is 0 or more")
    return value
