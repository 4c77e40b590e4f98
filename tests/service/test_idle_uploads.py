"""A body that stops coming: what it held is given back."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from tests.service.engines import until
from tests.service.in_process import free_port, serving
from tests.service.test_races import CLOUD, play, willing

FORM = b'--b\r\nContent-Disposition: form-data; name="file"; filename="a.xyz"\r\n\r\n' + CLOUD
HEAD = b"POST /jobs?%b HTTP/1.1\r\nHost: localhost\r\n%b\r\n"
LENGTH, CHUNKED = b"Content-Length: 100000\r\n", b"Transfer-Encoding: chunked\r\n"
IS_FORM = b"Content-Type: multipart/form-data; boundary=b\r\n"
STOPPED = {
    "raw": HEAD % (b"filename=a.xyz", LENGTH) + CLOUD,
    "chunked": HEAD % (b"filename=a.xyz", CHUNKED) + b"%x\r\n%b\r\n" % (len(CLOUD), CLOUD),
    "form": HEAD % (b"", IS_FORM + LENGTH) + FORM,
    "nothing": HEAD % (b"filename=a.xyz", LENGTH),
}


@pytest.mark.parametrize("case", STOPPED)
def test_a_body_that_stops_coming_is_408_and_leaves_nothing(tmp_path: Path, case: str) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing(), upload_idle_seconds=0.5) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(STOPPED[case])
            await until(lambda: any((tmp_path / "incoming").iterdir()))
            answer = await asyncio.wait_for(reader.read(), timeout=4)  # to the end: the server closes
            writer.close()
            head, body = answer.split(b"\r\n\r\n", 1)
            assert head.startswith(b"HTTP/1.1 408 ")
            assert b"content-type: application/problem+json" in head.lower()
            problem = json.loads(body)
            assert (problem["code"], problem["retryable"]) == ("request_timeout", True)
            assert "0.5 s" in problem["detail"]
            assert not any((tmp_path / "incoming").iterdir())

    play(scenario)


def test_a_body_that_comes_slowly_is_taken(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing(), upload_idle_seconds=0.5) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(HEAD % (b"filename=a.xyz", b"Connection: close\r\nContent-Length: %d\r\n" % len(CLOUD)))
            for at in range(0, len(CLOUD), step := -(-len(CLOUD) // 4)):  # for longer than the limit, all in all
                await asyncio.sleep(0.2)
                writer.write(CLOUD[at : at + step])
            assert (await reader.read()).startswith(b"HTTP/1.1 202 ")
            writer.close()

    play(scenario)


@pytest.mark.parametrize("parts", [0, 1, 2])
@pytest.mark.parametrize("kind", ["CreateJob", "Denoise"])
def test_a_grpc_upload_that_stops_passes_its_deadline_and_leaves_nothing(tmp_path: Path, kind: str, parts: int) -> None:
    grpc = pytest.importorskip("grpc")
    from straightpcf.points.wire import straightpcf_pb2 as pb
    from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub

    job = pb.JobConfig(filename="a.xyz")
    of_create = [pb.CreateJobRequest(config=job), pb.CreateJobRequest(chunk=CLOUD)]
    of_denoise = [pb.DenoiseRequest(config=pb.DenoiseConfig(job=job)), pb.DenoiseRequest(chunk=CLOUD)]

    async def stopped() -> AsyncIterator[Any]:
        for part in (of_create if kind == "CreateJob" else of_denoise)[:parts]:
            yield part
        await asyncio.sleep(60)

    async def scenario() -> None:
        async with (
            serving(tmp_path, willing(), grpc_port=(port := free_port()), upload_idle_seconds=0.5) as (_, host, _),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
        ):
            call: Any = getattr(DenoiseServiceStub(channel), kind)(stopped())
            with pytest.raises(grpc.RpcError) as caught:
                await (call if kind == "CreateJob" else call.read())
            assert caught.value.code().name == "DEADLINE_EXCEEDED"
            assert "0.5 s" in caught.value.details()
            assert not any((tmp_path / "incoming").iterdir())

    play(scenario)
