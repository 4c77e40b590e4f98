"""A full disk: as SpoolFull, by whatever name a file or SQLite calls it, and what is kept for making room on it."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from straightpcf.points.errors import SpoolFull

__all__ = [
    "DISK_TROUBLES",
    "RESERVE",
    "RESERVE_BYTES",
    "full_disk_as_spool_full",
    "is_full",
    "keep_reserve",
    "release_reserve",
]

# What store and folders raise where their disk is full, gone, read-only or locked for long.
DISK_TROUBLES = (OSError, sqlite3.Error, SpoolFull)
RESERVE = "reserve"
RESERVE_BYTES = 2**18  # SQLite takes 32 KiB to open a file, and some 10 pages to end or delete a job

_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})  # the last: of no file that size (LimitFSIZE, FAT)
_SQLITE_FULL = frozenset({sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_SHMSIZE})  # the latter where it opens a file


@contextmanager
def full_disk_as_spool_full() -> Iterator[None]:
    """Raise SpoolFull where the block fails for want of room."""
    try:
        yield
    except (OSError, sqlite3.Error) as exc:
        if is_full(exc):
            raise SpoolFull("the server's disk is full") from exc
        raise


def is_full(error: OSError | sqlite3.Error) -> bool:
    """Tell whether it came for want of room."""
    if isinstance(error, OSError):
        return error.errno in _FULL
    return getattr(error, "sqlite_errorcode", None) in _SQLITE_FULL


def keep_reserve(data_dir: Path) -> None:
    """Hold a little of the disk, where it has room: on a full one not even a row could be deleted."""
    path = data_dir / RESERVE
    try:
        if not path.exists() or path.stat().st_size < RESERVE_BYTES:
            path.touch(mode=0o600)
            path.write_bytes(os.urandom(RESERVE_BYTES))  # of zeros a file system may keep none
    except OSError:
        path.unlink(missing_ok=True)


def release_reserve(data_dir: Path) -> bool:
    """Give it to what makes room; False if there was none."""
    try:
        (data_dir / RESERVE).unlink()
    except FileNotFoundError:
        return False
    return True
