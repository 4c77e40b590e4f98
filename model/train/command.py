"""What the commands that make training data share: an error that a user can mend is one line, before the work."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from straightpcf.model.filter import device_named
from straightpcf.points.errors import DeviceUnavailable, StraightPCFError

__all__ = [
    "archive_to_write",
    "device",
    "errors_in_one_line",
    "file_to_write",
    "noise_level",
    "positive",
    "positive_number",
    "seed_number",
]


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """End in one line where a file is missing or is not what it should be."""
    try:
        yield
    except (OSError, StraightPCFError) as error:
        raise SystemExit(str(error)) from error


def archive_to_write(text: str) -> Path:
    """Read the name of an archive, for argparse: what cannot be written is found out before the minutes of work."""
    if not text.endswith(".npz"):
        raise argparse.ArgumentTypeError(f"{text} is no name for an archive, which ends in .npz")
    return file_to_write(text)


def device(text: str) -> str:
    """Read a device, for argparse, as the filter does: one that is not here is found out before the work."""
    try:
        return device_named(text)
    except DeviceUnavailable as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def file_to_write(text: str) -> Path:
    """Read the name of a file, for argparse, as `archive_to_write` does."""
    path = Path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{text} is a folder")
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{path.parent} is no folder to write {path.name} to")
    return path


def noise_level(text: str) -> float:
    """Read a level of noise, for argparse: NaN would run for minutes and measure nothing."""
    value = float(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is no level of noise, which is 0 or more")
    return value


def positive(text: str) -> int:
    """Read a whole number of 1 or more, for argparse."""
    return _whole(text, 1)


def positive_number(text: str) -> float:
    """Read a finite number above 0, for argparse."""
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is no number above 0")
    return value


def seed_number(text: str) -> int:
    """Read a seed, for argparse."""
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"{text} is no whole number of {least} or more")
    return value
