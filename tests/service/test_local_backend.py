"""Supervision of workers, with workers that die on command; the real ones die in test_rest and test_shutdown."""

from __future__ import annotations

import asyncio
import errno
from pathlib import Path

import pytest

from straightpcf.points.errors import DeviceUnavailable, StraightPCFError
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.backends import local
from straightpcf.service.backends.base import FileJob, FileReport, Listener, WorkerDied
from straightpcf.service.backends.local import LocalBackend
from straightpcf.service.backends.worker import WorkerSpec
from tests.service.fakes import REPORT, Deaf

SPEC = WorkerSpec(device="cpu", weights=None, threads=None)
JOB = FileJob(id="1", source=Path("in"), target=Path("out"), options=DenoiseOptions(), max_points=10)


class Workers:
    """Stand in for WorkerProcess; the first `deaths` jobs kill their worker.

    faults: what the next starts meet. early: how many of the first die before they are ready.
    """

    def __init__(
        self, *faults: OSError, early: int = 0, deaths: int = 0, failure: StraightPCFError | None = None
    ) -> None:
        self.faults, self.early, self.deaths, self.failure = list(faults), early, deaths, failure
        self.started = 0

    def __call__(self, spec: WorkerSpec) -> Worker:
        if self.started and self.faults:
            raise self.faults.pop(0)
        self.started += 1
        return Worker(self)


class Worker:
    def __init__(self, owner: Workers) -> None:
        self.owner, self.pid = owner, owner.started
        self.ready: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self.died: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        if owner.failure is not None:
            self.ready.set_exception(owner.failure)
        elif owner.early > 0:
            owner.early -= 1
            self.died.set_result(None)
            self.ready.set_exception(WorkerDied("killed before it was ready"))
        else:
            self.ready.set_result("cpu")

    @property
    def alive(self) -> bool:
        return not self.died.done()

    async def run(self, job: FileJob, listener: Listener) -> FileReport:
        await asyncio.sleep(0)
        if self.owner.deaths == 0:
            return REPORT
        self.owner.deaths -= 1
        self.died.set_result(None)
        raise WorkerDied("killed")

    async def stop(self, *, patience_seconds: float) -> None:
        if self.alive:
            self.died.set_result(None)


def run(backend: LocalBackend, jobs: int = 1) -> list[FileReport]:
    async def scenario() -> list[FileReport]:
        await backend.start()
        try:
            many = (backend.run(JOB, Deaf()) for _ in range(jobs))
            return await asyncio.wait_for(asyncio.gather(*many), timeout=5)
        finally:
            await backend.stop()

    return asyncio.run(scenario())


def run_over_a_death() -> LocalBackend:
    """Run a job whose worker dies, and one that another worker does."""

    async def scenario() -> LocalBackend:
        backend = LocalBackend([SPEC])
        await backend.start()
        with pytest.raises(WorkerDied):
            await asyncio.wait_for(backend.run(JOB, Deaf()), timeout=5)
        assert await asyncio.wait_for(backend.run(JOB, Deaf()), timeout=5) == REPORT
        await backend.stop()
        return backend

    return asyncio.run(scenario())


def test_a_worker_that_dies_is_told_and_the_next_job_gets_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "WorkerProcess", workers := Workers(deaths=1))
    backend = run_over_a_death()
    assert (workers.started, backend.restarts) == (2, 1)


def test_a_worker_that_dies_before_it_is_ready_is_counted_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "WorkerProcess", workers := Workers(early=2))
    monkeypatch.setattr(local, "FIRST_RESTART_DELAY_SECONDS", 0.01)
    backend = LocalBackend([SPEC])
    assert run(backend) == [REPORT]
    assert (workers.started, backend.restarts) == (3, 2)


def test_many_jobs_share_the_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "WorkerProcess", workers := Workers())
    assert run(LocalBackend([SPEC, SPEC]), jobs=20) == [REPORT] * 20
    assert workers.started == 2


def test_a_worker_that_can_never_start_fails_every_job_and_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "WorkerProcess", workers := Workers(failure=DeviceUnavailable("no cuda")))
    told: list[str] = []
    backend = LocalBackend([SPEC], on_failure=lambda: told.append("told"))
    with pytest.raises(DeviceUnavailable):
        run(backend, jobs=3)
    assert (told, workers.started) == (["told"], 1)


def test_a_worker_that_cannot_be_replaced_at_this_moment_is_replaced_later(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    faults = [OSError(errno.EMFILE, "Too many open files"), BlockingIOError(errno.EAGAIN, "no process")]
    monkeypatch.setattr(local, "WorkerProcess", workers := Workers(*faults, deaths=1))
    monkeypatch.setattr(local, "FIRST_RESTART_DELAY_SECONDS", 0.01)
    backend = run_over_a_death()
    assert (workers.started, workers.faults, backend.restarts) == (2, [], 1)
    assert "Too many open files" in caplog.text
    assert "no process" in caplog.text


def test_a_worker_that_cannot_be_put_away_at_this_moment_is_replaced_all_the_same(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    faults = [RuntimeError("can't start new thread")]  # of asyncio.to_thread, where a container has no more threads

    async def stop(worker: Worker, *, patience_seconds: float) -> None:
        if faults:
            raise faults.pop()

    monkeypatch.setattr(Worker, "stop", stop)
    monkeypatch.setattr(local, "WorkerProcess", workers := Workers(deaths=1))
    monkeypatch.setattr(local, "FIRST_RESTART_DELAY_SECONDS", 0.01)
    run_over_a_death()
    assert (workers.started, faults) == (2, [])
    assert "can't start new thread" in caplog.text
