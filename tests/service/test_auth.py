"""Who is let in, and when again."""

from __future__ import annotations

from pathlib import Path

import pytest

from straightpcf.clients.sdk import AsyncClient
from straightpcf.points.errors import JobNotFinished, RateLimited
from straightpcf.service.api.auth import Gate
from tests.service.in_process import free_port, serving
from tests.service.test_races import CLOUD, play, willing


def test_who_asks_too_often_is_told_when_the_next_request_is_granted() -> None:
    gate = Gate((), rate_per_minute=2)
    gate.admit(None)
    gate.admit(None)
    with pytest.raises(RateLimited, match="2 requests a minute") as refused:
        gate.admit(None)
    assert refused.value.retry_after == 30


@pytest.mark.parametrize("scheme", ["http", "grpc"])
def test_who_asks_too_often_may_still_end_what_was_begun(tmp_path: Path, scheme: str) -> None:
    """The client's farewell is one request, which it makes once: refused, the job would run on for nobody."""

    async def scenario() -> None:
        backend, grpc_port = willing(), free_port()
        backend.finish.clear()
        async with serving(tmp_path, backend, rate_per_minute=2, grpc_port=grpc_port) as (engine, host, port):
            url = f"{scheme}://{host}:{port if scheme == 'http' else grpc_port}"
            async with AsyncClient(url) as client:
                with pytest.raises(JobNotFinished):  # by the second request
                    await client.denoise(CLOUD, name="a.xyz", timeout=0.5)
                with pytest.raises(RateLimited):
                    await client.denoise(CLOUD, name="a.xyz", timeout=0.5)
            assert len(backend.canceled) == 1
            assert not (await engine.list())[0]

    play(scenario)


def test_an_upload_that_is_refused_on_its_way_is_told_why(tmp_path: Path) -> None:
    """Of one in a hundred gRPC puts an INTERNAL of its own in the refusal's place (grpc/grpc#36066)."""

    async def scenario() -> None:
        limits = {"rate_per_minute": 1, "grpc_port": (port := free_port())}
        async with (
            serving(tmp_path, willing(), **limits) as (_, host, _),
            AsyncClient(f"grpc://{host}:{port}", max_retries=0) as client,
        ):
            with pytest.raises(RateLimited):  # by the second request
                await client.denoise(CLOUD, name="a.xyz", timeout=30)
            for _ in range(300):
                with pytest.raises(RateLimited):
                    await client.denoise(20_000 * b"0.1 0.2 0.3\n", name="a.xyz", timeout=30)

    play(scenario)
