"""The engine against a backend that does as it is told."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from straightpcf.points.errors import (
    DeviceUnavailable,
    JobCanceled,
    MalformedFile,
    ServerBusy,
    StraightPCFError,
    TooManyBytes,
    UnknownFormat,
)
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.backends.base import FileJob, FileReport
from straightpcf.service.engine import Engine, Job, Limits

REPORT = FileReport(format="npy", points=1, untouched=0, iterations=1, noise_before=0.0, noise_after=0.0, seconds=0.0)


class ObedientBackend:
    """Start every job once `go` is set and end it, with `error` or well, once `finish` is set."""

    def __init__(self) -> None:
        self.devices: tuple[str, ...] = ("cpu",)
        self.failure: StraightPCFError | None = None
        self.error: StraightPCFError | None = None
        self.go, self.finish = asyncio.Event(), asyncio.Event()
        self.canceled: list[str] = []

    async def start(self) -> None:
        pass

    async def stop(self) -> None:
        pass

    async def run(
        self, job: FileJob, *, on_start: Callable[[], None], on_progress: Callable[[float], None]
    ) -> FileReport:
        try:
            await self.go.wait()
            on_start()
            on_progress(0.5)
            on_progress(0.501)  # too little to tell
            await self.finish.wait()
        except asyncio.CancelledError:
            self.canceled.append(job.id)
            raise
        if self.error is not None:
            raise self.error
        return REPORT


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    path = tmp_path / "cloud"
    path.write_bytes(b"0 0 0\n")
    return path


def engine_of(backend: ObedientBackend, *, max_jobs: int = 2, max_wait_seconds: float = 10.0) -> Engine:
    limits = Limits(max_bytes=100, max_points=10, max_jobs=max_jobs, max_wait_seconds=max_wait_seconds)
    return Engine(backend, limits=limits)


def submit(engine: Engine, cloud: Path, *, format: str | None = None) -> Job:
    return engine.submit(cloud, cloud.with_name("result"), options=DenoiseOptions(), format=format)


def test_a_job_tells_its_events_in_order_to_those_who_come_early_and_late(cloud: Path) -> None:
    async def scenario() -> None:
        backend = ObedientBackend()
        job = submit(engine_of(backend), cloud)
        early = asyncio.create_task(_kinds(job))
        await asyncio.sleep(0)
        backend.go.set()
        await asyncio.sleep(0)
        backend.finish.set()
        assert await job.result() == REPORT
        assert await early == await _kinds(job) == ["queued", "start", "progress", "completed"]

    asyncio.run(scenario())


async def _kinds(job: Job) -> list[str]:
    return [event.kind async for event in job.events()]


def test_a_full_engine_refuses_at_once_and_admits_again_when_a_job_ends(cloud: Path) -> None:
    async def scenario() -> None:
        backend = ObedientBackend()
        backend.go.set()
        engine = engine_of(backend, max_jobs=1)
        job = submit(engine, cloud)
        with pytest.raises(ServerBusy, match="holds 1"):
            submit(engine, cloud)
        backend.finish.set()
        await job.result()
        await submit(engine, cloud).result()

    asyncio.run(scenario())


def test_a_job_that_no_worker_takes_in_time_is_answered_busy(cloud: Path) -> None:
    async def scenario() -> None:
        backend = ObedientBackend()
        with pytest.raises(ServerBusy, match=r"0\.01 s"):
            await submit(engine_of(backend, max_wait_seconds=0.01), cloud).result()
        assert len(backend.canceled) == 1

    asyncio.run(scenario())


def test_a_job_that_has_started_may_take_longer_than_the_longest_wait(cloud: Path) -> None:
    async def scenario() -> None:
        backend = ObedientBackend()
        backend.go.set()
        job = submit(engine_of(backend, max_wait_seconds=0.01), cloud)
        await asyncio.sleep(0.05)
        backend.finish.set()
        assert await job.result() == REPORT

    asyncio.run(scenario())


def test_cancel_reaches_the_backend_and_ends_the_events(cloud: Path) -> None:
    async def scenario() -> None:
        backend = ObedientBackend()
        backend.go.set()
        job = submit(engine_of(backend), cloud)
        events = asyncio.create_task(_kinds(job))
        await asyncio.sleep(0)
        await job.cancel()
        assert backend.canceled == [job.id]
        assert "completed" not in await events
        with pytest.raises(JobCanceled, match=job.id):
            await job.result()

    asyncio.run(scenario())


def test_the_error_of_a_job_is_raised_as_it_is(cloud: Path) -> None:
    async def scenario() -> None:
        backend = ObedientBackend()
        backend.go.set()
        backend.finish.set()
        backend.error = MalformedFile("line 3")
        with pytest.raises(MalformedFile, match="line 3"):
            await submit(engine_of(backend), cloud).result()

    asyncio.run(scenario())


def test_limits_and_names_are_checked_before_anything_waits(cloud: Path) -> None:
    async def scenario() -> None:
        engine = engine_of(ObedientBackend())
        with pytest.raises(UnknownFormat):
            submit(engine, cloud, format="no-such-format")
        cloud.write_bytes(b"x" * 101)
        with pytest.raises(TooManyBytes, match="100"):
            submit(engine, cloud)

    asyncio.run(scenario())


def test_a_backend_that_can_never_start_says_why_to_every_job(cloud: Path) -> None:
    async def scenario() -> None:
        backend = ObedientBackend()
        backend.failure = DeviceUnavailable("no cuda")
        with pytest.raises(DeviceUnavailable):
            submit(engine_of(backend), cloud)

    asyncio.run(scenario())
