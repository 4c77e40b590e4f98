"""A server on a disk that is really full: a small one of its own, where the kernel lets us mount one."""

from __future__ import annotations

import asyncio
import os
import resource
import signal
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import Pipe
from pathlib import Path

import httpx2
import numpy as np
import pytest

from straightpcf.model.filter import load_filter
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.backends.base import FileJob
from straightpcf.service.backends.worker import Failed, _answer
from straightpcf.service.jobs.full_disk import RESERVE, RESERVE_BYTES
from straightpcf.service.jobs.record import JobRecord, NewJob
from straightpcf.service.jobs.store import JobStore
from tests.clouds import noisy, torus
from tests.conftest import RunningServer, run_server
from tests.service.fakes import ObedientBackend
from tests.service.in_process import serving
from tests.waiting import wait_for

DISK_BYTES = 2**21 + 2**18
ON_A_SMALL_DISK = ("unshare", "-rm", "sh", "-c", f'mount -t tmpfs -o size={DISK_BYTES} tmpfs "$0" && exec "$@"')


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    folder = tmp_path_factory.mktemp("small")
    (data := folder / "data").mkdir()
    within = (*ON_A_SMALL_DISK, str(data))
    if subprocess.run([*within, "true"], capture_output=True).returncode:
        pytest.skip("this machine lets us mount nothing")
    with run_server(folder, "--grpc-port", "0", environment={"STRAIGHTPCF_MIN_FREE_BYTES": "0"}, within=within) as it:
        yield it


@pytest.fixture
def disk(server: RunningServer) -> Path:
    """The small disk, seen from outside the server's namespace."""
    return Path(f"/proc/{server.process.pid}/root{server.data_dir}")


@contextmanager
def filled(disk: Path) -> Iterator[None]:
    """Leave no byte for a while."""
    filler = disk / "filler"
    with suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    try:
        yield
    finally:
        filler.unlink()


