"""What fails under the engine - a worker, a disk, a write - costs what it must and nothing else."""

from __future__ import annotations

import asyncio
import errno
import io
import sqlite3
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from straightpcf.points.errors import (
    DeviceUnavailable,
    InternalError,
    InvalidOptions,
    SpoolFull,
)
from straightpcf.points.options import DenoiseOptions
from straightpcf.points.wire.patches import BYTES_PER_POINT
from straightpcf.service.backends.base import WorkerDied
from straightpcf.service.engine import Engine
from straightpcf.service.jobs import runner
from straightpcf.service.jobs.folders import JobFolders
from straightpcf.service.jobs.record import Claim
from straightpcf.service.jobs.store import MAX_SERVER_DEATHS, Hold, JobStore
from tests.service import fakes
from tests.service.engines import fill, kinds, make_room, play, run_first_and_fill, running, submit, until
from tests.service.fakes import CONTENT, ObedientBackend


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


def test_what_earlier_attempts_wrote_is_removed_when_the_next_begins(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, _ = await submit(engine)
        folder = tmp_path / "jobs" / record.folder
        # Of a server that died; and of a later attempt, where this one was held up and its job is another's by now.
        for name in ("patches-1", "result-1", "result-3"):
            (folder / name).write_bytes(b"x")
        backend.go.set()
        backend.finish.set()
        await engine.wait(record.id)
        assert sorted(path.name for path in folder.iterdir()) == ["input", "patches-2", "result-2", "result-3"]

    play(tmp_path, scenario, WorkerDied("killed"))


def test_bodies_on_their_way_in_leave_accepted_jobs_their_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = [10**6]
    monkeypatch.setattr(JobFolders, "free_bytes", lambda folders: free[0])

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        await submit(engine, b"x" * 60)
        coming = (await engine._call(JobStore.load)).coming
        with engine.upload() as upload, engine.upload() as other:
            upload.write_bytes(bytes(5000))
            other.write_bytes(bytes(5000))
            free[0] = 1000 + coming
            await engine.check_incoming()
            free[0] -= 1
            with pytest.raises(SpoolFull, match="must stay free"):
                await engine.check_incoming()
            free[0] = 10**6
            other.write_bytes(bytes(5001))
            with pytest.raises(SpoolFull, match="10001 bytes of uploads are coming in"):
                await engine.check_incoming()
        await engine.check_incoming()

    play(tmp_path, scenario, min_free_bytes=1000, max_spool_bytes=10_000)


def test_a_full_disk_is_said_before_anything_is_written(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        with pytest.raises(SpoolFull):
            await submit(engine, b"x" * 60)
        await submit(engine, b"0 0 0\n")

    play(tmp_path, scenario, max_spool_bytes=100)


def test_a_format_that_takes_more_than_the_cloud_came_in_is_foreseen(tmp_path: Path) -> None:
    np.save(floats := io.BytesIO(), np.zeros((50, 3), dtype=np.float32))
    once = DenoiseOptions(iterations=1)

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        with pytest.raises(SpoolFull):
            await submit(engine, floats.getvalue(), name="a.npy", options=once, format="xyz")
        await submit(engine, floats.getvalue(), name="a.npy", options=once)

    room = 2 * len(floats.getvalue()) + 50 * BYTES_PER_POINT
    play(tmp_path, scenario, max_bytes=2000, max_points=50, max_spool_bytes=room)


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
            await engine._sweeper.sweep()
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


def test_a_result_that_can_never_be_written_down_ends_the_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fakes, "REPORT", replace(fakes.REPORT, untouched=np.int64(0)))  # which is no JSON

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        ended = await engine.wait((await submit(engine))[0].id)
        assert (ended.state, type(ended.error), ended.attempts) == ("failed", InternalError, 1)

    play(tmp_path, scenario)


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
            await engine._call(JobStore.request_cancel, record.id, record.folder, expires_in=60)
            await engine._runner.cancel(record.folder)

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
        await engine._call(JobStore.request_cancel, record.id, record.folder, expires_in=60)  # no heartbeat saw it
        backend.finish.set()
        assert (await engine.wait(record.id)).state == "canceled"
        assert len(backend.runs) == 1
        assert (await kinds(engine, record.id))[-1] == "completed"

    async def server(engine: Engine, backend: ObedientBackend) -> None:
        records = [(await submit(engine, content))[0] for content in (b"0", b"1")]
        for _ in records:
            await engine._call(JobStore.claim, "the dead", 15.0)
        await engine._call(JobStore.request_cancel, records[0].id, records[0].folder, expires_in=60)
        await engine._sweeper.sweep()
        assert [(await engine.get(record.id)).state for record in records] == ["canceled", "queued"]

    play(tmp_path / "worker", worker, WorkerDied("killed"))
    play(tmp_path / "server", server)


def test_a_job_whose_server_dies_each_time_is_given_up_and_the_next_ones_are_done(tmp_path: Path) -> None:
    """As where it needs more memory than its container may have, and the whole container is killed for it."""

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        fatal, other = [(await submit(engine, content))[0] for content in (b"0", b"1")]
        for attempt in range(1, MAX_SERVER_DEATHS + 1):
            assert (await engine.get(fatal.id)).state == "queued"
            claim = await engine._call(JobStore.claim, "the dead", 15.0)
            assert (claim.record.id, claim.record.attempts) == (fatal.id, attempt)
            await engine._sweeper.sweep()
        record = await engine.get(fatal.id)
        assert record.state == "failed"
        assert isinstance(record.error, InternalError)
        assert "6 times; the cloud was then given up" in record.error.message
        assert (await kinds(engine, fatal.id))[-1] == "completed"
        backend.go.set()
        backend.finish.set()
        assert (await engine.wait(other.id)).state == "succeeded"

    play(tmp_path, scenario)


def test_a_lease_that_runs_out_and_a_server_that_stops_in_order_give_no_job_up(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, _ = await submit(engine)
        for _ in range(MAX_SERVER_DEATHS + 1):
            await engine._call(JobStore.claim, engine._folders.server, -1.0)  # of a server that lives
            await engine._sweeper.sweep()
            claim = await engine._call(JobStore.claim, "restarted", 15.0)
            await engine._call(JobStore.release, record.id, claim.fence, "the server stops", expires_in=60)
        await engine._call(JobStore.claim, "the dead", 15.0)
        await engine._sweeper.sweep()
        assert (await engine.get(record.id)).state == "queued"

    play(tmp_path, scenario)


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


def test_an_upload_is_counted_once_by_what_must_stay_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = [10**6]
    monkeypatch.setattr(JobFolders, "free_bytes", lambda folders: free[0])

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        await submit(engine, body := b"x" * 60)
        coming = (await engine._call(JobStore.load)).coming  # beside the input, which is on the disk by then
        free[0] = 1000 + 2 * coming - 1
        with pytest.raises(SpoolFull):
            await submit(engine, body)
        free[0] += 1
        await submit(engine, body)

    play(tmp_path, scenario, min_free_bytes=1000)


def test_what_is_over_its_time_makes_the_room_that_marking_it_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expire = JobStore.expire

    def expire_if_there_is_room(store: JobStore) -> list[str]:
        if list((tmp_path / "jobs").iterdir()):
            raise SpoolFull("the server's disk is full")
        return expire(store)

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        record, _ = await submit(engine)
        await engine.wait(record.id)
        monkeypatch.setattr(JobStore, "expire", expire_if_there_is_room)
        await engine._sweeper.sweep()
        assert (await engine.get(record.id)).state == "expired"

    play(tmp_path, scenario, result_ttl_seconds=1e-6)


def test_a_store_from_before_patches_and_deaths_were_counted_is_taken_over(tmp_path: Path) -> None:
    async def leave(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        await engine.wait((await submit(engine))[0].id)

    async def find(engine: Engine, backend: ObedientBackend) -> None:
        assert (await engine._call(JobStore.load)).bytes == len(b"0 0 0\n") + len(CONTENT)

    play(tmp_path, leave)
    with closing(sqlite3.connect(tmp_path / "jobs.sqlite3")) as db:
        db.executescript("DROP INDEX jobs_kept; ALTER TABLE jobs DROP COLUMN spool")
        db.executescript("ALTER TABLE jobs DROP COLUMN deaths; ALTER TABLE jobs DROP COLUMN server_deaths")
    play(tmp_path, find)


def test_a_file_of_a_newer_schema_is_refused(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "jobs.sqlite3")) as db:
        db.execute("PRAGMA user_version = 99")
    with pytest.raises(InvalidOptions, match="99"):
        JobStore(tmp_path / "jobs.sqlite3")


def test_leases_are_renewed_while_the_end_of_another_job_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "HEARTBEAT_SECONDS", 0.01)
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(runner, "END_TRIES", 10_000)
    renewed: list[str] = []
    fail, extend = JobStore.fail, JobStore.extend

    def counted(store: JobStore, held: Sequence[tuple[str, int]], seconds: float) -> list[Hold]:
        renewed.extend(id for id, _ in held)
        return extend(store, held, seconds)

    async def scene() -> None:
        backend = ObedientBackend()
        backend.slots = 2
        backend.go.set()
        async with running(tmp_path, backend) as engine:
            canceled, other = (await submit(engine))[0], (await submit(engine, b"1 1 1\n"))[0]
            await until(lambda: len(backend.runs) == 2)
            monkeypatch.setattr(JobStore, "fail", _cannot_write)
            await engine._call(JobStore.request_cancel, canceled.id, canceled.folder, expires_in=1)  # as others do
            await until(lambda: backend.canceled)
            renewed.clear()
            await until(lambda: renewed.count(other.id) > 3)
            monkeypatch.setattr(JobStore, "fail", fail)
            assert (await engine.wait(canceled.id)).state == "canceled"

    monkeypatch.setattr(JobStore, "extend", counted)
    asyncio.run(asyncio.wait_for(scene(), timeout=10))


def _cannot_write(*_: object, **__: object) -> bool:
    raise OSError(errno.EIO, "Input/output error")
