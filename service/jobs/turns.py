"""Whose job is next: keys take turns, the one that waited longest first; jobs of one key go in the order they came in.

So one key's thousand jobs delay another's by one. A turn is a job, however large. Turns are kept apart from jobs, which
whoever has a key can delete.
"""

from __future__ import annotations

import sqlite3
from bisect import bisect_left
from collections.abc import Collection

__all__ = ["BY_STATE", "count_turn", "next_row", "positions"]

# The owner, in a query for states that few jobs are in: the + keeps SQLite from looking through all rows of the owner
# instead, most of which are over, at every upload and every look at a job that waits.
BY_STATE = "+owner"
# Who waits, in the order of their turns; `first` says more of those that had none yet alone.
_OWNERS = """
SELECT jobs.owner, COUNT(*) AS waiting, MIN(jobs.seq) AS first FROM jobs LEFT JOIN turns ON turns.owner = jobs.owner
WHERE jobs.state = 'queued' GROUP BY jobs.owner ORDER BY IFNULL(turns.at, 0), first
"""


def next_row(db: sqlite3.Connection) -> int | None:
    """Return the row of the job whose turn it is, if any waits."""
    row = db.execute(f"{_OWNERS} LIMIT 1").fetchone()
    return None if row is None else int(row["first"])


def count_turn(db: sqlite3.Connection, owner: str) -> None:
    """Let all others that wait go before this owner's next job; where nobody else waits, there is nothing to write."""
    db.execute(
        "INSERT INTO turns SELECT ?, 1 + IFNULL(MAX(at), 0) FROM turns"
        " WHERE EXISTS (SELECT 1 FROM jobs WHERE state = 'queued' AND owner != ?)"
        " ON CONFLICT (owner) DO UPDATE SET at = excluded.at",
        (owner, owner),
    )


def positions(db: sqlite3.Connection, owner: str, rows: Collection[int]) -> dict[int, int]:
    """Return how many jobs would be taken before each of these queued ones of an owner, if nothing came in."""
    if not rows:
        return {}
    query = f"SELECT seq FROM jobs WHERE state = 'queued' AND {BY_STATE} = ? ORDER BY seq"
    own = [seq for (seq,) in db.execute(query, (owner,))]
    owners = [(name, waiting) for name, waiting, _ in db.execute(_OWNERS)]
    return {row: _position(bisect_left(own, row), owner, owners) for row in rows}


def _position(own: int, owner: str, owners: list[tuple[str, int]]) -> int:
    """Count what goes before a job that has `own` of its owner's before it; owners: in the order of their turns."""
    names = [name for name, _ in owners]
    turn = names.index(owner) if owner in names else 0  # another server may have taken its last one just now
    return own + sum(min(waiting, own + (at < turn)) for at, (_, waiting) in enumerate(owners) if at != turn)