def test_an_upload_that_fills_the_disk_is_told_so_and_leaves_nothing(server: RunningServer, disk: Path) -> None:
    pieces = (bytes(2**16) for _ in range(2 * DISK_BYTES // 2**16))
    answer = httpx2.post(f"{server.url}/jobs", content=pieces, timeout=20)
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["retryable"]) == (507, "spool_full", True)
    assert answer.headers["retry-after"]
    wait_for(lambda: not list((disk / "incoming").iterdir()))


def test_grpc_says_it_too(server: RunningServer) -> None:
    grpc = pytest.importorskip("grpc")
    from straightpcf.points.wire import straightpcf_pb2 as pb
    from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub

    parts = [pb.CreateJobRequest(config=pb.JobConfig())] + [pb.CreateJobRequest(chunk=bytes(2**19))] * 8
    with grpc.insecure_channel(server.grpc_url.removeprefix("grpc://")) as channel:
        with pytest.raises(grpc.RpcError) as caught:
            DenoiseServiceStub(channel).CreateJob(iter(parts))
        assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED


def test_what_cannot_be_written_down_is_told_so_and_can_be_asked_again(server: RunningServer, disk: Path) -> None:
    server.wait_until_ready()
    os.kill(server.worker_pid(), signal.SIGSTOP)  # so that all but one of these wait
    with httpx2.Client(base_url=server.url, timeout=20) as http:
        ids = [http.put(f"/jobs/wait-{n}", content=b"0 0 0\n").json()["id"] for n in range(20)]
        (disk / RESERVE).unlink(missing_ok=True)
        with filled(disk):
            answers = [http.post(f"/jobs/{id}/cancel") for id in ids]
        assert {answer.status_code for answer in answers} <= {200, 202, 507}
        refused = [answer.json()["code"] for answer in answers if answer.status_code == 507]
        assert set(refused) == {"spool_full"}
        assert {http.post(f"/jobs/{id}/cancel").status_code for id in ids} <= {200, 202}
        wait_for(lambda: all(http.get(f"/jobs/{id}").json()["finished_at"] for id in ids))


def test_a_job_is_deleted_on_a_full_disk_by_what_is_kept_for_that(server: RunningServer, disk: Path) -> None:
    server.wait_until_ready()
    server.delete_jobs()
    os.kill(server.worker_pid(), signal.SIGSTOP)
    with httpx2.Client(base_url=server.url, timeout=20) as http:
        for name in ("one", "two"):
            assert http.put(f"/jobs/{name}", content=b"0 0 0\n").status_code == 202
        with filled(disk):
            assert http.put("/jobs/three", content=b"0 0 0\n").status_code == 507
            assert http.delete("/jobs/two").status_code == 204
    server.delete_jobs()


def test_every_job_is_deleted_on_a_disk_that_stays_full(tmp_path: Path) -> None:
    """The reserve goes with the first, and leases are renewed meanwhile."""
    (data := tmp_path / "data").mkdir()
    within = (*ON_A_SMALL_DISK, str(data))
    if subprocess.run([*within, "true"], capture_output=True).returncode:
        pytest.skip("this machine lets us mount nothing")
    with run_server(tmp_path, environment={"STRAIGHTPCF_MIN_FREE_BYTES": "0"}, within=within) as server:
        server.wait_until_ready()
        disk = Path(f"/proc/{server.process.pid}/root{data}")
        os.kill(server.worker_pid(), signal.SIGSTOP)
        with httpx2.Client(base_url=server.url, timeout=20) as http:
            for number in range(10):
                assert http.put(f"/jobs/{number}", content=b"0 0 0\n").status_code == 202
            for number in reversed(range(10)):
                with filled(disk):
                    time.sleep(1)
                    assert http.delete(f"/jobs/{number}").status_code == 204, number
            assert not http.get("/jobs").json()["jobs"]


def test_an_upload_that_finds_room_at_the_second_try_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The -wal is emptied where the disk is full, and then all is tried again: with the file, which had been moved."""
    create, tries = JobStore.create, []

    def full_at_first(store: JobStore, job: NewJob) -> tuple[JobRecord, bool]:
        tries.append(job.folder)
        if len(tries) == 1:
            error = sqlite3.OperationalError("database or disk is full")
            error.sqlite_errorcode = sqlite3.SQLITE_FULL
            raise error
        return create(store, job)

    async def ask() -> None:
        async with serving(tmp_path, ObedientBackend()) as (_, host, port), httpx2.AsyncClient() as http:
            job = f"http://{host}:{port}/jobs/a"
            assert (await http.put(job, content=b"0 0 0\n")).status_code == 202
            assert (await http.get(job)).json()["bytes"] == 6

    monkeypatch.setattr(JobStore, "create", full_at_first)
    asyncio.run(ask())
    assert len(tries) == 2
    assert tries[0] == tries[1]
    assert (tmp_path / "jobs" / tries[0] / "input").read_bytes() == b"0 0 0\n"
    assert not list((tmp_path / "incoming").iterdir())


def test_a_server_starts_on_a_full_disk_and_makes_room_by_what_is_over_its_time(tmp_path: Path) -> None:
    (data := tmp_path / "data").mkdir()
    holder = subprocess.Popen([*ON_A_SMALL_DISK, str(data), "sleep", "600"])  # of the disk, between two servers
    try:
        within = ("nsenter", "--target", str(holder.pid), "--user", "--mount", "--preserve-credentials")
        disk = Path(f"/proc/{holder.pid}/root{data}")
        if not _is_mounted(holder, disk):
            pytest.skip("this machine lets us mount nothing")
        settings = {"STRAIGHTPCF_MIN_FREE_BYTES": "0", "STRAIGHTPCF_RESULT_TTL_SECONDS": "1"}
        with run_server(tmp_path, environment=settings, within=within) as server:
            httpx2.put(f"{server.url}/jobs/old?iterations=1", content=bytes(2**16))  # no cloud: it fails
            assert httpx2.get(f"{server.url}/jobs/old?wait=60", timeout=90).json()["state"] == "failed"
        time.sleep(1)
        assert list((disk / "jobs").iterdir())
        with filled(disk), run_server(tmp_path, environment=settings, within=within) as server:
            assert httpx2.get(f"{server.url}/jobs/old").json()["state"] == "expired"
            assert not list((disk / "jobs").iterdir())
            assert (disk / RESERVE).stat().st_size == RESERVE_BYTES
            assert "Traceback" not in server.log.read_text()
    finally:
        holder.kill()
        holder.wait()


def _is_mounted(holder: subprocess.Popen[bytes], disk: Path) -> bool:
    while holder.poll() is None:
        with suppress(OSError):
            if disk.stat().st_dev != disk.parent.stat().st_dev:
                return True
        time.sleep(0.02)
    return False


def test_a_worker_whose_files_find_no_room_says_so(tmp_path: Path) -> None:
    np.save(cloud := tmp_path / "cloud.npy", noisy(torus(400), 0.01))
    job = FileJob(
        id="1", source=cloud, target=tmp_path / "result", options=DenoiseOptions(iterations=1), max_points=1000,
        patches=Path("/dev/full"),
    )  # fmt: skip
    ours, theirs = Pipe()
    with ours, theirs:
        assert _answer(load_filter(device="cpu"), job, theirs) == Failed("1", "spool_full", "the server's disk is full")


def test_a_file_that_the_system_lets_grow_no_further_finds_no_room_either(shared_server: RunningServer) -> None:
    """As under systemd's LimitFSIZE or `ulimit -f`; a disk's own limit (FAT) is the same error."""
    pid = shared_server.process.pid
    soft, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (2**22, hard))
    try:
        url = f"{shared_server.url}/denoise?filename=a.xyz"
        answer = httpx2.post(url, content=b"1 2 3\n" * (2**20), timeout=60)
    finally:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (soft, hard))
    assert (answer.status_code, answer.json()["code"]) == (507, "spool_full")
    assert not shared_server.spooled_files()
