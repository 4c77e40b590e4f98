"""How a server ends: asked to, or killed."""

from __future__ import annotations

import asyncio
import io
import json
import os
import signal
import socket
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.clouds import noisy, torus
from tests.conftest import run_server
from tests.service.engines import running, submit
from tests.service.fakes import Large
from tests.service.in_process import free_port, serving
from tests.waiting import wait_for


def test_sigterm_lets_the_running_request_finish_and_leaves_nothing(tmp_path: Path) -> None:
    np.save(cloud := tmp_path / "cloud.npy", noisy(torus(400), 0.01))
    with run_server(tmp_path) as server:
        # The request comes before the worker is warm: it waits for it.
        command = ["curl", "-s", "--data-binary", f"@{cloud}", f"{server.url}/denoise?iterations=1"]
        request = subprocess.Popen(command, stdout=subprocess.PIPE)
        wait_for(server.spooled_files)
        worker = server.worker_pid()
        server.process.send_signal(signal.SIGTERM)
        wait_for(lambda: not _listens(server.url))  # as docs/api.md says of a draining server
        assert request.poll() is None
        body, _ = request.communicate(timeout=60)
        assert np.load(io.BytesIO(body)).shape == (400, 3)
        assert server.process.wait(timeout=20) == 0
        assert not _runs(worker)
        assert not server.spooled_files()
        assert "Traceback" not in server.log.read_text()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP], ids=["SIGTERM", "SIGHUP"])
def test_a_signal_to_the_whole_group_lets_the_running_request_finish_too(
    tmp_path: Path, number: signal.Signals
) -> None:
    # As systemd, `timeout` and a terminal that is closed do: the worker is in the server's group.
    np.save(cloud := tmp_path / "cloud.npy", noisy(torus(1500), 0.01))
    with run_server(tmp_path, within=("setsid",)) as server:
        server.wait_until_ready()
        command = ["curl", "-s", "--data-binary", f"@{cloud}", f"{server.url}/denoise?iterations=2"]
        request = subprocess.Popen(command, stdout=subprocess.PIPE)
        wait_for(lambda: list(server.data_dir.glob("jobs/*/patches-1")))
        os.killpg(server.process.pid, number)
        body, _ = request.communicate(timeout=60)
        assert np.load(io.BytesIO(body)).shape == (1500, 3)
        assert server.process.wait(timeout=20) == 0
        assert "starts again" not in server.log.read_text()


def test_who_waits_in_vain_is_told_so_before_a_server_ends(tmp_path: Path) -> None:
    np.save(long := tmp_path / "long.npy", noisy(torus(60_000), 0.01))
    np.save(short := tmp_path / "short.npy", noisy(torus(400), 0.01))
    with run_server(tmp_path, environment={"STRAIGHTPCF_SHUTDOWN_SECONDS": "2"}) as server:
        server.wait_until_ready()
        subprocess.run(["curl", "-s", "-T", long, f"{server.url}/jobs/long?iterations=9"], check=True)
        asked = ("denoise?iterations=1", "jobs/long?wait=60", "jobs/long/events", "jobs/long/stream")
        bodies = (("-T", short), (), (), ())
        curl = ("curl", "-s", "-N", "-o", "/dev/null", "-w", "%{http_code} %{exitcode}")
        waiting = [
            subprocess.Popen([*curl, *body, f"{server.url}/{path}"], stdout=subprocess.PIPE, text=True)
            for path, body in zip(asked, bodies, strict=True)
        ]
        wait_for(lambda: len(list(server.data_dir.glob("jobs/*/input"))) == 2)
        wait_for(lambda: list(server.data_dir.glob("jobs/*/patches-1")))
        time.sleep(0.5)  # for those that leave no trace
        server.process.send_signal(signal.SIGTERM)
        answers = [each.communicate(timeout=30)[0] for each in waiting]
        assert answers == ["202 0", "503 0", "200 0", "200 0"]
        server.process.wait(timeout=20)
        assert "Traceback" not in server.log.read_text()


@pytest.mark.parametrize("busy", [False, True])
def test_a_second_ctrl_c_ends_at_once_and_quietly_and_the_job_is_queued_again(tmp_path: Path, busy: bool) -> None:
    np.save(cloud := tmp_path / "cloud.npy", noisy(torus(60_000), 0.01))
    with run_server(tmp_path, within=("setsid",)) as server:
        if busy:
            server.wait_until_ready()
            subprocess.run(["curl", "-s", "-T", cloud, f"{server.url}/jobs/long?iterations=9"], check=True)
            wait_for(lambda: list(server.data_dir.glob("jobs/*/patches-1")))
        for _ in range(2):  # as a terminal does: the worker, which may be loading, is in the server's group
            os.killpg(server.process.pid, signal.SIGINT)
            time.sleep(0.5 * busy)
        assert server.process.wait(timeout=10) == 130  # not after the 30 s that work may go on
        assert "Traceback" not in server.log.read_text()
        assert len(list(server.data_dir.glob("jobs/*/input"))) == busy


