"""A server that has no file descriptor left for a moment, over real sockets."""

from __future__ import annotations

import asyncio
import os
import resource
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import pytest

from tests.clouds import noisy, torus
from tests.conftest import RunningServer
from tests.service.engines import until
from tests.service.in_process import serving
from tests.service.rest import npy
from tests.service.test_races import play, willing

if not hasattr(resource, "prlimit"):
    pytest.skip("only Linux limits another process", allow_module_level=True)

CLOUD = npy(noisy(torus(300), 0.01))


@contextmanager
def no_descriptor_left(server: RunningServer) -> Iterator[None]:
    """Keep a server from opening anything; what is open stays so."""
    with _at_most_as_many_as_now(server.process.pid):
        yield


@contextmanager
def _at_most_as_many_as_now(pid: int) -> Iterator[None]:
    kind = resource.RLIMIT_NOFILE
    before = resource.prlimit(pid, kind)
    used = {int(path.name) for path in Path(f"/proc/{pid}/fd").iterdir()}
    resource.prlimit(pid, kind, (min(set(range(len(used) + 1)) - used), before[1]))
    try:
        yield
    finally:
        resource.prlimit(pid, kind, before)


def test_a_request_for_which_no_descriptor_is_left_may_be_sent_again(server: RunningServer) -> None:
    with httpx2.Client(base_url=server.url, timeout=60) as http:
        id = http.post("/jobs?iterations=1", content=CLOUD).json()["id"]
        assert http.get(f"/jobs/{id}?wait=60").json()["state"] == "succeeded"
        with no_descriptor_left(server):
            refused = [
                http.post("/jobs?iterations=1", content=CLOUD),
                http.post("/denoise?iterations=1", content=CLOUD),
                http.get(f"/jobs/{id}/result"),
            ]
        for answer in refused:
            problem = answer.json()
            assert (answer.status_code, problem["code"], problem["retryable"]) == (503, "server_busy", True)
            assert answer.headers["retry-after"]
        assert http.get(f"/jobs/{id}/result").status_code == 200
        assert http.post("/denoise?iterations=1", content=CLOUD).status_code == 200


def test_a_call_for_which_no_descriptor_is_left_may_be_made_again(server: RunningServer) -> None:
    grpc = pytest.importorskip("grpc")
    from straightpcf.points.wire import straightpcf_pb2 as pb
    from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub

    parts = [pb.CreateJobRequest(config=pb.JobConfig()), pb.CreateJobRequest(chunk=CLOUD)]
    with grpc.insecure_channel(server.grpc_url.removeprefix("grpc://")) as channel:
        stub = DenoiseServiceStub(channel)
        stub.ListJobs(pb.ListJobsRequest())  # connects
        with no_descriptor_left(server), pytest.raises(grpc.RpcError) as caught:
            stub.CreateJob(iter(parts))
        assert caught.value.code().name == "UNAVAILABLE"
        assert stub.CreateJob(iter(parts)).id


def test_connections_that_wait_for_a_descriptor_are_a_line_of_the_log_and_taken_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("asyncio.constants.ACCEPT_RETRY_DELAY", 0.05)

    async def scenario() -> None:
        async with serving(tmp_path, willing()) as (_, host, port):
            with socket.socket() as waiting:  # which has its own descriptor by now
                waiting.setblocking(False)
                with _at_most_as_many_as_now(os.getpid()):
                    await asyncio.get_running_loop().sock_connect(waiting, (host, port))
                    await until(lambda: "connections wait: Too many open files" in caplog.text)
                reader, writer = await asyncio.open_connection(sock=waiting)
                writer.write(b"GET /livez HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
                assert b" 200 OK" in await asyncio.wait_for(reader.read(), timeout=10)
                writer.close()
                await asyncio.sleep(0.1)  # attempts of asyncio that are still due want the socket, and say so

    play(scenario)
    told = [record for record in caplog.records if record.levelname in ("WARNING", "ERROR")]
    assert [record.getMessage().partition(" (")[0] for record in told] == ["connections wait: Too many open files"]
    assert not any(record.exc_info for record in told)
