"""A server that hangs in the middle of a call is given up after the client's timeout, over both wires alike."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any

import grpc
import numpy as np
import pytest

from straightpcf.clients.sdk import AsyncClient, AsyncJob, Client, Job, request
from straightpcf.clients.sdk.job_info import JobInfo
from straightpcf.clients.sdk.silence import Silence
from straightpcf.points.errors import ConnectionFailed
from straightpcf.points.wire import straightpcf_pb2 as pb
from straightpcf.points.wire.straightpcf_pb2_grpc import (
    DenoiseServiceServicer,
    add_DenoiseServiceServicer_to_server,
)

SMALL = np.zeros((50, 3))
LARGE = np.zeros((500_000, 3))  # more than what a connection holds while nobody takes it
SUCCEEDED: dict[str, Any] = {
    "id": "a", "state": "succeeded", "name": None, "format": None, "bytes": 1, "points": 50, "progress": 1.0,
    "attempts": 1, "position": None, "created_at": "2026-01-01T00:00:00.000Z", "started_at": None, "finished_at": None,
    "expires_at": None, "error": None, "links": {},
    "options": {"iterations": 1, "seed": 0, "strength": 1.0, "normals": "keep"},
    "result": {"bytes": 10, "sha256": "0" * 64, "media_type": "text/plain", "filename": "a.xyz", "format": "xyz"},
    "report": {
        "points": 50, "untouched": 0, "iterations": 1, "noise_before": 0.1, "noise_after": 0.1, "distances": [],
        "displacement": {"p50": 0.0, "p90": 0.0, "p99": 0.0, "max": 0.0, "mean": 0.0}, "seconds": 1.0,
        "timings": {"read": 0.0, "filter": 0.0, "write": 0.0}, "warnings": [], "format": "xyz", "device": "cpu",
    },
}  # fmt: skip


class Hanging(DenoiseServiceServicer):  # type: ignore[misc]
    def __init__(self) -> None:
        self.may_end = Event()

    def CreateJob(self, requests: Iterator[Any], context: Any) -> pb.Job:  # noqa: N802
        next(requests)
        self.may_end.wait(30)
        return pb.Job()

    def WatchJob(self, request: Any, context: Any) -> Iterator[pb.JobEvent]:  # noqa: N802
        self.may_end.wait(30)
        yield from ()

    def DownloadResult(self, request: Any, context: Any) -> Iterator[pb.DownloadResultResponse]:  # noqa: N802
        yield pb.DownloadResultResponse(result=pb.ResultInfo(bytes=10, sha256="0" * 64))
        self.may_end.wait(30)


@pytest.fixture(params=["http", "grpc"])
def url(request: pytest.FixtureRequest) -> Iterator[str]:
    """Serve somebody who takes connections and calls, and answers none."""
    if request.param == "http":
        with socket.create_server(("127.0.0.1", 0)) as listener:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        return
    service = Hanging()
    server = grpc.server(ThreadPoolExecutor(8))
    add_DenoiseServiceServicer_to_server(service, server)  # type: ignore[no-untyped-call]
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"grpc://127.0.0.1:{port}"
    service.may_end.set()
    server.stop(grace=0).wait()


@pytest.mark.parametrize("call", ["small", "large", "result", "events"])
@pytest.mark.parametrize("is_async", [False, True])
def test_a_server_that_hangs_is_given_up_after_the_timeout(
    url: str, call: str, monkeypatch: pytest.MonkeyPatch, *, is_async: bool
) -> None:
    monkeypatch.setattr(request, "STREAM_SECONDS", 0.4)
    job = JobInfo.parse(SUCCEEDED)
    cloud = SMALL if call == "small" else LARGE

    async def ask_there() -> None:
        async with AsyncClient(url, timeout=0.4, max_retries=0) as client:
            there = AsyncJob(client._transport, job)
            if call == "events":
                _ = [event async for event in there.events()]
            else:
                await (there.result() if call == "result" else client.jobs.create(cloud))

    def ask() -> None:
        with Client(url, timeout=0.4, max_retries=0) as client:
            there = Job(client._transport, job)
            if call == "events":
                list(there.events())
            else:
                _ = there.result() if call == "result" else client.jobs.create(cloud)

    began = time.monotonic()
    with pytest.raises(ConnectionFailed):
        asyncio.run(asyncio.wait_for(ask_there(), 20)) if is_async else ask()
    assert 0.3 < time.monotonic() - began < 10


def test_what_this_side_does_is_not_the_other_sides_silence() -> None:
    cancelled = Event()

    class Call:
        def cancel(self) -> None:
            cancelled.set()

    silence = Silence(0.1)
    silence.ours()
    with silence.watched(Call()):
        assert not cancelled.wait(0.5)
        silence.theirs()
        assert cancelled.wait(5)
    assert silence.was_too_long
