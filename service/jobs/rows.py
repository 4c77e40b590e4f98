"""What a row of the store says: a job's as JobRecord, an event's as JobEvent."""

from __future__ import annotations

import json
import sqlite3
from datetime import UTC, datetime

from straightpcf.points.errors import ERRORS_BY_CODE, InternalError, StraightPCFError
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.jobs.record import JobEvent, JobRecord, ResultInfo

__all__ = ["event_of", "record_of"]

_PLAIN = (
    "id", "owner", "folder", "state", "name", "format", "bytes", "points", "progress", "attempts", "traceparent",
)  # fmt: skip


def record_of(row: sqlite3.Row, position: int | None = None) -> JobRecord:
    """Read a job; position: how many are before it, if it is queued."""
    result = None if row["result"] is None else json.loads(row["result"])
    return JobRecord(
        **{name: row[name] for name in _PLAIN},
        position=position,
        options=DenoiseOptions(**json.loads(row["options"])),
        created_at=_time(row["created_at"]),
        started_at=_time_or_none(row["started_at"]),
        finished_at=_time_or_none(row["finished_at"]),
        expires_at=_time_or_none(row["expires_at"]),
        error=None if row["error"] is None else _error(json.loads(row["error"])),
        result=None if result is None else ResultInfo(**{k: v for k, v in result.items() if k != "file"}),
        report=None if row["report"] is None else json.loads(row["report"]),
    )


def event_of(row: sqlite3.Row) -> JobEvent:
    """Read an event."""
    return JobEvent(seq=row["seq"], kind=row["kind"], data=json.loads(row["data"]), at=_time(row["at"]))


def _error(saved: dict[str, str]) -> StraightPCFError:
    return ERRORS_BY_CODE.get(saved["code"], InternalError)(saved["detail"])


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _time_or_none(seconds: float | None) -> datetime | None:
    return None if seconds is None else _time(seconds)
