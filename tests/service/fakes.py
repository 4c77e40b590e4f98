"""A backend that does as it is told, for the engine's and the runner's tests."""

from __future__ import annotations

import asyncio
import hashlib
from dataclasses import replace

from straightpcf.points.errors import StraightPCFError
from straightpcf.service.backends.base import FileJob, FileReport, Listener

CONTENT = b"the result"
REPORT = FileReport(
    format="xyz",
    points=2,
    untouched=0,
    iterations=1,
    noise_before=float("nan"),
    noise_after=0.0,
    distances=(0.5, 0.1),
    displacement={"p50": 0.0, "p90": 0.0, "p99": 0.0, "max": 0.0, "mean": 0.0},
    seconds=0.0,
    timings={"read": 0.0, "filter": 0.0, "write": 0.0},
    device="cpu",
    bytes=len(CONTENT),
    sha256=hashlib.sha256(CONTENT).hexdigest(),
    warnings=("one",),
)


class Deaf:
    """Hear nothing."""

    def on_start(self, device: str) -> None:
        pass

    def on_progress(self, fraction: float, iteration: int) -> None:
        pass

    def on_preview(self, iteration: int, indices: list[int], xyz: list[list[float]]) -> None:
        pass


class ObedientBackend:
    """Start every job once `go` is set and end it, as `outcomes` say or well, once `finish` is set.

    patches: what a job that ends well has written beside its result.
    """

    def __init__(self, *outcomes: Exception) -> None:
        self.devices: tuple[str, ...] = ("cpu",)
        self.slots, self.restarts = 1, 0
        self.failure: StraightPCFError | None = None
        self.outcomes = list(outcomes)
        self.go, self.finish = asyncio.Event(), asyncio.Event()
        self.patches = b""
        self.runs: list[FileJob] = []
        self.canceled: list[str] = []

    async def start(self) -> None:
        pass

    async def stop(self) -> None:
        pass

    async def wait_idle(self) -> None:
        await self.go.wait()

    async def run(self, job: FileJob, listener: Listener) -> FileReport:
        self.runs.append(job)
        try:
            listener.on_start("cpu")
            listener.on_progress(0.5, 1)
            listener.on_progress(0.501, 1)  # too little to tell
            await self.finish.wait()
        except asyncio.CancelledError:
            self.canceled.append(job.id)
            raise
        if self.outcomes:
            raise self.outcomes.pop(0)
        job.target.write_bytes(CONTENT)
        if job.patches is not None:
            job.patches.write_bytes(self.patches)
        return REPORT


class Large(ObedientBackend):
    """Give results that fill what a connection takes before they are read."""

    async def run(self, job: FileJob, listener: Listener) -> FileReport:
        report = await super().run(job, listener)
        job.target.write_bytes(content := bytes(30 << 20))
        return replace(report, bytes=len(content), sha256=hashlib.sha256(content).hexdigest())
