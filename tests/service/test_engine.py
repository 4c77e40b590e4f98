"""The engine against a backend that does as it is told, with a real store on a real disk."""

from __future__ import annotations

import asyncio
import sqlite3
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, closing, suppress
from pathlib import Path
from typing import Any

import pytest

from straightpcf.points.errors import (
    DeviceUnavailable,
    IdConflict,
    IdempotencyConflict,
    InternalError,
    InvalidOptions,
    InvalidRequest,
    JobCanceled,
    JobNotFinished,
    MalformedFile,
    NotFound,
    QuotaExceeded,
    ServerBusy,
    SpoolFull,
    TooManyBytes,
    UnknownFormat,
)
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.admission import Limits
from straightpcf.service.backends.base import WorkerDied
from straightpcf.service.engine import Engine, JobRequest
from straightpcf.service.jobs import runner
from straightpcf.service.jobs.record import Claim, JobRecord
from straightpcf.service.jobs.store import JobStore
from tests.service.fakes import CONTENT, ObedientBackend

Scenario = Callable[[Engine, ObedientBackend], Coroutine[Any, Any, None]]


@asynccontextmanager
async def running(folder: Path, backend: ObedientBackend, **limits: Any) -> AsyncIterator[Engine]:
    engine = Engine(
        backend,
        limits=Limits(**{"max_bytes": 100, "max_points": 10, "shutdown_seconds": 0.0} | limits),
        data_dir=folder,
    )
    await engine.start()
    try:
        yield engine
    finally:
        await engine.stop()


async def submit(engine: Engine, content: bytes = b"0 0 0\n", **request: Any) -> tuple[JobRecord, bool]:
    with engine.upload() as path:
        path.write_bytes(content)
        return await engine.submit(path, JobRequest(**{"options": DenoiseOptions()} | request))


def play(folder: Path, scenario: Scenario, *outcomes: Exception, **limits: Any) -> None:
    async def scene() -> None:
        backend = ObedientBackend(*outcomes)
        async with running(folder, backend, **limits) as engine:
            await asyncio.wait_for(scenario(engine, backend), timeout=20)

    asyncio.run(scene())


async def until(look: Callable[[], object]) -> None:
    while not look():
        await asyncio.sleep(0.01)


def fill(store: JobStore, id: str) -> None:
    """Leave SQLite no room for one more event of a job."""
    store._db.execute("PRAGMA max_page_count = 1")  # it takes what there is
    for size in (2000, 200, 20, 0):
        with suppress(sqlite3.OperationalError):
            while True:
                store._add_event(id, "log", {"level": "warning", "message": "x" * size})


async def run_first_and_fill(engine: Engine, backend: ObedientBackend) -> JobRecord:
    """Let a job's end, which comes when `finish` is set, find no room."""
    record, _ = await submit(engine)
    backend.go.set()
    await until(lambda: backend.runs)
    await engine._call(fill, record.id)
    return record


def make_room(store: JobStore) -> None:
    store._db.execute("PRAGMA max_page_count = 1000000")


async def kinds(engine: Engine, id: str, after: int = 0) -> list[str]:
    return [event.kind async for event in engine.events(id, after=after)]


