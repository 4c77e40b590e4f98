"""A run's directory is one process's while it trains: two would write over each other's state and log."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from straightpcf.points.errors import InvalidOptions

__all__ = ["LOCK_FILE", "held"]

LOCK_FILE = "lock"


@contextmanager
def held(run_dir: Path) -> Iterator[None]:
    """Hold a run's directory; the lock dies with its process, and its file, which stays, says nothing by being there.

    Raises InvalidOptions where another run holds it, OSError where nothing can be written there.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    with (run_dir / LOCK_FILE).open("ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as exc:
            if exc.errno == errno.EWOULDBLOCK:
                raise InvalidOptions(f"another training run is at work in {run_dir}: give one of its own") from exc
            # Some network file systems have no locks.
        yield