def test_an_upload_that_does_not_end_is_told_so_before_the_server_does(tmp_path: Path) -> None:
    with run_server(tmp_path, environment={"STRAIGHTPCF_SHUTDOWN_SECONDS": "2"}) as server:
        host, port = server.url.removeprefix("http://").split(":")
        forms = (b"", b"Content-Type: multipart/form-data; boundary=b\r\n")
        uploads = [socket.create_connection((host, int(port)), timeout=20) for _ in forms]
        for upload, form in zip(uploads, forms, strict=True):
            upload.sendall(
                b"POST /jobs HTTP/1.1\r\nHost: localhost\r\n" + form + b"Content-Length: 100000\r\n\r\n--b\r\n"
            )
        wait_for(lambda: len(list(server.data_dir.glob("incoming/*"))) == 2)
        server.process.send_signal(signal.SIGTERM)
        for upload in uploads:
            with upload, upload.makefile("rb") as answer:
                said = answer.read()
            assert said.startswith(b"HTTP/1.1 503 ")
            assert b'"code":"server_busy"' in said
        server.process.wait(timeout=20)
        assert not server.spooled_files()
        assert "Traceback" not in server.log.read_text()


def test_a_download_that_does_not_end_is_cut_off_in_time_and_quietly(tmp_path: Path) -> None:
    async def make_a_large_result() -> None:
        backend = Large()
        backend.go.set()
        backend.finish.set()
        async with running(tmp_path / "data", backend) as engine:
            await engine.wait((await submit(engine, id="large"))[0].id)

    asyncio.run(make_a_large_result())
    with run_server(tmp_path, environment={"STRAIGHTPCF_SHUTDOWN_SECONDS": "1"}) as server:
        host, port = server.url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=20) as connection:
            connection.sendall(b"GET /jobs/large/result HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert connection.recv(12) == b"HTTP/1.1 200"
            server.process.send_signal(signal.SIGTERM)
            assert server.process.wait(timeout=20) == 0
        assert "Traceback" not in server.log.read_text()


@pytest.mark.parametrize("over", ["rest", "grpc"])
def test_a_private_job_whose_download_is_cut_off_leaves_nothing(tmp_path: Path, over: str) -> None:
    grpc = pytest.importorskip("grpc")
    from straightpcf.points.wire import straightpcf_pb2 as pb
    from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub

    async def begin(host: str, port: int, grpc_port: int) -> Any:
        """Ask for a result, and read only its beginning; return what closes the connection."""
        if over == "rest":
            reader, writer = await asyncio.open_connection(host, port)
            head = b"POST /denoise?filename=a.xyz HTTP/1.1\r\nHost: localhost\r\nContent-Length: 6\r\n\r\n"
            writer.write(head + b"0 0 0\n")
            assert await reader.readexactly(12) == b"HTTP/1.1 200"
            return writer.close
        config = pb.DenoiseConfig(job=pb.JobConfig(filename="a.xyz"), return_file=True)
        parts = [pb.DenoiseRequest(config=config), pb.DenoiseRequest(chunk=b"0 0 0\n")]
        call = DenoiseServiceStub(channel := grpc.aio.insecure_channel(f"{host}:{grpc_port}")).Denoise(iter(parts))
        while (await call.read()).WhichOneof("part") != "chunk":
            pass
        loop = asyncio.get_running_loop()
        return lambda: loop.create_task(channel.close())

    async def scenario() -> None:
        backend = Large()
        backend.go.set()
        backend.finish.set()
        async with serving(tmp_path, backend, grpc_port=(grpc_port := free_port())) as (engine, host, port):
            close = await begin(host, port, grpc_port)
            assert len((await engine.list())[0]) == 1
        assert not list(tmp_path.glob("jobs/*"))
        if (closing := close()) is not None:
            await closing

    asyncio.run(asyncio.wait_for(scenario(), timeout=60))


def test_kill_9_of_the_server_ends_the_worker_and_the_next_server_does_the_job(tmp_path: Path) -> None:
    np.save(cloud := tmp_path / "cloud.npy", noisy(torus(30_000), 0.01))
    with run_server(tmp_path) as server:
        server.wait_until_ready()
        worker = server.worker_pid()
        command = ["curl", "-s", "--data-binary", f"@{cloud}", f"{server.url}/denoise?iterations=3"]
        request = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        wait_for(lambda: list(server.data_dir.glob("jobs/*/patches-1")))
        server.process.kill()
        assert request.wait(timeout=20) != 0
        deadline = time.monotonic() + 20
        while _runs(worker):
            assert time.monotonic() < deadline, "the worker outlives its server"
            time.sleep(0.05)
    with run_server(tmp_path) as server:
        with urllib.request.urlopen(f"{server.url}/jobs") as answer:
            (job,) = json.load(answer)["jobs"]
        assert job["state"] in ("queued", "starting", "processing")
        subprocess.run(["curl", "-s", "-X", "DELETE", f"{server.url}/jobs/{job['id']}"], check=True)
        assert not server.spooled_files()


def _listens(url: str) -> bool:
    host, port = url.removeprefix("http://").split(":")
    try:
        socket.create_connection((host, int(port)), timeout=5).close()
    except ConnectionRefusedError:
        return False
    return True


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
