"""What those who wait for a job are told of it when its server ends."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

grpc = pytest.importorskip("grpc")

from straightpcf.points.wire import straightpcf_pb2 as pb  # noqa: E402
from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub  # noqa: E402
from tests.service.fakes import ObedientBackend  # noqa: E402
from tests.service.in_process import free_port, serving  # noqa: E402


async def parts(id: str) -> AsyncIterator[Any]:
    yield pb.DenoiseRequest(config=pb.DenoiseConfig(job=pb.JobConfig(id=id)))
    yield pb.DenoiseRequest(chunk=b"0 0 0\n" * 50)


@pytest.mark.parametrize(("id", "kept"), [("", 0), ("mine", 1)])
def test_a_denoise_call_is_told_the_truth_about_its_job(tmp_path: Path, id: str, kept: int) -> None:
    async def scenario() -> None:
        async with (
            serving(tmp_path, ObedientBackend(), grpc_port=(port := free_port())) as (engine, host, _),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
        ):
            answers: Any = DenoiseServiceStub(channel).Denoise(parts(id))
            assert (await answers.read()).WhichOneof("part") == "accepted"
            engine.drain()
            with pytest.raises(grpc.RpcError) as caught:
                await answers.read()
            assert caught.value.code().name == "UNAVAILABLE"
            assert "a job goes on when it is back, unless it ends with its call" in caught.value.details()
            assert len((await engine.list())[0]) == kept

    asyncio.run(asyncio.wait_for(scenario(), timeout=30))
