"""What gRPC itself, or a proxy, refuses has none of our codes; the SDK's errors are those of REST all the same."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from straightpcf.clients.sdk import AsyncClient, Client
from straightpcf.points.errors import RateLimited, ServerBusy, TooManyBytes
from tests.clouds import noisy, torus
from tests.conftest import RunningServer

grpc = pytest.importorskip("grpc")

SERVICE = "straightpcf.v1.DenoiseService"


@contextmanager
def answering(method: Callable[..., Any], *, takes: int = -1) -> Iterator[str]:
    """Serve CreateJob alone, with messages of so many bytes at most."""
    handlers = {"CreateJob": grpc.stream_unary_rpc_method_handler(method)}
    server = grpc.server(ThreadPoolExecutor(2), options=[("grpc.max_receive_message_length", takes)])
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler(SERVICE, handlers)])
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield f"grpc://127.0.0.1:{port}"
    finally:
        server.stop(None)


def read_all(requests: Iterator[bytes], context: Any) -> bytes:
    return b"".join(requests)


def test_a_message_that_grpc_itself_refuses_is_too_many_bytes() -> None:
    cloud = noisy(torus(4000), 0.01)
    with answering(read_all, takes=1000) as url:
        said = rf"^{url}: 65\d{{3}} bytes at once; the limit is 1000 \(SERVER: Received message larger than max"
        with Client(url) as client, pytest.raises(TooManyBytes, match=said):
            client.jobs.create(cloud)

        async def ask() -> None:
            async with AsyncClient(url) as client:
                await client.jobs.create(cloud)

        with pytest.raises(TooManyBytes, match=said):
            asyncio.run(ask())


@pytest.mark.parametrize(
    ("details", "kind"),
    [
        ("received metadata size exceeds hard limit (value length 20000 vs. 16384)", TooManyBytes),
        ("received metadata size exceeds hard limit (20014 vs. 16384)", TooManyBytes),
        ("grpc: received message larger than max (5000000 vs. 4194304)", TooManyBytes),  # of a proxy in Go
        ("too many requests", ServerBusy),
    ],
)
def test_what_a_proxy_refuses_for_now_is_not_taken_for_what_is_too_large(details: str, kind: type[Exception]) -> None:
    asked = []

    def refuse(requests: Iterator[bytes], context: Any) -> None:
        asked.append(context)
        context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, details)

    with answering(refuse) as url, Client(url, max_retries=1) as client, pytest.raises(kind) as found:
        client.jobs.create(noisy(torus(400), 0.01))

    assert len(asked) == 1 + (kind is ServerBusy)
    assert details in str(found.value)


def test_the_error_says_when_the_server_wants_to_be_asked_again() -> None:
    from google.protobuf.any_pb2 import Any as AnyMessage
    from google.protobuf.duration_pb2 import Duration
    from google.rpc import code_pb2, error_details_pb2, status_pb2
    from grpc_status import rpc_status

    status = status_pb2.Status(code=code_pb2.RESOURCE_EXHAUSTED, message="30 a minute")
    info = error_details_pb2.ErrorInfo(reason="RATE_LIMITED", domain="straightpcf")
    for detail in (info, error_details_pb2.RetryInfo(retry_delay=Duration(seconds=7))):
        (packed := AnyMessage()).Pack(detail)
        status.details.append(packed)

    def refuse(requests: Iterator[bytes], context: Any) -> None:
        context.abort_with_status(rpc_status.to_status(status))

    with answering(refuse) as url, Client(url, max_retries=0) as client, pytest.raises(RateLimited) as found:
        client.jobs.create(noisy(torus(400), 0.01))
    assert found.value.retry_after == 7


def test_a_cloud_that_is_not_filtered_has_no_patches_and_they_do_not_break_off(server: RunningServer) -> None:
    async def there(id: str) -> list[object]:
        async with AsyncClient(server.grpc_url, max_retries=0) as client:
            return [frame async for frame in (await client.jobs.get(id)).patches()]

    with Client(server.grpc_url, max_retries=0) as client:
        job = client.jobs.create(np.ones((100, 3)))  # all in one place
        assert list(job.patches()) == asyncio.run(there(job.id)) == []
        assert job.refresh().state == "succeeded"
        job.delete()
