"""What the engine needs of a backend: take a file, give a file, say how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from straightpcf.points.errors import StraightPCFError
from straightpcf.points.options import DenoiseOptions

__all__ = ["Backend", "FileJob", "FileReport"]


@dataclass(frozen=True, kw_only=True)
class FileJob:
    """Ask for one file to be denoised into another; files cross the process boundary, arrays never do.

    name: the file name the user gave, None to recognise the format from the content.
    format: the name of the output format, None for that of the input.
    """

    id: str
    source: Path
    target: Path
    options: DenoiseOptions
    max_points: int
    name: str | None = None
    format: str | None = None


@dataclass(frozen=True, kw_only=True)
class FileReport:
    """Tell what was done; noise_before and noise_after are in the cloud's own unit."""

    format: str
    points: int
    untouched: int
    iterations: int
    noise_before: float
    noise_after: float
    seconds: float
    warnings: tuple[str, ...] = ()


class Backend(Protocol):
    """Compute jobs somewhere else than on the event loop.

    failure: why no job can ever run here (a device that is missing), None while there is hope.
    """

    @property
    def devices(self) -> tuple[str, ...]:
        """Name the devices that have finished a warm-up and take jobs."""

    @property
    def failure(self) -> StraightPCFError | None:
        """Say why no job will ever run here."""

    async def start(self) -> None:
        """Begin to start workers; returns before they are warm."""

    async def stop(self) -> None:
        """End every worker."""

    async def run(
        self, job: FileJob, *, on_start: Callable[[], None], on_progress: Callable[[float], None]
    ) -> FileReport:
        """Wait for a worker and run the job; raises StraightPCFError.

        Cancelling the awaiting task cancels the work; the call returns once the worker has let go.
        """
