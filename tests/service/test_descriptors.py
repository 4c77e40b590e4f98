"""A server that has no file descriptor left for a moment, over real sockets."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import pytest

from tests.clouds import noisy, torus
from tests.conftest import RunningServer
from tests.service.rest import npy

if not hasattr(resource, "prlimit"):
    pytest.skip("only Linux limits another process", allow_module_level=True)

CLOUD = npy(noisy(torus(300), 0.01))


@contextmanager
def no_descriptor_left(server: RunningServer) -> Iterator[None]:
    """Keep a server from opening anything; what is open stays so."""
    pid, kind = server.process.pid, resource.RLIMIT_NOFILE
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
