"""The one core behind every transport: limits, admission, running, events. Knows no HTTP."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from straightpcf.points.errors import JobCanceled, ServerBusy, TooManyBytes
from straightpcf.points.formats import format_named
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.backends.base import Backend, FileJob, FileReport

__all__ = ["Engine", "Event", "Job", "Limits"]


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Bound what is taken; the fields are those of `Settings`."""

    max_bytes: int
    max_points: int
    max_jobs: int
    max_wait_seconds: float

    def check_bytes(self, size: int) -> None:
        """Raise TooManyBytes above the limit."""
        if size > self.max_bytes:
            raise TooManyBytes(f"the body has {size} bytes or more; this server takes {self.max_bytes}")


@dataclass(frozen=True, kw_only=True)
class Event:
    """Tell one thing that happened to a job; progress is the share that is done, 0..1."""

    kind: Literal["queued", "start", "progress", "completed"]
    progress: float = 0.0


class Job:
    """Hold one accepted job: its events while it runs, its report or its error at the end."""

    def __init__(self, job: FileJob) -> None:
        self.id = job.id
        self._events: list[Event] = []
        self._news = asyncio.Event()
        self._task: asyncio.Task[FileReport]
        self._publish(Event(kind="queued"))

    async def result(self) -> FileReport:
        """Wait for the end; raises StraightPCFError, JobCanceled among them. Ceasing to wait cancels nothing."""
        await asyncio.wait([self._task])
        if self._task.cancelled():
            raise JobCanceled(f"job {self.id} was canceled")
        return self._task.result()

    async def cancel(self) -> None:
        """Drop the job, whatever its state; returns once nothing works on it any more."""
        self._task.cancel()
        await asyncio.wait([self._task])

    async def events(self) -> AsyncIterator[Event]:
        """Yield what happened so far and what happens next, until the job ends."""
        seen = 0
        while True:
            news = self._news
            for event in self._events[seen:]:
                seen += 1
                yield event
            if self._task.done() and seen == len(self._events):
                return
            await news.wait()

    def _publish(self, event: Event) -> None:
        self._events.append(event)
        self._wake()

    def _wake(self) -> None:
        self._news, old = asyncio.Event(), self._news
        old.set()

    def _on_progress(self, fraction: float) -> None:
        if fraction - self._events[-1].progress >= 0.01:  # the log of a job stays short
            self._publish(Event(kind="progress", progress=fraction))


class Engine:
    """Admit jobs up to the limits and run them on a backend."""

    def __init__(self, backend: Backend, *, limits: Limits) -> None:
        self.backend = backend
        self.limits = limits
        self._jobs: set[Job] = set()

    @property
    def ready(self) -> bool:
        """Tell whether a job that is submitted now finds a warm worker."""
        return bool(self.backend.devices)

    async def start(self) -> None:
        """Begin to start the backend; `ready` tells when it is."""
        await self.backend.start()

    async def stop(self) -> None:
        """Cancel what still runs and end the backend."""
        await asyncio.gather(*(job.cancel() for job in self._jobs))
        await self.backend.stop()

    def check_room(self) -> None:
        """Raise ServerBusy if a job would not be admitted now, the backend's failure if none ever will."""
        if self.backend.failure is not None:
            raise self.backend.failure
        if len(self._jobs) >= self.limits.max_jobs:
            raise ServerBusy(f"{len(self._jobs)} jobs are waiting or running; this server holds {self.limits.max_jobs}")

    def submit(
        self, source: Path, target: Path, *, options: DenoiseOptions, name: str | None = None, format: str | None = None
    ) -> Job:
        """Admit one file at once or raise: ServerBusy, TooManyBytes, UnknownFormat, or the backend's failure."""
        self.check_room()
        self.limits.check_bytes(source.stat().st_size)
        if format is not None:
            format_named(format)  # raises before anything waits
        file_job = FileJob(
            id=uuid.uuid4().hex,
            source=source,
            target=target,
            options=options,
            max_points=self.limits.max_points,
            name=name,
            format=format,
        )
        job = Job(file_job)
        self._jobs.add(job)
        job._task = asyncio.create_task(self._run(file_job, job), name=f"job-{job.id}")
        job._task.add_done_callback(lambda task: self._close(job, task))
        return job

    async def _run(self, file_job: FileJob, job: Job) -> FileReport:
        def on_start() -> None:
            waiting.reschedule(None)
            job._publish(Event(kind="start"))

        try:
            async with asyncio.timeout(self.limits.max_wait_seconds) as waiting:
                report = await self.backend.run(file_job, on_start=on_start, on_progress=job._on_progress)
        except TimeoutError as exc:
            raise ServerBusy(f"no worker was free within {self.limits.max_wait_seconds:g} s") from exc
        job._publish(Event(kind="completed", progress=1.0))
        return report

    def _close(self, job: Job, task: asyncio.Task[FileReport]) -> None:
        self._jobs.discard(job)
        if not task.cancelled():
            task.exception()  # seen, even if nobody awaits the result
        job._wake()
