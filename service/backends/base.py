"""What the engine needs of a backend: take a file, give a file, say how far it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from straightpcf.points.errors import StraightPCFError
from straightpcf.points.options import DenoiseOptions

__all__ = ["Backend", "FileJob", "FileReport", "FilesUnusable", "Listener", "WorkerDied"]


@dataclass(frozen=True, kw_only=True)
class FileJob:
    """Ask for one file to be denoised into another; files cross the process boundary, arrays never do.

    name: the file name the user gave, None to recognise the format from the content.
    format: the name of the output format, None for that of the input.
    patches: where finished patches go, as the patch stream of docs/api.md; None for nowhere.
    """

    id: str
    source: Path
    target: Path
    options: DenoiseOptions
    max_points: int
    name: str | None = None
    format: str | None = None
    patches: Path | None = None


@dataclass(frozen=True, kw_only=True)
class FileReport:
    """Tell what was done.

    noise_before, noise_after: estimated std in the cloud's own unit, NaN if unknown. distances: the DistanceModule's
    median before each pass and after the last. displacement: "p50", "p90", "p99", "max", "mean" of how far the
    points moved, in the cloud's unit. seconds: in all; timings: "read", "filter", "write". bytes, sha256: of the
    target file.
    """

    format: str
    points: int
    untouched: int
    iterations: int
    noise_before: float
    noise_after: float
    distances: tuple[float, ...]
    displacement: Mapping[str, float]
    seconds: float
    timings: Mapping[str, float]
    device: str
    bytes: int
    sha256: str
    warnings: tuple[str, ...] = ()


class WorkerDied(Exception):  # noqa: N818 - an event, never shown to a user
    """Report a worker that ended without an answer (killed, out of memory, a crash in native code)."""


class FilesUnusable(Exception):  # noqa: N818 - likewise
    """Report a worker that could not read or write a job's files (a disk that fails, is gone or read-only)."""


class Listener(Protocol):
    """Hear of one job while it runs; called on the event loop, must not block."""

    def on_start(self, device: str) -> None:
        """A worker has the job."""

    def on_progress(self, fraction: float, iteration: int) -> None:
        """The share that is done, 0..1, in pass `iteration` (0: reading)."""

    def on_preview(self, iteration: int, indices: list[int], xyz: list[list[float]]) -> None:
        """Where a few points are after a pass."""


class Backend(Protocol):
    """Compute jobs somewhere else than on the event loop.

    failure: why no job can ever run here (a device that is missing), None while there is hope.
    """

    @property
    def devices(self) -> tuple[str, ...]:
        """Name the devices that have finished a warm-up and take jobs."""

    @property
    def slots(self) -> int:
        """Say how many jobs run at once when every worker is warm."""

    @property
    def restarts(self) -> int:
        """Count the workers that died and were replaced."""

    @property
    def failure(self) -> StraightPCFError | None:
        """Say why no job will ever run here."""

    async def start(self) -> None:
        """Begin to start workers; returns before they are warm."""

    async def stop(self) -> None:
        """End every worker."""

    async def wait_idle(self) -> None:
        """Return as soon as a worker is warm and free; raises `failure`."""

    async def run(self, job: FileJob, listener: Listener) -> FileReport:
        """Wait for a worker and run the job once; raises StraightPCFError, WorkerDied, FilesUnusable.

        Cancelling the awaiting task cancels the work; the call returns within a second, when nothing works on it.
        """
