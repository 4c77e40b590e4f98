"""What a server says of a job, as typed values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from straightpcf.points.errors import ERRORS_BY_CODE, InternalError, JobCanceled, JobExpired, StraightPCFError
from straightpcf.points.options import DenoiseOptions
from straightpcf.points.wire.jobs import FINISHED, STATES, JobState, ResultInfo

__all__ = ["FINISHED", "STATES", "JobInfo", "JobState", "Report", "ResultInfo"]


@dataclass(frozen=True, kw_only=True)
class Report:
    """Tell what was done to a cloud; lengths in its own unit, NaN if unknown.

    untouched: points that were NaN, infinite, meant "no data" or lay apart from all others, and passed through.
    distances: the DistanceModule's median before each pass and after the last. displacement: "p50", "p90", "p99",
    "max", "mean" of how far points moved. timings: seconds of "read", "filter", "write".
    """

    points: int
    untouched: int
    iterations: int
    noise_before: float
    noise_after: float
    distances: tuple[float, ...]
    displacement: Mapping[str, float]
    seconds: float
    timings: Mapping[str, float]
    warnings: tuple[str, ...]
    format: str
    device: str

    @classmethod
    def parse(cls, body: Mapping[str, Any]) -> Report:
        """Read the JSON form; what a newer server adds is left out."""
        values = _known(cls, body)
        for name in ("noise_before", "noise_after"):
            values[name] = float("nan") if values[name] is None else values[name]
        return cls(**values | {name: tuple(values[name]) for name in ("distances", "warnings")})


@dataclass(frozen=True, kw_only=True)
class JobInfo:
    """Hold a job as it was when the server was asked; docs/api.md says what the fields mean.

    error: of a failed job, as the class that its code names. json: the server's own words.
    """

    id: str
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
    report: Report | None
    json: Mapping[str, Any] = field(repr=False, compare=False)

    def __hash__(self) -> int:
        """Hash the id: a report's mappings and an error have no hash of their own."""
        return hash(self.id)

    @property
    def finished(self) -> bool:
        """Tell whether nothing more happens to it."""
        return self.state in FINISHED

    @property
    def failure(self) -> StraightPCFError | None:
        """Say why there is no result and never will be; None while there is one, or hope."""
        if self.error is not None:
            return self.error
        if self.state == "canceled":
            return JobCanceled(f"job {self.id} was canceled")
        return JobExpired(f"the files of job {self.id} were removed") if self.state == "expired" else None

    @classmethod
    def parse(cls, body: Mapping[str, Any]) -> JobInfo:
        """Read the JSON form; what a newer server adds is left out."""
        values = _known(cls, body)
        for name in ("created_at", "started_at", "finished_at", "expires_at"):
            values[name] = None if values[name] is None else datetime.fromisoformat(values[name])
        options, error, result, report = (values[name] for name in ("options", "error", "result", "report"))
        return cls(
            **values
            | {
                "options": DenoiseOptions(**_known(DenoiseOptions, options)),
                "error": None if error is None else _error(error),
                "result": None if result is None else ResultInfo(**_known(ResultInfo, result)),
                "report": None if report is None else Report.parse(report),
            },
            json=body,
        )


def _known(kind: type[Any], body: Mapping[str, Any]) -> dict[str, Any]:
    return {item.name: body[item.name] for item in dataclasses.fields(kind) if item.name in body}


def _error(body: Mapping[str, Any]) -> StraightPCFError:
    return ERRORS_BY_CODE.get(body["code"], InternalError)(body["detail"])