def test_a_job_tells_its_events_in_order_to_those_who_come_early_late_or_again(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, created = await submit(engine)
        assert (created, record.state, record.position) == (True, "queued", 0)
        early = asyncio.create_task(kinds(engine, record.id))
        backend.go.set()
        backend.finish.set()
        assert (await engine.wait(record.id)).state == "succeeded"
        whole = ["queued", "start", "progress", "log", "output", "completed"]
        assert await early == await kinds(engine, record.id) == whole
        assert await kinds(engine, record.id, after=3) == whole[3:]

    play(tmp_path, scenario)


def test_a_result_is_there_when_the_job_has_succeeded_and_not_before(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, _ = await submit(engine, name="scan.xyz")
        with pytest.raises(JobNotFinished):
            await engine.result(record.id)
        backend.go.set()
        backend.finish.set()
        await engine.wait(record.id)
        path, record = await engine.result(record.id)
        assert path.read_bytes() == CONTENT
        assert record.result is not None
        assert record.result.filename == "scan_clean.xyz"
        assert record.report is not None
        assert record.report["noise_before"] is None  # JSON has no NaN

    play(tmp_path, scenario)


def test_what_a_server_leaves_the_next_one_does(tmp_path: Path) -> None:
    ids: list[str] = []

    async def leave(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        ids.extend([(await submit(engine, bytes([65 + n])))[0].id for n in range(3)])
        while not backend.runs:
            await asyncio.sleep(0.01)

    async def finish(engine: Engine, backend: ObedientBackend) -> None:
        assert [(await engine.get(id)).state for id in ids] == ["queued"] * 3
        backend.go.set()
        backend.finish.set()
        assert [(await engine.wait(id)).state for id in ids] == ["succeeded"] * 3

    play(tmp_path, leave)
    play(tmp_path, finish)


def test_a_worker_that_dies_costs_an_attempt_and_the_third_one_is_the_last(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        first, second = (await submit(engine))[0], (await submit(engine, b"1 1 1\n"))[0]
        record = await engine.wait(first.id)
        assert (record.state, record.attempts) == ("failed", 3)
        assert isinstance(record.error, InternalError)
        assert (await engine.wait(second.id)).attempts == 2  # it lost one worker and went on
        assert len({job.target for job in backend.runs}) == len(backend.runs)

    play(tmp_path, scenario, *[WorkerDied("killed")] * 4)


def test_the_same_idempotency_key_finds_the_same_job_and_another_request_is_a_conflict(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        made = await asyncio.gather(*(submit(engine, idempotency_key="k") for _ in range(8)))
        assert len({record.id for record, _ in made}) == 1
        assert sum(created for _, created in made) == 1
        for change in ({"content": b"1 1 1\n"}, {"options": DenoiseOptions(seed=1)}, {"endpoint": "denoise"}):
            with pytest.raises(IdempotencyConflict):
                await submit(engine, idempotency_key="k", **change)
        assert (await submit(engine, idempotency_key="k", owner="another"))[1]
        assert len(list((tmp_path / "jobs").iterdir())) == 2  # no repetition left a folder

    play(tmp_path, scenario)


def test_a_chosen_id_makes_one_job_and_must_be_a_plain_name(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        assert (await submit(engine, id="scan-1"))[0].id == "scan-1"
        assert not (await submit(engine, id="scan-1"))[1]
        with pytest.raises(IdConflict):
            await submit(engine, b"1 1 1\n", id="scan-1")
        with pytest.raises(IdConflict):
            await submit(engine, id="scan-1", owner="another")
        for id in ("", "..", ".x", "a/b", "a" * 65, "ü", "a b"):
            with pytest.raises(InvalidRequest):
                await submit(engine, id=id)

    play(tmp_path, scenario)


def test_canceling_works_in_every_state_and_reaches_the_worker(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        waiting, _ = await submit(engine)
        assert (await engine.cancel(waiting.id)).state == "canceled"
        backend.go.set()
        running_, _ = await submit(engine)
        while not backend.runs:
            await asyncio.sleep(0.01)
        assert (await engine.cancel(running_.id)).state == "canceled"
        assert backend.canceled == [running_.id]
        with pytest.raises(JobCanceled):
            await engine.result(running_.id)
        backend.finish.set()
        done, _ = await submit(engine)
        await engine.wait(done.id)
        assert (await engine.cancel(done.id)).state == "succeeded"
        assert (await kinds(engine, waiting.id))[-1] == "completed"

    play(tmp_path, scenario)


def test_a_deleted_job_leaves_no_file_and_no_row(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        record, _ = await submit(engine)
        while not backend.runs:
            await asyncio.sleep(0.01)
        await engine.delete(record.id)
        with pytest.raises(NotFound):
            await engine.get(record.id)
        assert not list((tmp_path / "jobs").iterdir())

    play(tmp_path, scenario)


def test_a_job_of_another_owner_does_not_exist(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, _ = await submit(engine, owner="a")
        for ask in (engine.get, engine.cancel, engine.delete, engine.result, engine.wait):
            with pytest.raises(NotFound):
                await ask(record.id, owner="b")
        assert await engine.list(owner="b") == ([], None)
        assert [job.id for job in (await engine.list(owner="a"))[0]] == [record.id]

    play(tmp_path, scenario)


def test_pages_list_every_job_once_newest_first(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        ids = [(await submit(engine, bytes([65 + n])))[0].id for n in range(7)]
        await engine.cancel(ids[2])
        seen, cursor = [], None
        while True:
            page, cursor = await engine.list(limit=3, cursor=cursor)
            seen += [record.id for record in page]
            if cursor is None:
                break
        assert seen == ids[::-1]
        assert [record.id for record in (await engine.list(states=["canceled"]))[0]] == [ids[2]]
        with pytest.raises(InvalidRequest, match="cursor"):
            await engine.list(cursor="nonsense")

    play(tmp_path, scenario)


def test_what_is_over_a_limit_is_refused_and_costs_nothing(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        with pytest.raises(UnknownFormat):
            await submit(engine, format="no-such-format")
        with pytest.raises(TooManyBytes, match="100"):
            await submit(engine, b"x" * 101)
        first, _ = await submit(engine, owner="a")
        with pytest.raises(QuotaExceeded):
            await submit(engine, b"1 1 1\n", owner="a")
        await submit(engine, owner="b")
        with pytest.raises(ServerBusy, match="holds 2"):
            await submit(engine, owner="c")
        await engine.cancel(first.id, owner="a")
        await submit(engine, owner="c")
        assert len(list((tmp_path / "jobs").iterdir())) == 3
        assert not list((tmp_path / "incoming").iterdir())

    play(tmp_path, scenario, max_jobs=2, max_jobs_per_key=1)


def test_a_full_disk_is_said_before_anything_is_written(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        with pytest.raises(SpoolFull):
            await submit(engine, b"x" * 60)
        await submit(engine, b"0 0 0\n")

    play(tmp_path, scenario, max_spool_bytes=100)


def test_finished_jobs_expire_and_are_then_forgotten(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        record, _ = await submit(engine)
        await engine.wait(record.id)
        await engine._sweep()
        assert (await engine.get(record.id)).state == "expired"
        assert not list((tmp_path / "jobs").iterdir())

    play(tmp_path, scenario, result_ttl_seconds=1e-6)


def test_the_error_of_a_job_is_raised_as_it_is(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        record, _ = await submit(engine)
        assert (await engine.wait(record.id)).state == "failed"
        with pytest.raises(MalformedFile, match="line 3"):
            await engine.result(record.id)

    play(tmp_path, scenario, MalformedFile("line 3"))


def test_a_backend_that_can_never_start_says_why_to_every_job(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.failure = DeviceUnavailable("no cuda")
        with pytest.raises(DeviceUnavailable):
            await submit(engine)

    play(tmp_path, scenario)


def test_a_job_whose_end_cannot_be_written_runs_again_while_the_server_is_busy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "LEASE_SECONDS", 0.3)
    monkeypatch.setattr(runner, "HEARTBEAT_SECONDS", 0.05)
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.05)
    monkeypatch.setattr(runner, "END_TRIES", 3)

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        first = await run_first_and_fill(engine, backend)
        backend.finish.set()
        await until(lambda: not engine._runner._running)
        backend.finish.clear()
        await engine._call(make_room)
        second, _ = await submit(engine, b"1 1 1\n")
        await until(lambda: len(backend.runs) == 2)
        while (await engine.get(first.id)).state != "queued":
            await engine._sweep()
            await asyncio.sleep(0.02)
        assert (await engine.get(second.id)).attempts == 1  # its lease was renewed all the while
        backend.finish.set()
        assert [(await engine.wait(id)).state for id in (first.id, second.id)] == ["succeeded"] * 2
        assert (await engine.get(first.id)).attempts == 2

    play(tmp_path, scenario)


def test_an_end_that_finds_no_room_is_written_when_there_is_some_and_nothing_is_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.05)

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record = await run_first_and_fill(engine, backend)
        backend.finish.set()
        await asyncio.sleep(0.3)
        assert (await engine.get(record.id)).state == "processing"
        await engine._call(make_room)
        ended = await engine.wait(record.id)
        assert (ended.state, ended.attempts, len(backend.runs)) == ("succeeded", 1, 1)

    play(tmp_path, scenario)


def test_a_fault_of_the_server_ends_the_job_and_not_the_server(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        ended = await engine.wait((await submit(engine))[0].id)
        assert (ended.state, type(ended.error), ended.attempts) == ("failed", InternalError, 1)
        assert (await engine.wait((await submit(engine))[0].id)).state == "succeeded"

    play(tmp_path, scenario, ZeroDivisionError("a bug"))


def test_a_cancel_that_comes_between_a_claim_and_the_jobs_first_step_ends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = JobStore.claim

    def slow_claim(store: JobStore, server: str, lease_seconds: float) -> Claim | None:
        taken = claim(store, server, lease_seconds)
        time.sleep(0.1 if taken else 0)
        return taken

    monkeypatch.setattr(JobStore, "claim", slow_claim)

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, _ = await submit(engine)

        async def cancel() -> None:  # as the engine does once it has found the job
            await engine._call(JobStore.request_cancel, record.id, expires_in=60)
            await engine._runner.cancel(record.id)

        backend.go.set()
        await asyncio.sleep(0.02)  # the claim is under way
        canceling = asyncio.create_task(cancel())
        await asyncio.sleep(0.01)
        time.sleep(0.3)  # the loop is held up, and finds both answers at once
        await canceling
        assert (await engine.get(record.id)).state == "canceled"
        assert not backend.runs
        backend.finish.set()
        assert (await engine.wait((await submit(engine))[0].id)).state == "succeeded"

    play(tmp_path, scenario)


def test_a_canceled_job_is_not_started_again_when_its_worker_or_server_dies(tmp_path: Path) -> None:
    async def worker(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        record, _ = await submit(engine)
        await until(lambda: backend.runs)
        await engine._call(JobStore.request_cancel, record.id, expires_in=60)  # no heartbeat has seen it yet
        backend.finish.set()
        assert (await engine.wait(record.id)).state == "canceled"
        assert len(backend.runs) == 1
        assert (await kinds(engine, record.id))[-1] == "completed"

    async def server(engine: Engine, backend: ObedientBackend) -> None:
        records = [(await submit(engine, content))[0] for content in (b"0", b"1")]
        for _ in records:
            await engine._call(JobStore.claim, "the dead", 15.0)
        await engine._call(JobStore.request_cancel, records[0].id, expires_in=60)
        await engine._sweep()
        assert [(await engine.get(record.id)).state for record in records] == ["canceled", "queued"]

    play(tmp_path / "worker", worker, WorkerDied("killed"))
    play(tmp_path / "server", server)


def test_a_full_disk_is_the_same_error_from_files_and_from_the_store(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        def upload() -> None:
            with engine.upload() as path:
                path.unlink()
                path.symlink_to("/dev/full")
                path.write_bytes(b"0 0 0\n")

        with pytest.raises(SpoolFull):
            upload()
        record, _ = await submit(engine)
        await engine._call(fill, record.id)
        with pytest.raises(SpoolFull):
            await engine.cancel(record.id)
        assert (await engine.get(record.id)).state == "queued"
        await engine._call(make_room)
        assert (await engine.cancel(record.id)).state == "canceled"

    play(tmp_path, scenario)


def test_patches_are_reserved_for_and_then_counted_as_they_are(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        once, ten_times = DenoiseOptions(iterations=1), DenoiseOptions(iterations=10)
        points = b"0 0 0\n" * 16
        with pytest.raises(SpoolFull):
            await submit(engine, points, name="a.xyz", options=ten_times)
        record, _ = await submit(engine, points, name="a.xyz", options=once)
        reserved = await engine._call(JobStore.load)
        assert reserved.bytes - reserved.coming == len(points) == (await engine.usage()).bytes
        assert reserved.coming > len(points)
        backend.patches = bytes(400)
        backend.go.set()
        backend.finish.set()
        await engine.wait(record.id)
        kept = sum(path.stat().st_size for path in (tmp_path / "jobs").rglob("*") if path.is_file())
        assert kept == len(points) + len(CONTENT) + 400
        assert (await engine._call(JobStore.load)).bytes == (await engine.usage()).bytes == kept
        with pytest.raises(SpoolFull, match=str(kept)):
            await submit(engine, points, name="a.xyz", options=once)
        await engine.delete(record.id)
        await submit(engine, points, name="a.xyz", options=once)

    play(tmp_path, scenario, max_spool_bytes=700)


def test_a_store_from_before_patches_were_counted_is_taken_over(tmp_path: Path) -> None:
    async def leave(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        await engine.wait((await submit(engine))[0].id)

    async def find(engine: Engine, backend: ObedientBackend) -> None:
        assert (await engine._call(JobStore.load)).bytes == len(b"0 0 0\n") + len(CONTENT)

    play(tmp_path, leave)
    with closing(sqlite3.connect(tmp_path / "jobs.sqlite3")) as db:
        db.execute("ALTER TABLE jobs DROP COLUMN spool")
    play(tmp_path, find)


def test_a_file_of_a_newer_schema_is_refused(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "jobs.sqlite3")) as db:
        db.execute("PRAGMA user_version = 99")
    with pytest.raises(InvalidOptions, match="99"):
        JobStore(tmp_path / "jobs.sqlite3")


def test_what_runs_has_one_limit_from_the_moment_that_a_server_drains(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        assert engine.patience_seconds == 60
        engine.drain()
        await asyncio.sleep(0.2)
        engine.drain()  # again, by whoever stops next
        assert 0 < engine.patience_seconds <= 59.8
        engine._ends_at = 0.0
        assert engine.patience_seconds == 0

    play(tmp_path, scenario, shutdown_seconds=60.0)
