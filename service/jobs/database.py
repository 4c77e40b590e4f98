"""Open the file that jobs are kept in, with its schema."""

from __future__ import annotations

import sqlite3
from importlib.resources import files
from pathlib import Path

from straightpcf.points.errors import InvalidOptions

__all__ = ["open_database"]

SCHEMA_VERSION = 1
_BUSY_SECONDS = 30.0


def open_database(path: Path) -> sqlite3.Connection:
    """Open or create the file; raises InvalidOptions if a newer straightpcf wrote it, sqlite3.Error if it is none."""
    db = sqlite3.connect(path, timeout=_BUSY_SECONDS, isolation_level=None, check_same_thread=False)
    db.row_factory = sqlite3.Row
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("PRAGMA synchronous = FULL")  # what is acknowledged survives a power cut
    db.execute("PRAGMA foreign_keys = ON")
    (version,) = db.execute("PRAGMA user_version").fetchone()
    if version > SCHEMA_VERSION:
        raise InvalidOptions(f"{path} is of schema {version}; this straightpcf is older and knows {SCHEMA_VERSION}")
    db.executescript(files(__package__).joinpath("schema.sql").read_text())
    columns = {row["name"] for row in db.execute("PRAGMA table_info(jobs)")}
    if "deaths" not in columns:  # before versions were counted
        db.execute("ALTER TABLE jobs ADD COLUMN deaths INTEGER NOT NULL DEFAULT 0")
    if "spool" not in columns:  # likewise
        db.execute("ALTER TABLE jobs ADD COLUMN spool INTEGER NOT NULL DEFAULT 0")
        db.execute("UPDATE jobs SET spool = bytes + IFNULL(json_extract(result, '$.bytes'), 0)")
    db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    return db
