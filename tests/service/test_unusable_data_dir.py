"""A data directory that is gone or locked for a while: who asks is told so, no job is lost, and work goes on."""

from __future__ import annotations

import asyncio
import errno
import shutil
import sqlite3
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx2
import pytest

from straightpcf.points.options import DenoiseOptions
from straightpcf.service.backends.base import FileJob, FilesUnusable
from straightpcf.service.backends.process import WorkerProcess
from straightpcf.service.backends.worker import Unusable, WorkerSpec, _answer
from straightpcf.service.engine import Engine
from straightpcf.service.jobs import store_thread
from straightpcf.service.jobs.folders import JobFolders
from straightpcf.service.jobs.store import JobStore
from tests.service import engines
from tests.service.fakes import CONTENT, Deaf, ObedientBackend
from tests.service.in_process import free_port, serving
from tests.service.test_races import CLOUD, play, willing

SAID = "the server's data directory cannot be used at the moment; its log says why"


@asynccontextmanager
async def gone(folder: Path) -> AsyncIterator[None]:
    """Take a folder away, as a disk that is not mounted."""
    away = folder.rename(folder.with_name("away"))
    try:
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        away.rename(folder)


@asynccontextmanager
async def locked(folder: Path) -> AsyncIterator[None]:
    """Hold the lock of writers, as a backup or a shell that forgot its transaction."""
    with closing(sqlite3.connect(folder / "jobs.sqlite3", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield


@asynccontextmanager
async def asking(
    data_dir: Path, backend: ObedientBackend, *, timeout: float = 5.0
) -> AsyncIterator[httpx2.AsyncClient]:
    async with (
        serving(data_dir, backend) as (_, host, port),
        httpx2.AsyncClient(base_url=f"http://{host}:{port}", timeout=timeout) as http,
    ):
        yield http


@asynccontextmanager
async def at_work(data_dir: Path, backend: ObedientBackend) -> AsyncIterator[httpx2.AsyncClient]:
    """Do as `asking`, while a job "before" is worked on until `backend.finish` is set."""
    async with asking(data_dir, backend) as http:
        backend.finish.clear()
        assert (await http.put("/jobs/before?filename=a.xyz", content=CLOUD)).status_code == 202
        await engines.until(lambda: backend.runs)
        yield http


@pytest.mark.parametrize("trouble", [gone, locked])
def test_who_asks_is_told_so_and_served_when_it_is_over(
    tmp_path: Path, trouble: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(store_thread, "LOCK_SECONDS", 0.1)
    backend = willing()

    async def scenario() -> None:
        async with at_work(tmp_path / "data", backend) as http:
            async with trouble(tmp_path / "data"):
                answer = await http.put("/jobs/meanwhile?filename=a.xyz", content=CLOUD)
                problem = answer.json()
                assert (answer.status_code, problem["code"], problem["detail"]) == (503, "server_busy", SAID)
                assert answer.headers["retry-after"]
            backend.finish.set()
            assert (await http.put("/jobs/meanwhile?filename=a.xyz", content=CLOUD)).status_code == 202
            for id in ("before", "meanwhile"):
                assert (await http.get(f"/jobs/{id}?wait=10")).json()["state"] == "succeeded"
                assert (await http.get(f"/jobs/{id}/result")).content == CONTENT
        assert not any((tmp_path / "data" / "incoming").iterdir())

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize("replaced", [False, True])
def test_a_database_that_is_deleted_or_replaced_under_a_server_loses_no_job_that_it_accepts(
    tmp_path: Path, replaced: bool, caplog: pytest.LogCaptureFixture
) -> None:
    backend, names = willing(), [f"jobs.sqlite3{part}" for part in ("", "-wal", "-shm")]

    async def scenario() -> None:
        async with at_work(tmp_path / "data", backend) as http:
            (away := tmp_path / "away").mkdir()
            for name in names:
                (tmp_path / "data" / name).rename(away / name)
            if replaced:
                JobStore(tmp_path / "data" / "jobs.sqlite3").close()
            ready = await http.get("/readyz")
            assert (ready.status_code, ready.json()) == (503, {"status": "no_database", "ready": False})
            refused = await http.put("/jobs/meanwhile?filename=a.xyz", content=CLOUD)
            assert (refused.status_code, refused.json()["detail"]) == (503, SAID)
            assert not list((tmp_path / "data" / "incoming").iterdir())
            for name in names:
                (away / name).rename(tmp_path / "data" / name)
            backend.finish.set()
            assert (await http.get("/readyz")).status_code == 200
            assert (await http.get("/jobs/before?wait=10")).json()["state"] == "succeeded"
            (tmp_path / "data" / "jobs.sqlite3").unlink()  # for good: the server still ends in peace

    play(scenario)
    assert "deleted or replaced under this server" in caplog.text
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize("by", ["a copy", "nothing", "one as large"])
def test_a_database_that_is_overwritten_under_a_server_takes_no_job(
    tmp_path: Path, by: str, caplog: pytest.LogCaptureFixture
) -> None:
    database, backup = tmp_path / "data" / "jobs.sqlite3", tmp_path / "backup"

    async def scenario() -> None:
        async with asking(tmp_path / "data", ObedientBackend()) as http:
            pass
        shutil.copyfile(database, backup)  # as long as no server has it
        async with asking(tmp_path / "data", ObedientBackend()) as http:
            assert (await http.put("/jobs/before?filename=a.xyz", content=CLOUD)).status_code == 202
            size = {"a copy": backup.stat().st_size, "nothing": 0, "one as large": database.stat().st_size}[by]
            database.write_bytes(backup.read_bytes()[:size].ljust(size, b"\0"))
            for _ in range(2):
                ready = await http.get("/readyz")
                assert (ready.status_code, ready.json()["status"]) == (503, "no_database")
                refused = await http.put("/jobs/meanwhile?filename=a.xyz", content=CLOUD)
                assert (refused.status_code, refused.json()["detail"]) == (503, SAID)

    play(scenario)
    assert "overwritten under this server" in caplog.text


def test_a_database_that_servers_write_in_turns_is_their_own(tmp_path: Path) -> None:
    """One of them moves what both have committed into the database, again and again."""
    database = tmp_path / "data" / "jobs.sqlite3"

    async def scenario() -> None:
        async with asking(tmp_path / "data", ObedientBackend()) as http:
            written = set()
            with closing(sqlite3.connect(database, isolation_level=None)) as other:
                for number in range(60):
                    made = await http.put(f"/jobs/{number}?filename=a.xyz", content=CLOUD)
                    assert made.status_code == 202, made.text
                    other.execute("UPDATE jobs SET name = ? WHERE id = ?", ("a" * 20_000, str(number)))
                    if number % 3 == 0:
                        other.execute(f"PRAGMA wal_checkpoint({('PASSIVE', 'FULL', 'TRUNCATE')[number // 3 % 3]})")
                    assert (await http.get("/readyz")).status_code == 200
                    written.add(database.stat().st_mtime_ns)
            assert len(written) > 10

    play(scenario)


@pytest.mark.parametrize("part", ["-wal", "-shm"])
def test_what_was_committed_outlives_a_wal_or_shm_that_is_deleted_under_its_server(tmp_path: Path, part: str) -> None:
    async def scenario() -> None:
        async with asking(tmp_path / "data", ObedientBackend()) as http:
            assert (await http.put("/jobs/before?filename=a.xyz", content=CLOUD)).status_code == 202
            assert (await http.get("/jobs/before")).status_code == 200
            (tmp_path / "data" / f"jobs.sqlite3{part}").unlink()
            assert (await http.get("/readyz")).json()["status"] == "no_database"
            assert (await http.put("/jobs/meanwhile?filename=a.xyz", content=CLOUD)).status_code == 503
        async with asking(tmp_path / "data", ObedientBackend()) as http:
            assert [job["id"] for job in (await http.get("/jobs")).json()["jobs"]] == ["before"]

    play(scenario)


def test_many_requests_do_not_wait_for_a_lock_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store_thread, "LOCK_SECONDS", 1.0)

    async def scenario() -> None:
        async with asking(tmp_path / "data", ObedientBackend(), timeout=60) as http:
            assert (await http.put("/jobs/before?filename=a.xyz", content=CLOUD)).status_code == 202
            async with locked(tmp_path / "data"):
                began = time.monotonic()
                asked = [http.put(f"/jobs/{number}?filename=a.xyz", content=CLOUD) for number in range(20)]
                *answers, seen = await asyncio.gather(*asked, http.get("/jobs/before"))
                assert time.monotonic() - began < 10
            assert {answer.status_code for answer in answers} == {503}
            assert all(answer.headers["retry-after"] for answer in answers)
            assert seen.status_code == 200

    play(scenario)


def test_grpc_says_it_too(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    grpc = pytest.importorskip("grpc")
    from straightpcf.points.wire import straightpcf_pb2 as pb
    from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub

    async def scenario() -> None:
        async with (
            serving(tmp_path / "data", willing(), grpc_port=(port := free_port())) as (_, host, _),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
            gone(tmp_path / "data"),
        ):
            parts = [pb.CreateJobRequest(config=pb.JobConfig(filename="a.xyz")), pb.CreateJobRequest(chunk=CLOUD)]
            with pytest.raises(grpc.RpcError) as caught:
                await DenoiseServiceStub(channel).CreateJob(iter(parts))
            assert (caught.value.code().name, caught.value.details()) == ("UNAVAILABLE", SAID)

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]


def test_a_lease_is_as_long_as_it_should_be_when_its_renewal_had_to_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, _ = await engines.submit(engine)
        claim = await engine._call(JobStore.claim, "a-server", 5.0)
        clock = [1e9]
        monkeypatch.setattr("straightpcf.service.jobs.store.time", SimpleNamespace(monotonic=lambda: clock[0]))
        begin = JobStore._transaction

        def late(store: JobStore) -> Any:
            clock[0] += 20  # another process had the file
            return begin(store)

        monkeypatch.setattr(JobStore, "_transaction", late)
        assert await engine._call(JobStore.extend, [(record.id, claim.fence)], 5.0) == ["held"]
        monkeypatch.setattr(JobStore, "_transaction", begin)
        assert await engine._call(JobStore.recover, expires_in=1.0) == []

    engines.play(tmp_path, scenario)


def test_an_upload_that_cannot_be_removed_lets_go_of_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_only(path: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    folders = JobFolders(tmp_path)
    before = len(list(Path("/proc/self/fd").iterdir()))
    monkeypatch.setattr(Path, "unlink", read_only)
    with pytest.raises(OSError, match="Read-only"), folders.upload():
        pass
    monkeypatch.undo()
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    folders.close()


def test_a_worker_whose_files_are_gone_says_so_in_a_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    job = FileJob(
        id="1", source=tmp_path / "gone" / "input", target=tmp_path / "gone" / "result", max_points=1000,
        options=DenoiseOptions(iterations=1),
    )  # fmt: skip
    ours, theirs = Pipe()
    with ours, theirs:
        told: Any = _answer(SimpleNamespace(device="cpu"), job, theirs)  # type: ignore[arg-type]
    assert isinstance(told, Unusable)
    assert "job 1: its files cannot be used: [Errno 2] No such file" in told.message
    assert not caplog.records


def test_a_real_worker_whose_files_are_gone_lives_on(tmp_path: Path) -> None:
    job = FileJob(id="1", source=tmp_path / "in", target=tmp_path / "out", options=DenoiseOptions(), max_points=1000)

    async def scenario() -> None:
        worker = WorkerProcess(WorkerSpec(device="cpu", weights=None, threads=1))
        try:
            await worker.ready
            for _ in range(2):
                with pytest.raises(FilesUnusable, match="its files cannot be used"):
                    await worker.run(job, Deaf())
        finally:
            await worker.stop(patience_seconds=5)

    asyncio.run(scenario())


def test_a_job_whose_files_its_worker_could_not_use_starts_again(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        record, _ = await engines.submit(engine)
        record = await engine.wait(record.id)
        assert (record.state, record.attempts) == ("succeeded", 2)
        assert "log" in await engines.kinds(engine, record.id)

    engines.play(tmp_path, scenario, FilesUnusable("job 1: its files cannot be used"))


def test_a_job_that_another_server_deletes_while_it_is_worked_on_is_no_fault(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    backend = ObedientBackend(FilesUnusable("job 1: its files cannot be used"))  # as a worker whose folder is gone says
    backend.go.set()

    async def scenario() -> None:
        async with engines.running(tmp_path, backend) as engine, engines.running(tmp_path, ObedientBackend()) as other:
            record, _ = await engines.submit(engine)
            await engines.until(lambda: backend.runs)
            await other.delete(record.id)
            backend.finish.set()
            await engines.until(lambda: not engine._runner._running)
            assert (await engine.list())[0] == []

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]
