"""What a job is to be, what it is, and what happened to it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from straightpcf.points.errors import StraightPCFError
from straightpcf.points.options import DenoiseOptions
from straightpcf.points.wire.jobs import FINISHED, STATES, JobState, ResultInfo

__all__ = [
    "FINISHED",
    "STATES",
    "Claim",
    "EventKind",
    "JobEvent",
    "JobRecord",
    "JobState",
    "Load",
    "NewJob",
    "ResultInfo",
]

EventKind = Literal["queued", "start", "progress", "preview", "output", "log", "completed"]


@dataclass(frozen=True, kw_only=True)
class NewJob:
    """Describe a job to be; weight: its points, estimated; spool: bytes that its files may come to; digest: of the
    whole request.
    """

    id: str
    owner: str
    folder: str
    name: str | None
    format: str | None
    options: DenoiseOptions
    bytes: int
    weight: int
    spool: int
    digest: str
    idempotency_key: str | None = None
    traceparent: str | None = None


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

    @property
    def may_run_again(self) -> bool:
        """Tell whether it failed of what may be over by now: the same request makes it anew, under the same id."""
        return self.error is not None and self.error.retryable


@dataclass(frozen=True, kw_only=True)
class JobEvent:
    """Hold one thing that happened; seq counts from 1 within the job, which `completed` brings as it ended."""

    seq: int
    kind: EventKind
    data: dict[str, Any]
    at: datetime
    job: JobRecord | None = None


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Hold the right to work on a job: `fence` grows with every claim, and an older one can write nothing.

    That holds for an id, too: a job that has the id of one that was deleted has greater fences.

    deaths: of workers that had the job before.
    """

    record: JobRecord
    fence: int
    deaths: int


@dataclass(frozen=True, kw_only=True)
class Load:
    """Sum up jobs: those that wait or run, their estimated points, and bytes of files.

    bytes: of all that are kept, with what the unfinished ones may come to. coming: of the latter, beside their inputs.
    """

    jobs: int
    points: int
    bytes: int
    coming: int
