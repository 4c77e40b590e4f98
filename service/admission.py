"""What a server takes: limits on one request, on all that waits, on one key, on the disk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from straightpcf.points.errors import QuotaExceeded, ServerBusy, SpoolFull, TooManyBytes
from straightpcf.points.wire.patches import BYTES_PER_POINT
from straightpcf.service.jobs.record import Load

__all__ = ["Limits"]

_CONVERTED_BYTES_PER_POINT = 100  # the most of real scans: 93, an aerial LAS of 34 a point as text
_AUTO_PASSES = 5  # the most that `auto` makes with the shipped weights


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Bound what is taken; the fields are those of `Settings`, which has their defaults."""

    max_bytes: int
    max_points: int
    max_jobs: int
    max_queued_points: int
    max_jobs_per_key: int
    max_spool_bytes: int
    min_free_bytes: int
    max_sync_seconds: float
    upload_idle_seconds: float
    result_ttl_seconds: float
    row_ttl_seconds: float
    shutdown_seconds: float

    def check_bytes(self, size: int) -> None:
        """Raise TooManyBytes above the limit."""
        if size > self.max_bytes:
            raise TooManyBytes(f"the body has {size} bytes or more; this server takes {self.max_bytes}")

    def check_queue(self, load: Load, *, weight: int = 0) -> None:
        """Raise ServerBusy if `weight` more points (estimated) do not fit beside what waits and runs."""
        if load.jobs >= self.max_jobs:
            raise ServerBusy(f"{load.jobs} jobs are waiting or running; this server holds {self.max_jobs}")
        if load.jobs > 0 and load.points + weight > self.max_queued_points:
            raise ServerBusy(
                f"{load.points} points are waiting or running and about {weight} would come; "
                f"this server holds {self.max_queued_points}"
            )

    def check_key(self, load: Load) -> None:
        """Raise QuotaExceeded if a key has as many unfinished jobs as it may."""
        if load.jobs >= self.max_jobs_per_key:
            raise QuotaExceeded(
                f"{load.jobs} jobs of this key are waiting or running; it may have {self.max_jobs_per_key}"
            )

    def spool_bytes(
        self, size: int, *, weight: int = 0, iterations: int | Literal["auto"] = "auto", converted: bool = False
    ) -> int:
        """Say what a job's files may come to: `size` bytes of input, a result as large, patches of `weight` points.

        converted: whether the result's format is another, of which a point may take more.
        """
        passes, points = _AUTO_PASSES if iterations == "auto" else iterations, min(weight, self.max_points)
        result = max(size, points * _CONVERTED_BYTES_PER_POINT) if converted else size
        return size + result + points * passes * BYTES_PER_POINT

    def check_disk(self, load: Load, free_bytes: int, *, spool: int, written: int = 0) -> None:
        """Raise SpoolFull if a job of `spool` bytes does not fit beside those that are kept and are still to come.

        written: those of them that are on the disk already, and no part of its `free_bytes`.
        """
        if load.bytes + spool > self.max_spool_bytes:
            raise SpoolFull(
                f"{load.bytes} bytes of jobs are kept or to come and up to {spool} would be added; "
                f"this server keeps {self.max_spool_bytes}"
            )
        self._check_free(load.coming + spool - written, free_bytes)

    def check_incoming(self, load: Load, free_bytes: int, *, incoming: int) -> None:
        """Raise SpoolFull if uploads on their way in, of `incoming` bytes so far, take what accepted jobs need."""
        if incoming > self.max_spool_bytes:
            raise SpoolFull(f"{incoming} bytes of uploads are coming in; this server keeps {self.max_spool_bytes}")
        self._check_free(load.coming, free_bytes)

    def _check_free(self, coming: int, free_bytes: int) -> None:
        if free_bytes - coming < self.min_free_bytes:
            raise SpoolFull(
                f"the server's disk has {free_bytes} bytes left, of which jobs may take {coming}; "
                f"{self.min_free_bytes} must stay free"
            )
