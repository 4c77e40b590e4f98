"""The durable store: one SQLite file in WAL mode; every method is one transaction.

Calls block, so the engine makes them on a thread of their own. Several servers may share the file: a job is worked on
by whoever holds its lease, and a write with an older fence changes nothing. Leases go by the machine's own clock, for
its date may be set while a job runs; those of before it was started belong to servers that are dead.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

from straightpcf.points.errors import (
    IdConflict,
    IdempotencyConflict,
    InternalError,
    InvalidRequest,
    NotFound,
    StraightPCFError,
)
from straightpcf.service.jobs.database import open_database, transaction
from straightpcf.service.jobs.record import (
    FINISHED,
    STATES,
    Claim,
    EventKind,
    JobEvent,
    JobRecord,
    JobState,
    Load,
    NewJob,
    ResultInfo,
)
from straightpcf.service.jobs.rows import event_of, record_of
from straightpcf.service.jobs.turns import BY_STATE, count_turn, next_row, positions

__all__ = ["BATCH", "MAX_SERVER_DEATHS", "SHRINK_PAGES", "JobStore"]

# What is done to all that is over at once: everything else waits for a transaction, also at other servers.
BATCH, SHRINK_PAGES = 200, 250
MAX_SERVER_DEATHS = 6  # more than the runner's MAX_DEATHS of workers, for servers die of much else
_ACTIVE: tuple[JobState, ...] = ("queued", "starting", "processing")
_WORKING: tuple[JobState, ...] = ("starting", "processing")
_USUAL: tuple[JobState, ...] = ("succeeded", "expired")  # what nearly all rows are
_RELEASED = "state = 'queued', server = NULL, lease_until = NULL, progress = 0"
_ENDED: tuple[JobState, ...] = tuple(sorted(FINISHED - {"expired"}))
_DETAIL = 1000  # characters of what a job failed of that are kept: what a file says may be in it
_PASSING: tuple[EventKind, ...] = ("preview", "progress")
Hold = Literal["held", "canceled", "lost"]
_FENCES = 2**32  # of one row: those of rows are apart, so that no fence comes back with an id that is used again


class JobStore:
    """Keep jobs and their events; use from one thread.

    bytes_of: how large the files in a folder are, asked at its job's end.
    """

    def __init__(self, path: Path, bytes_of: Callable[[str], int] = lambda folder: 0) -> None:
        self._db, self._bytes_of = open_database(path), bytes_of

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def wait_for_locks(self, seconds: float) -> None:
        """Let the next method wait at most so long for other processes."""
        self._db.execute(f"PRAGMA busy_timeout = {int(1000 * seconds)}")

    def empty_wal(self) -> None:
        """Move what is in the -wal into the database: what is written next takes its place, and no more of the disk."""
        self._db.execute("PRAGMA wal_checkpoint")

    # --- what clients ask for

    def create(self, job: NewJob) -> tuple[JobRecord, bool]:
        """Commit a queued job and return it with True, or the one that the same request made before with False.

        That one is made anew if it may run again. Raises IdempotencyConflict, IdConflict where another request has
        the key or the id.
        """
        with self._transaction():
            if (known := self._known(job)) is not None:
                record = self._record(known)
                if not record.may_run_again:
                    return record, False
                self._db.execute("DELETE FROM jobs WHERE seq = ?", (known["seq"],))
                job = replace(job, id=record.id)
            self._db.execute(
                "INSERT INTO jobs (id, owner, folder, state, name, format, options, bytes, weight, spool, created_at,"
                " traceparent, idempotency_key, digest) VALUES (?, ?, ?, 'queued', ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (job.id, job.owner, job.folder, job.name, job.format, json.dumps(asdict(job.options)), job.bytes,
                 job.weight, job.spool, time.time(), job.traceparent, job.idempotency_key, job.digest),
            )  # fmt: skip
            record = self._record(self._row(job.id))
            self._add_event(job.id, "queued", {"position": record.position})
            return record, True

    def match(self, job: NewJob) -> JobRecord | None:
        """Return what the same request made before; raises like `create`."""
        row = self._known(job)
        return None if row is None else self._record(row)

    def has(self, owner: str, *, id: str | None, idempotency_key: str | None) -> bool:
        """Tell whether a job of this owner has the id or the key."""
        query = "SELECT 1 FROM jobs WHERE owner = ? AND (id = ? OR idempotency_key = ?)"
        return self._db.execute(query, (owner, id, idempotency_key)).fetchone() is not None

    def get(self, id: str, owner: str | None = None) -> JobRecord:
        """Return a job; raises NotFound, also for a job of another owner."""
        return self._record(self._row(id, owner))

    def look(self, id: str, owner: str) -> JobRecord:
        """Do as `get`, but for the position, which takes a count of all that waits: for who looks again and again."""
        return record_of(self._row(id, owner))

    def page(
        self, *, owner: str, states: Collection[JobState] = (), limit: int = 50, cursor: str | None = None
    ) -> tuple[list[JobRecord], str | None]:
        """Return a page, newest first, and the cursor of the next one; raises InvalidRequest on a broken cursor."""
        if unknown := set(states) - set(STATES):
            raise InvalidRequest(f"state is {min(unknown)[:40]!r}; it must be one of {', '.join(STATES)}")
        states = set(states)  # SQLite takes only so many values
        where, values = [f"{BY_STATE if states and states.isdisjoint(_USUAL) else 'owner'} = ?"], [owner]
        if states:
            where.append(f"state IN ({', '.join('?' * len(states))})")
            values += states
        if cursor is not None:
            if not cursor.isascii() or not cursor.isdigit() or len(cursor) > 18:
                raise InvalidRequest(f"cursor is {cursor[:40]!r}; it must be the next_cursor of a page")
            where.append("seq < ?")
            values.append(cursor)
        query = f"SELECT * FROM jobs WHERE {' AND '.join(where)} ORDER BY seq DESC LIMIT ?"
        rows = self._db.execute(query, [*values, limit + 1]).fetchall()
        more = len(rows) > limit
        queued = positions(self._db, owner, [row["seq"] for row in rows if row["state"] == "queued"])
        records = [record_of(row, queued.get(row["seq"])) for row in rows[:limit]]
        return records, str(rows[limit - 1]["seq"]) if more else None

    def events(self, folder: str, after: int = 0) -> list[JobEvent]:
        """Return what happened to the job of a folder behind event `after`: its id may be another's by now."""
        query = "SELECT e.* FROM events e JOIN jobs j ON e.job = j.seq WHERE j.folder = ? AND e.seq > ? ORDER BY e.seq"
        return [event_of(row) for row in self._db.execute(query, (folder, after))]

    def request_cancel(self, id: str, folder: str, *, expires_in: float) -> None:
        """Cancel a queued job at once; mark one that is worked on, for its server to see; NotFound if it is another."""
        with self._transaction():
            row = self._same_row(id, folder)
            if row["state"] == "queued":
                self._end(id, "canceled", error=_canceled(id), expires_in=expires_in)
            elif row["state"] in _WORKING:
                self._db.execute("UPDATE jobs SET cancel_requested = 1 WHERE id = ?", (id,))

    def delete(self, id: str, folder: str) -> None:
        """Remove a job and its events, not another of its id; the fence of whoever works on it is void from now on."""
        with self._transaction():
            self._db.execute("DELETE FROM jobs WHERE id = ? AND folder = ?", (id, folder))

    def load(self, owner: str | None = None) -> Load:
        """Sum up what waits and runs and what is kept, for one owner or for all."""
        where, values = ("", []) if owner is None else ("AND owner = ?", [owner])
        active = where.replace("owner", BY_STATE)
        query = f"SELECT COUNT(*), TOTAL(weight), TOTAL(spool - bytes) FROM jobs WHERE state IN {_ACTIVE} {active}"
        jobs, points, coming = self._db.execute(query, values).fetchone()
        query = f"SELECT TOTAL(spool) FROM jobs WHERE state <> 'expired' {where}"
        (kept,) = self._db.execute(query, values).fetchone()
        return Load(jobs=jobs, points=int(points), bytes=int(kept), coming=int(coming))

    def counts(self) -> dict[str, int]:
        """Count jobs by state."""
        return dict(self._db.execute("SELECT state, COUNT(*) FROM jobs GROUP BY state").fetchall())

    # --- what the server that works on jobs asks for

    def claim(self, server: str, lease_seconds: float) -> Claim | None:
        """Take the queued job whose turn it is, or none."""
        with self._transaction():
            row = self._db.execute(
                f"UPDATE jobs SET state = 'starting', fence = MAX(fence + 1, seq * {_FENCES}), server = ?,"
                " attempts = attempts + 1, lease_until = ?, started_at = IFNULL(started_at, ?), progress = 0"
                " WHERE seq = ? RETURNING *",
                (server, time.monotonic() + lease_seconds, time.time(), next_row(self._db)),
            ).fetchone()
            if row is None:
                return None
            count_turn(self._db, row["owner"])
            return Claim(record=record_of(row), fence=row["fence"], deaths=row["deaths"])

    def extend(self, held: Sequence[tuple[str, int]], lease_seconds: float) -> list[Hold]:
        """Renew leases, given as ids and fences; say of each whether it holds, "canceled" if its job should be."""
        holds: list[Hold] = []
        with self._transaction():
            until = time.monotonic() + lease_seconds  # of now: it may have waited for others' locks
            for id, fence in held:
                mine = self._update(id, fence, "lease_until = ?", until)
                holds.append("lost" if not mine else "canceled" if self._row(id)["cancel_requested"] else "held")
        return holds

    def begin(self, id: str, fence: int, *, device: str) -> bool:
        """Tell that a worker has begun; False if the fence is old."""
        with self._transaction():
            mine = self._update(id, fence, "state = 'processing'")
            if mine:
                self._add_event(id, "start", {"attempt": self._row(id)["attempts"], "device": device})
            return mine

    def note(
        self, id: str, fence: int, kind: EventKind, data: dict[str, Any], *, progress: float | None = None
    ) -> bool:
        """Add an event of a running job, and how far it is by then; False if the fence is old."""
        with self._transaction():
            mine = self._update(id, fence, "progress = IFNULL(?, progress)", progress)
            if mine:
                self._add_event(id, kind, data)
            return mine

    def succeed(
        self, id: str, fence: int, *, result: ResultInfo, report: dict[str, Any], file: str, expires_in: float
    ) -> bool:
        """Deliver: from this commit on, and not before, the result `file` in the job's folder is the result."""
        with self._transaction():
            kept = json.dumps({**asdict(result), "file": file})
            set_ = "progress = 1, points = ?, result = ?, report = ?"
            if not self._update(id, fence, set_, report["points"], kept, json.dumps(report)):
                return False
            said = {key: asdict(result)[key] for key in ("bytes", "sha256", "filename", "media_type")}
            for message in report.get("warnings", ()):
                self._add_event(id, "log", {"level": "warning", "message": message})
            self._add_event(id, "output", said)
            self._end(id, "succeeded", expires_in=expires_in)
            return True

    def fail(self, id: str, fence: int, error: StraightPCFError, *, expires_in: float) -> bool:
        """End a job that cannot succeed, or was canceled while it ran."""
        with self._transaction():
            if not self._update(id, fence, "progress = progress"):
                return False
            state: JobState = "canceled" if error.code == "job_canceled" else "failed"
            self._end(id, state, error={"code": error.code, "detail": error.message[:_DETAIL]}, expires_in=expires_in)
            return True

    def release(self, id: str, fence: int, message: str, *, expires_in: float, died: bool = False) -> bool:
        """Put a job back into its place in the queue, or end it if it is to be canceled.

        died: it killed its worker, as far as one can tell.
        """
        with self._transaction():
            mine = self._update(id, fence, f"{_RELEASED}, deaths = deaths + ?", int(died))
            if mine:
                self._requeued(id, message, expires_in)
            return mine

    def recover(self, dead_servers: Collection[str] = (), *, expires_in: float) -> list[str]:
        """Release the jobs whose lease ran out, or whose server is known to be dead; return their ids.

        One under which MAX_SERVER_DEATHS servers died fails: where a cloud asks for more memory than a container may
        have, and all of that is killed for it (Kubernetes), it would be begun for ever, and no other job.
        """
        with self._transaction():
            rows = self._db.execute(
                "SELECT id, server, server_deaths, cancel_requested FROM jobs"
                f" WHERE state IN {_WORKING} AND (lease_until < ? OR server IN ({', '.join('?' * len(dead_servers))}))",
                (time.monotonic(), *dead_servers),
            ).fetchall()
            for row in rows:
                deaths = row["server_deaths"] + (row["server"] in dead_servers)
                if deaths >= MAX_SERVER_DEATHS and not row["cancel_requested"]:
                    self._end(row["id"], "failed", error=_given_up(deaths), expires_in=expires_in)
                    continue
                set_ = f"{_RELEASED}, fence = fence + 1, server_deaths = ?"
                self._db.execute(f"UPDATE jobs SET {set_} WHERE id = ?", (deaths, row["id"]))
                self._requeued(row["id"], "nobody works on it any more; the job starts again", expires_in)
        return [row["id"] for row in rows]

    def over(self, behind: int = 0) -> list[str]:
        """Name folders of what is over its time, and not marked so: BATCH behind the first ones; writes nothing."""
        query = f"SELECT folder FROM jobs WHERE state IN {_ENDED} AND expires_at < ? LIMIT {BATCH} OFFSET ?"
        return [row["folder"] for row in self._db.execute(query, (time.time(), behind))]

    def expire(self) -> list[str]:
        """Mark BATCH jobs that are over their time, or those that there are; return the folders to remove.

        What a job showed on its way goes with its files: previews are a hundred times its row.
        """
        with self._transaction():
            over = f"SELECT seq FROM jobs WHERE state IN {_ENDED} AND expires_at < ? LIMIT {BATCH}"
            query = f"UPDATE jobs SET state = 'expired' WHERE seq IN ({over}) RETURNING seq, folder"
            expired = self._db.execute(query, (time.time(),)).fetchall()
            query = f"DELETE FROM events WHERE job = ? AND kind IN {_PASSING}"
            self._db.executemany(query, [(row["seq"],) for row in expired])
        return [row["folder"] for row in expired]

    def forget(self, *, rows_after: float) -> int:
        """Remove BATCH rows that have been over their time for rows_after seconds; return how many there were."""
        with self._transaction():
            old = f"SELECT seq FROM jobs WHERE state = 'expired' AND expires_at < ? LIMIT {BATCH}"
            return self._db.execute(f"DELETE FROM jobs WHERE seq IN ({old})", (time.time() - rows_after,)).rowcount

    def shrink(self) -> bool:
        """Give room back that the database does not need, SHRINK_PAGES at a time; tell whether there may be more."""
        with suppress(sqlite3.OperationalError):  # a full disk, or others are at it: the next time will do
            before = self._free_pages()
            # `execute` takes one step, which frees one page.
            self._db.executescript(f"PRAGMA incremental_vacuum({SHRINK_PAGES})")
            return 0 < self._free_pages() < before  # of a file of before room was given back none is
        return False

    def servers(self) -> set[str]:
        """Name the servers that hold jobs."""
        return {name for (name,) in self._db.execute(f"SELECT DISTINCT server FROM jobs WHERE state IN {_WORKING}")}

    def unknown(self, folders: Collection[str]) -> list[str]:
        """Return those folders that no job owns."""
        query = "SELECT 1 FROM jobs WHERE folder = ? AND state <> 'expired'"
        return [folder for folder in folders if self._db.execute(query, (folder,)).fetchone() is None]

    def result_file(self, id: str, folder: str) -> str:
        """Name the result file inside the folder of a job that succeeded; NotFound if its id is another's by now."""
        return str(json.loads(self._same_row(id, folder)["result"])["file"])

    # --- inside a transaction

    def _transaction(self) -> AbstractContextManager[None]:
        return transaction(self._db)

    def _free_pages(self) -> int:
        return int(self._db.execute("PRAGMA freelist_count").fetchone()[0])

    def _known(self, job: NewJob) -> sqlite3.Row | None:
        if job.idempotency_key is not None:
            query = "SELECT * FROM jobs WHERE owner = ? AND idempotency_key = ?"
            row = self._db.execute(query, (job.owner, job.idempotency_key)).fetchone()
            if row is not None and row["digest"] != job.digest:
                raise IdempotencyConflict(
                    f"idempotency key {job.idempotency_key[:40]!r} came with another request before"
                )
            if row is not None:
                return row  # type: ignore[no-any-return]
        row = self._db.execute("SELECT * FROM jobs WHERE id = ?", (job.id,)).fetchone()
        if row is not None and (row["digest"] != job.digest or row["owner"] != job.owner):
            raise IdConflict(f"job id {job.id!r} is taken by another request")
        return row  # type: ignore[no-any-return]

    def _row(self, id: str, owner: str | None = None) -> sqlite3.Row:
        row = self._db.execute("SELECT * FROM jobs WHERE id = ?", (id,)).fetchone()
        if row is None or (owner is not None and row["owner"] != owner):
            raise NotFound(f"there is no job {id[:64]!r}")
        return row  # type: ignore[no-any-return]

    def _same_row(self, id: str, folder: str) -> sqlite3.Row:
        if (row := self._row(id))["folder"] != folder:
            raise NotFound(f"there is no job {id[:64]!r} any more; another has its id")
        return row

    def _update(self, id: str, fence: int, set_: str, *values: object) -> bool:
        query = f"UPDATE jobs SET {set_} WHERE id = ? AND fence = ? AND state IN {_WORKING}"
        return self._db.execute(query, (*values, id, fence)).rowcount == 1

    def _end(self, id: str, state: JobState, *, error: dict[str, str] | None = None, expires_in: float = 0.0) -> None:
        now = time.time()
        self._db.execute(
            "UPDATE jobs SET state = ?, error = ?, finished_at = ?, expires_at = ?, spool = ?, lease_until = NULL,"
            " server = NULL WHERE id = ?",
            (state, None if error is None else json.dumps(error), now, now + expires_in,
             self._bytes_of(self._row(id)["folder"]), id),
        )  # fmt: skip
        self._add_event(id, "completed", {"state": state})

    def _requeued(self, id: str, message: str, expires_in: float) -> None:
        if self._row(id)["cancel_requested"]:
            self._end(id, "canceled", error=_canceled(id), expires_in=expires_in)
            return
        self._add_event(id, "log", {"level": "warning", "message": message})
        self._add_event(id, "queued", {"position": self._record(self._row(id)).position})

    def _add_event(self, id: str, kind: EventKind, data: dict[str, Any]) -> None:
        self._db.execute(
            "INSERT INTO events SELECT seq, 1 + IFNULL((SELECT MAX(seq) FROM events WHERE job = jobs.seq), 0), ?, ?, ?"
            " FROM jobs WHERE id = ?",
            (kind, json.dumps(data, allow_nan=False), time.time(), id),
        )

    def _record(self, row: sqlite3.Row) -> JobRecord:
        queued = positions(self._db, row["owner"], [row["seq"]] if row["state"] == "queued" else [])
        return record_of(row, queued.get(row["seq"]))


def _given_up(deaths: int) -> dict[str, str]:
    said = f"its server died while it worked on it, {deaths} times; the cloud was then given up"
    return {"code": InternalError.code, "detail": said}


def _canceled(id: str) -> dict[str, str]:
    return {"code": "job_canceled", "detail": f"job {id} was canceled"}
