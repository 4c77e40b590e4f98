"""Open the file that jobs are kept in, with its schema."""

from __future__ import annotations

import errno
import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.resources import files
from pathlib import Path

from straightpcf.points.errors import InvalidOptions
from straightpcf.service.jobs.full_disk import is_full, release_reserve

__all__ = ["OpenedFile", "check_database", "open_database", "transaction"]

SCHEMA_VERSION = 1
_WAL_INDEX_HEAD = 136  # bytes: of the -wal the salts, the pages that are moved and those that are about to be
_BUSY_SECONDS = 30.0  # while it is opened: of several servers that start at once, one upgrades it
_AGAIN_SECONDS = 0.02
# Every upload asks again and again for what is kept, beside the rows of all that has expired. Of a column that may have
# to come first.
_KEPT = "CREATE INDEX IF NOT EXISTS jobs_kept ON jobs (owner, spool) WHERE state <> 'expired'"


class OpenedFile:
    """Remember which files were opened: SQLite goes on writing to those that were deleted or replaced, and it is lost.

    Beside the database its -wal, where the last commits are, and its -shm, by which processes know of each other: they
    are the same for as long as it is open, on a disk where SQLite has them. Close it behind the database: in one
    process a closed descriptor of -shm takes SQLite's locks away.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        wal, shm = (path.with_name(f"{path.name}-{part}") for part in ("wal", "shm"))
        self._opened = {path: path.stat()} | {part: part.stat() for part in (wal, shm) if part.exists()}
        self._shm = os.open(shm, os.O_RDONLY) if shm in self._opened else None
        self._seen = self._look()

    def close(self) -> None:
        """Let go of the descriptor."""
        if self._shm is not None:
            os.close(self._shm)
            self._shm = None

    @property
    def in_place(self) -> bool:
        """Tell whether they are still there, and the database is SQLite's own."""
        return self._lost() is None and not self._is_overwritten()

    def check(self) -> None:
        """Raise OSError if they are not, or the database was overwritten."""
        if (lost := self._lost()) is not None:
            way = "put it back, or restart the server and its jobs are lost" if lost == self._path else "restart it"
            raise OSError(errno.ESTALE, f"deleted or replaced under this server: {way}", str(lost))
        if self._is_overwritten():
            way = "stop it, and only then put there what is to be there"
            raise OSError(errno.ESTALE, f"overwritten under this server: {way}", str(self._path))

    def keep_up(self) -> None:
        """Look behind a transaction of one's own, which may have moved the -wal."""
        with suppress(OSError):  # it is gone: the next check says so
            self._is_overwritten()

    def _lost(self) -> Path | None:
        for path, opened in self._opened.items():
            try:
                is_same = os.path.samestat(path.stat(), opened)
            except OSError:
                return path
            if not is_same:
                return path
        return None

    def _is_overwritten(self) -> bool:
        """Tell whether somebody wrote into the database who moved nothing there from the -wal, as SQLite alone does."""
        moved, written = now = self._look()
        if moved is not None and written != self._seen[1] and moved == self._seen[0]:
            return True
        self._seen = now
        return False

    def _look(self) -> tuple[bytes | None, tuple[int, int]]:
        """Return how far the -wal is moved into the database (sqlite.org/walformat.html), and when that was written.

        None while it is being moved, also where that began between two looks at it: another thread or server may do it.
        """
        before = self._moved()
        stat = self._path.stat()
        return before if before == self._moved() else None, (stat.st_size, stat.st_mtime_ns)

    def _moved(self) -> bytes | None:
        head = b"" if self._shm is None else os.pread(self._shm, _WAL_INDEX_HEAD, 0)
        salts, done, begun = head[32:40], head[96:100], head[128:132]
        return salts + done if head and done == begun else None


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
    _write_ahead(db)
    db.execute("PRAGMA synchronous = FULL")  # what is acknowledged survives a power cut
    db.execute("PRAGMA foreign_keys = ON")
    (version,) = db.execute("PRAGMA user_version").fetchone()
    if version > SCHEMA_VERSION:
        raise InvalidOptions(f"{path} is of schema {version}; this straightpcf is older and knows {SCHEMA_VERSION}")
    db.executescript(files(__package__).joinpath("schema.sql").read_text())
    # Asked before: a full disk has no room for what is there already.
    if version != SCHEMA_VERSION or not {"deaths", "server_deaths", "spool"} <= _columns(db):
        with transaction(db):  # of several servers that start at once, one
            _upgrade(db)
    db.execute(_KEPT)


def _write_ahead(db: sqlite3.Connection) -> None:
    """Let the file have a -wal. Where another server is about to do so to a new one, SQLite itself does not wait."""
    until = time.monotonic() + _BUSY_SECONDS
    while True:
        try:
            db.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as exc:
            if exc.sqlite_errorcode != sqlite3.SQLITE_BUSY or time.monotonic() > until:
                raise
        time.sleep(_AGAIN_SECONDS)


def _columns(db: sqlite3.Connection) -> set[str]:
    return {row["name"] for row in db.execute("PRAGMA table_info(jobs)")}


def _upgrade(db: sqlite3.Connection) -> None:
    columns = _columns(db)
    for deaths in {"deaths", "server_deaths"} - columns:  # the first of before versions were counted
        db.execute(f"ALTER TABLE jobs ADD COLUMN {deaths} INTEGER NOT NULL DEFAULT 0")
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
