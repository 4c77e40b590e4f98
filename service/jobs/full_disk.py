"""A full disk, by whatever name a file or SQLite calls it, as SpoolFull."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager

from straightpcf.points.errors import SpoolFull

__all__ = ["full_disk_as_spool_full"]

_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})


@contextmanager
def full_disk_as_spool_full() -> Iterator[None]:
    """Raise SpoolFull where the block fails for want of room."""
    try:
        yield
    except (OSError, sqlite3.Error) as exc:
        if _is_full(exc):
            raise SpoolFull("the server's disk is full") from exc
        raise


def _is_full(error: OSError | sqlite3.Error) -> bool:
    if isinstance(error, OSError):
        return error.errno in _FULL
    return getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL
