"""What happens to a job, as typed values."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from straightpcf.clients.sdk.job_info import JobInfo

__all__ = ["Completed", "Event", "Log", "Output", "Preview", "Progress", "Queued", "Started", "parse_event"]


@dataclass(frozen=True, kw_only=True)
class _Event:
    """Hold one thing that happened; id counts from 1 within the job."""

    kind: ClassVar[str]
    id: int
    json: Mapping[str, Any] = field(repr=False, compare=False)


@dataclass(frozen=True, kw_only=True)
class Queued(_Event):
    """The job waits; position: how many jobs come before it."""

    kind = "queued"
    position: int


@dataclass(frozen=True, kw_only=True)
class Started(_Event):
    """A worker took the job, for the first time or because the worker before died."""

    kind = "start"
    attempt: int
    device: str


@dataclass(frozen=True, kw_only=True)
class Progress(_Event):
    """The job went on; progress: 0..1, iteration: the pass, from 1."""

    kind = "progress"
    progress: float
    iteration: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Preview(_Event):
    """Some points after a pass; indices: (n,) int64 rows of the cloud, xyz: (n, 3) float64, the cloud's unit."""

    kind = "preview"
    iteration: int
    indices: npt.NDArray[np.int64]
    xyz: npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Output(_Event):
    """The result can be fetched; sha256 in hex."""

    kind = "output"
    bytes: int
    sha256: str
    filename: str
    media_type: str


@dataclass(frozen=True, kw_only=True)
class Log(_Event):
    """The server has something to say."""

    kind = "log"
    level: str
    message: str


@dataclass(frozen=True, kw_only=True)
class Completed(_Event):
    """The job is finished, well or not: always the last event."""

    kind = "completed"
    job: JobInfo


Event: TypeAlias = Queued | Started | Progress | Preview | Output | Log | Completed


def parse_event(kind: str, id: str, data: str) -> Event | None:
    """Read one server-sent event; None if a newer server sends what is not known here."""
    number, body = int(id or 0), json.loads(data)
    match kind:
        case "queued":
            return Queued(id=number, json=body, position=body["position"])
        case "start":
            return Started(id=number, json=body, attempt=body["attempt"], device=body["device"])
        case "progress":
            return Progress(id=number, json=body, progress=body["progress"], iteration=body["iteration"])
        case "preview":
            rows, xyz = np.array(body["indices"], np.int64), np.array(body["xyz"], np.float64).reshape(-1, 3)
            return Preview(id=number, json=body, iteration=body["iteration"], indices=rows, xyz=xyz)
        case "output":
            names = ("bytes", "sha256", "filename", "media_type")
            return Output(id=number, json=body, **{name: body[name] for name in names})
        case "log":
            return Log(id=number, json=body, level=body["level"], message=body["message"])
        case "completed":
            return Completed(id=number, json=body, job=JobInfo.parse(body))
    return None
