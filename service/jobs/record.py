"""What a job is, and what happened to it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from straightpcf.points.errors import StraightPCFError
from straightpcf.points.options import DenoiseOptions
from straightpcf.points.wire.jobs import FINISHED, STATES, JobState, ResultInfo

__all__ = ["FINISHED", "STATES", "Claim", "EventKind", "JobEvent", "JobRecord", "JobState", "ResultInfo"]

EventKind = Literal["queued", "start", "progress", "preview", "output", "log", "completed"]


@dataclass(frozen=True, kw_only=True)
class JobRecord:
    """Hold one job as it is in the store; times in UTC.

    owner: the fingerprint of the key that made it, "" without keys. folder: the name of its folder of files. bytes,
    points: of the input, points None until it has succeeded. attempts: how often a worker took it. position: jobs
    before it while it is queued. error: of a failed or canceled job. report: docs/api.md says what is in it.
    """

    id: str
    owner: str
    folder: str
    state: JobState
    name: str | None
    format: str | None
    options: DenoiseOptions
    bytes: int
    points: int | None
    progress: float
    attempts: int
    position: int | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    expires_at: datetime | None
    error: StraightPCFError | None
    result: ResultInfo | None
    report: dict[str, Any] | None
    traceparent: str | None

    @property
    def finished(self) -> bool:
        """Tell whether nothing more happens to it."""
        return self.state in FINISHED


@dataclass(frozen=True, kw_only=True)
class JobEvent:
    """Hold one thing that happened; seq counts from 1 within the job."""

    seq: int
    kind: EventKind
    data: dict[str, Any]
    at: datetime


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Hold the right to work on a job: `fence` grows with every claim, and an older one can write nothing.

    deaths: of workers that had the job before.
    """

    record: JobRecord
    fence: int
    deaths: int
