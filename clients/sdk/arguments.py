"""Arguments that are not of their kind: said by name, before anything is sent."""

from __future__ import annotations

import inspect
import math
import os
from numbers import Integral, Real
from pathlib import Path

from straightpcf.points.errors import InvalidRequest

__all__ = ["check_count", "check_function", "check_path", "check_text", "path_of", "seconds_of", "silence_of"]

_MOST_SECONDS = 10**9  # as of a server's settings: a socket takes no more of what a float can say


def check_text(name: str, value: object) -> None:
    """Raise InvalidRequest where an argument is no text."""
    if not isinstance(value, str):
        raise InvalidRequest(f"{name} is {value!r:.80}; it must be text")


def check_count(name: str, value: object) -> None:
    """Raise InvalidRequest where an argument is no whole number of 0 or more."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 0:
        raise InvalidRequest(f"{name} is {value!r:.80}; it must be a whole number, 0 or more")


def check_function(name: str, value: object) -> None:
    """Raise InvalidRequest where an argument is neither an ordinary function nor None: nothing awaits a coroutine."""
    if value is not None and (not callable(value) or inspect.iscoroutinefunction(value)):
        raise InvalidRequest(f"{name} is {value!r:.80}; it must be an ordinary function, not a coroutine's, or None")


def silence_of(name: str, value: float | None) -> float | None:
    """Return a time that a connection can be silent, or None; raises InvalidRequest where an argument is neither."""
    if value is not None and not (isinstance(value, Real) and 0 < float(value) <= _MOST_SECONDS):
        limit = f"it must be above 0, {_MOST_SECONDS:,} s at most, or None for any"
        raise InvalidRequest(f"{name} is {value!r:.80}; {limit}")
    return None if value is None else float(value)  # sockets take no numbers of numpy


def seconds_of(name: str, value: float | None) -> float | None:
    """Return a number of seconds, which may be over by now, or None; raises InvalidRequest where it is neither."""
    if value is not None and (not isinstance(value, Real) or math.isnan(value)):
        raise InvalidRequest(f"{name} is {value!r:.80}; it must be a number of seconds, or None")
    return None if value is None else float(value)


def check_path(name: str, value: object) -> None:
    """Raise InvalidRequest where an argument is neither a path nor None."""
    if value is not None and not isinstance(value, str | os.PathLike):
        raise InvalidRequest(f"{name} is {value!r:.80}; it must be a path")


def path_of(name: str, value: str | os.PathLike[str] | None) -> Path | None:
    """Return an argument as a path, or None; raises InvalidRequest where it is neither."""
    check_path(name, value)
    return None if value is None else Path(value)
