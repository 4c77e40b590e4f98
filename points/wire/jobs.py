"""The words for a job that server and clients share: its id, its states, and what a result file is."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, get_args

__all__ = ["FINISHED", "JOB_ID", "JOB_ID_RULE", "MAX_EVENT_ID", "MAX_PAGE_SIZE", "STATES", "JobState", "ResultInfo"]

JOB_ID, JOB_ID_RULE = re.compile(r"(?!\.)[A-Za-z0-9._-]{1,64}"), "1 to 64 of A-Z a-z 0-9 . _ -, no dot first"
MAX_PAGE_SIZE = 200  # jobs of a list at once
MAX_EVENT_ID = 999_999_999  # that a client may have seen

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
