"""Open the file that jobs are kept in, with its schema."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.resources import files
from pathlib import Path

from straightpcf.points.errors import InvalidOptions
from straightpcf.service.jobs.full_disk import is_full, release_reserve

__all__ = ["OpenedFile", "check_database", "open_database", "transaction"]

SCHEMA_VERSION = 1
_BUSY_SECONDS = 30.0  # while it is opened: of several servers that start at once, one upgrades it
# Every upload asks again and again for what is kept, beside the rows of all that has expired. Of a column that may have
# to come first.
_KEPT = "CREATE INDEX IF NOT EXISTS jobs_kept ON jobs (owner, spool) WHERE state <> 'expired'"


class OpenedFile:
    """Remember which files were opened: SQLite goes on writing to those that were deleted or replaced, and it is lost.

    Beside the database its -wal, where the last commits are, and its -shm, by which processes know of each other: they
    are the same for as long as it is open, on a disk where SQLite has them.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        parts = [path.with_name(f"{path.name}-{part}") for part in ("wal", "shm")]
        self._opened = {path: path.stat()} | {part: part.stat() for part in parts if part.exists()}

    @property
    def in_place(self) -> bool:
        """Tell whether they are still there."""
        return self._lost() is None

    def check(self) -> None:
        """Raise OSError if they are not."""
        if (lost := self._lost()) is not None:
            way = "put it back, or restart the server and its jobs are lost" if lost == self._path else "restart it"
            raise OSError(errno.ESTALE, f"deleted or replaced under this server: {way}", str(lost))

    def _lost(self) -> Path | None:
        for path, opened in self._opened.items():
            try:
                is_same = os.path.samestat(path.stat(), opened)
            except OSError:
                return path
            if not is_same:
                return path
        return None


def check_database(path: Path) -> None:
    """Raise what would keep the file from being used; reads all of it, so that once a start is enough."""
    db = open_database(path)
    try:
        (fault,) = db.execute("PRAGMA quick_check(1)").fetchone()
    finally:
        db.close()
    if fault != "ok":
        raise sqlite3.DatabaseError(f"{path.name} is damaged: {' '.join(fault.split())}")


def open_database(path: Path) -> sqlite3.Connection:
    """Open or create the file; raises InvalidOptions if a newer straightpcf wrote it, sqlite3.Error if it is none.

    On a full disk it takes the reserve beside it.
    """
    try:
        return _open(path)
    except sqlite3.Error as exc:
        if not (is_full(exc) and release_reserve(path.parent)):
            raise
        return _open(path)


def _open(path: Path) -> sqlite3.Connection:
    with suppress(OSError):  # SQLite says it better
        os.close(os.open(path, os.O_CREAT | os.O_RDWR, 0o600))  # names of files and keys: for nobody else
    db = sqlite3.connect(path, timeout=_BUSY_SECONDS, isolation_level=None, check_same_thread=False)
    try:
        _prepare(db, path)
    except BaseException:
        db.close()
        raise
    return db


def _prepare(db: sqlite3.Connection, path: Path) -> None:
    db.row_factory = sqlite3.Row
    if db.execute("PRAGMA page_count").fetchone()[0] == 0:  # a file that is there stays as it is
        db.execute("PRAGMA auto_vacuum = INCREMENTAL")
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("PRAGMA synchronous = FULL")  # what is acknowledged survives a power cut
    db.execute("PRAGMA foreign_keys = ON")
    (version,) = db.execute("PRAGMA user_version").fetchone()
    if version > SCHEMA_VERSION:
        raise InvalidOptions(f"{path} is of schema {version}; this straightpcf is older and knows {SCHEMA_VERSION}")
    db.executescript(files(__package__).joinpath("schema.sql").read_text())
    # Asked before: a full disk has no room for what is there already.
    if version != SCHEMA_VERSION or not {"deaths", "spool"} <= _columns(db):
        with transaction(db):  # of several servers that start at once, one
            _upgrade(db)
    db.execute(_KEPT)


def _columns(db: sqlite3.Connection) -> set[str]:
    return {row["name"] for row in db.execute("PRAGMA table_info(jobs)")}


def _upgrade(db: sqlite3.Connection) -> None:
    columns = _columns(db)
    if "deaths" not in columns:  # before versions were counted
        db.execute("ALTER TABLE jobs ADD COLUMN deaths INTEGER NOT NULL DEFAULT 0")
    if "spool" not in columns:  # likewise
        db.execute("ALTER TABLE jobs ADD COLUMN spool INTEGER NOT NULL DEFAULT 0")
        db.execute("UPDATE jobs SET spool = bytes + IFNULL(json_extract(result, '$.bytes'), 0)")
    db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


@contextmanager
def transaction(db: sqlite3.Connection) -> Iterator[None]:
    """Make what the block does one transaction, from its beginning on the only one that writes."""
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
        db.execute("COMMIT")
    except BaseException:
        if db.in_transaction:  # a full disk may have ended it
            db.execute("ROLLBACK")
        raise
