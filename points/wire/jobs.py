"""The words for a job that server and clients share: its states, and what a result file is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

__all__ = ["FINISHED", "STATES", "JobState", "ResultInfo"]

JobState = Literal["queued", "starting", "processing", "succeeded", "failed", "canceled", "expired"]
STATES: tuple[JobState, ...] = get_args(JobState)
FINISHED: frozenset[JobState] = frozenset({"succeeded", "failed", "canceled", "expired"})


@dataclass(frozen=True, kw_only=True)
class ResultInfo:
    """Describe a result file; sha256 in hex."""

    bytes: int
    sha256: str
    media_type: str
    filename: str
    format: str
