"""The JSON bodies of the REST API."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer

import straightpcf
from straightpcf.points.formats import FORMATS
from straightpcf.points.options import DECIMAL, MAX_ITERATIONS
from straightpcf.service.engine import Engine
from straightpcf.service.jobs.record import JobRecord, JobState

__all__ = [
    "MAX_WAIT_SECONDS",
    "Decimal",
    "FormatInfo",
    "Health",
    "Info",
    "Job",
    "JobPage",
    "Problem",
    "Report",
    "rfc3339",
]

MAX_WAIT_SECONDS = 60  # for one request about a job

_ID = "8b1e6f0a5d9c4c2f9a53d8f6f3f6a2d1"


def rfc3339(at: datetime) -> str:
    """Write a time of the store as the API does: UTC, milliseconds."""
    return at.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _decimal(value: object) -> object:
    if isinstance(value, str) and not DECIMAL.fullmatch(value):  # older FastAPI has defaults checked, too: no text
        raise ValueError("it must be a decimal number")
    return value


Decimal = BeforeValidator(_decimal)  # of a number in a query: as of the options, 1_0 is none
Time = Annotated[datetime, PlainSerializer(rfc3339, return_type=str)]


class Problem(BaseModel):
    """Say what went wrong (RFC 9457)."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    retryable: bool
    request_id: str

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "type": "urn:straightpcf:error:malformed_file",
                "title": "Unprocessable Entity",
                "status": 422,
                "detail": "the header promises 100 vertices, the file ends after 42",
                "code": "malformed_file",
                "retryable": False,
                "request_id": _ID,
            }
        }
    )


class JobOptions(BaseModel):
    """Say what was asked for."""

    iterations: int | Literal["auto"]
    seed: int
    strength: float
    normals: Literal["keep", "recompute"]


class JobError(BaseModel):
    """Say why a job failed."""

    code: str
    detail: str
    retryable: bool


class JobResult(BaseModel):
    """Describe the result file; sha256 in hex."""

    bytes: int
    sha256: str
    media_type: str
    filename: str
    format: str


class Displacement(BaseModel):
    """Say how far the points moved, in the cloud's unit."""

    p50: float
    p90: float
    p99: float
    max: float
    mean: float


class Timings(BaseModel):
    """Say where the time went, in seconds."""

    read: float
    filter: float
    write: float


class Report(BaseModel):
    """Say what was done to a cloud; noise in its own unit, null where it is unknown."""

    format: str
    points: int
    untouched: int
    iterations: int
    noise_before: float | None
    noise_after: float | None
    distances: list[float]
    displacement: Displacement
    seconds: float
    timings: Timings
    device: str
    warnings: list[str]


class Links(BaseModel):
    """Name where a job's parts are."""

    self: str
    events: str
    result: str
    stream: str
    report: str
    cancel: str


class Job(BaseModel):
    """Show one job."""

    id: str
    state: JobState
    name: str | None
    format: str | None
    options: JobOptions
    bytes: int
    points: int | None
    progress: float
    attempts: int
    position: int | None
    created_at: Time
    started_at: Time | None
    finished_at: Time | None
    expires_at: Time | None
    error: JobError | None
    result: JobResult | None
    report: Report | None
    links: Links

    @classmethod
    def of(cls, record: JobRecord, *, root: str = "") -> Job:
        """Render a job of the store; root: the path under which clients find the server, of the ASGI scope."""
        at = f"{root}/jobs/{record.id}"
        plain = ("id", "state", "name", "format", "bytes", "points", "progress", "attempts", "position", "created_at",
                 "started_at", "finished_at", "expires_at")  # fmt: skip
        error, result = record.error, record.result
        return cls(
            **{name: getattr(record, name) for name in plain},
            options=JobOptions.model_validate(record.options, from_attributes=True),
            error=None if error is None else JobError(code=error.code, detail=error.message, retryable=error.retryable),
            result=None if result is None else JobResult.model_validate(result, from_attributes=True),
            report=None if record.report is None else Report.model_validate(record.report),
            links=Links(
                self=at, events=f"{at}/events", result=f"{at}/result", stream=f"{at}/stream", report=f"{at}/report",
                cancel=f"{at}/cancel",
            ),
        )  # fmt: skip

    def plain(self) -> dict[str, Any]:
        """Return what JSON can hold."""
        return self.model_dump(mode="json")

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": _ID,
                "state": "processing",
                "name": "scan.ply",
                "format": None,
                "options": {"iterations": "auto", "seed": 0, "strength": 1.0, "normals": "keep"},
                "bytes": 600_212,
                "points": None,
                "progress": 0.42,
                "attempts": 1,
                "position": None,
                "created_at": "2026-11-21T12:00:00.000Z",
                "started_at": "2026-11-21T12:00:00.120Z",
                "finished_at": None,
                "expires_at": None,
                "error": None,
                "result": None,
                "report": None,
                "links": {
                    part: f"/jobs/{_ID}" + ("" if part == "self" else f"/{part}")
                    for part in ("self", "events", "result", "stream", "report", "cancel")
                },
            }
        }
    )


class JobPage(BaseModel):
    """Show some jobs, newest first; next_cursor asks for those behind them, null at the end."""

    jobs: list[Job]
    next_cursor: str | None


class Health(BaseModel):
    """Say how the server is."""

    status: str
    ready: bool

    model_config = ConfigDict(json_schema_extra={"example": {"status": "ok", "ready": True}})


class FormatInfo(BaseModel):
    """Describe one file format."""

    name: str
    suffixes: list[str]
    media_type: str


class Info(BaseModel):
    """Say what this server is and takes."""

    version: str
    model: str
    weights: str
    devices: list[str]
    max_bytes: int
    max_points: int
    max_jobs: int
    max_queued_points: int
    max_iterations: int
    max_sync_seconds: float
    result_ttl_seconds: float
    formats: list[FormatInfo]

    @classmethod
    def of(cls, engine: Engine, *, weights: str) -> Info:
        """Describe a server."""
        names = ("max_bytes", "max_points", "max_jobs", "max_queued_points", "max_sync_seconds", "result_ttl_seconds")
        return cls(
            version=straightpcf.__version__,
            model="StraightPCF",
            weights=weights,
            devices=list(engine.backend.devices),
            max_iterations=MAX_ITERATIONS,
            **{name: getattr(engine.limits, name) for name in names},
            formats=[
                FormatInfo(name=format.name, suffixes=list(format.suffixes), media_type=format.media_type)
                for format in FORMATS
            ],
        )
