"""What each process makes for itself: a connection that a forked one shares with its parent has the answers of both."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Generic, TypeVar

__all__ = ["PerProcess"]

_T = TypeVar("_T")


class PerProcess(Generic[_T]):
    """Hold one thing for each process that asks: it is made at once, and again where this one was forked since."""

    def __init__(self, make: Callable[[], _T]) -> None:
        """Make it, and raise what that raises."""
        self._make = make
        self._made = {os.getpid(): make()}  # those of parents are never touched: a thread of theirs may have had a lock

    def get(self) -> _T:
        """Return this process's own."""
        process = os.getpid()
        if process not in self._made:
            self._made.setdefault(process, self._make())  # of several threads the first one's counts
        return self._made[process]
