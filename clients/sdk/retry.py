"""Decide whether to try again, and when: the same for the sync and the async client."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from straightpcf.points.errors import StraightPCFError

__all__ = [
    "FIRST_DELAY_SECONDS",
    "MAX_DELAY_SECONDS",
    "MAX_RETRIES",
    "MAX_RETRY_AFTER_SECONDS",
    "Failure",
    "next_delay",
]

MAX_RETRIES = 4
FIRST_DELAY_SECONDS = 0.5
MAX_DELAY_SECONDS = 8.0
MAX_RETRY_AFTER_SECONDS = 60.0
JITTER = 0.25


@dataclass(frozen=True, kw_only=True)
class Failure:
    """Hold one failed attempt; retry_after is what the server asked for, in seconds, and its error says it, too."""

    error: StraightPCFError
    retryable: bool
    retry_after: float | None = None
    cause: Exception | None = None

    def __post_init__(self) -> None:
        """Tell whoever gets the error, and comes again by itself, when."""
        if self.retry_after is not None and math.isfinite(self.retry_after):
            self.error.retry_after = math.ceil(self.retry_after)


def next_delay(failure: Failure, *, attempt: int, max_retries: int = MAX_RETRIES) -> float | None:
    """Return the seconds to wait after attempt 0, 1, ..., or None to give up."""
    if not failure.retryable or attempt >= max_retries:
        return None
    if failure.retry_after is not None:
        least = FIRST_DELAY_SECONDS if attempt else 0.0  # a proxy may name 0 for as long as its server is away
        return min(max(failure.retry_after, least), MAX_RETRY_AFTER_SECONDS)
    delay = min(FIRST_DELAY_SECONDS * 2.0**attempt, MAX_DELAY_SECONDS)
    return delay * random.uniform(1 - JITTER, 1 + JITTER)  # many clients of one server should not come back together
