"""gRPC where two things happen at one moment: a cancelled call, a result that is deleted, a server that ends."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

grpc = pytest.importorskip("grpc")

from google.protobuf.empty_pb2 import Empty  # noqa: E402

from straightpcf.points.errors import MalformedFile  # noqa: E402
from straightpcf.points.wire import straightpcf_pb2 as pb  # noqa: E402
from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub  # noqa: E402
from straightpcf.service.api import grpc as grpc_calls  # noqa: E402
from straightpcf.service.api import grpc_call  # noqa: E402
from straightpcf.service.engine import Engine  # noqa: E402
from tests.service.engines import until  # noqa: E402
from tests.service.fakes import Large, ObedientBackend  # noqa: E402
from tests.service.in_process import free_port, serving  # noqa: E402
from tests.service.test_races import CLOUD, Commit, nothing_is_left, play, willing  # noqa: E402

JOB = pb.JobConfig(filename="a.xyz")


async def denoise_parts() -> AsyncIterator[Any]:
    yield pb.DenoiseRequest(config=pb.DenoiseConfig(job=JOB, return_file=True))
    yield pb.DenoiseRequest(chunk=CLOUD)


async def create_parts(*, stall: bool = False) -> AsyncIterator[Any]:
    yield pb.CreateJobRequest(config=JOB)
    yield pb.CreateJobRequest(chunk=CLOUD)
    if stall:
        await asyncio.sleep(60)


def test_a_call_that_is_cancelled_while_its_job_is_committed_leaves_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = Commit(monkeypatch)

    async def scenario() -> None:
        async with (
            serving(tmp_path, ObedientBackend(), grpc_port=(port := free_port())) as (engine, host, _),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
        ):
            call = DenoiseServiceStub(channel).Denoise(denoise_parts())
            await commit.left_alone(call.cancel)
            await nothing_is_left(engine)

    play(scenario)


def test_a_job_that_is_deleted_by_either_transport_while_its_file_is_on_its_way_is_none(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with (
            serving(tmp_path, willing(), grpc_port=(port := free_port())) as (engine, host, http),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
            httpx2.AsyncClient(base_url=f"http://{host}:{http}") as client,
        ):
            stub = DenoiseServiceStub(channel)
            calls: dict[str, Any] = {id: stub.CreateJob() for id in ("a", "b")}
            for id, call in calls.items():
                await call.write(pb.CreateJobRequest(config=pb.JobConfig(id=id, filename="a.xyz")))
                await call.write(pb.CreateJobRequest(chunk=CLOUD))
            await until(lambda: len(list((tmp_path / "incoming").iterdir())) == len(calls))
            assert (await client.delete("/jobs/a")).status_code == 204
            await stub.DeleteJob(pb.DeleteJobRequest(id="b"))
            for call in calls.values():
                await call.done_writing()
                with pytest.raises(grpc.RpcError) as caught:
                    await call
                assert caught.value.code().name == "NOT_FOUND"
            await nothing_is_left(engine)

    play(scenario)


@pytest.mark.parametrize("kind", ["Denoise", "DownloadResult"])
def test_a_result_that_is_deleted_before_it_is_opened_is_not_found(
    tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        async with (
            serving(tmp_path, willing(), grpc_port=(port := free_port())) as (engine, host, _),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
        ):
            stub = DenoiseServiceStub(channel)
            job = await stub.CreateJob(create_parts())
            await engine.wait(job.id)
            _delete_between(engine)
            call: Any = stub.DownloadResult(pb.DownloadResultRequest(id=job.id))
            if kind == "Denoise":
                call = stub.Denoise(denoise_parts())
            with pytest.raises(grpc.RpcError) as caught:
                _ = [answer async for answer in call]
            assert caught.value.code().name == "NOT_FOUND"

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]


def test_who_follows_a_job_that_is_deleted_is_told_so_and_not_that_this_was_all(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with (
            serving(tmp_path, willing(), grpc_port=(port := free_port())) as (engine, host, http),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
            httpx2.AsyncClient(base_url=f"http://{host}:{http}") as client,
        ):
            stub = DenoiseServiceStub(channel)
            look = engine._same

            async def looked_and_lost(id: str, owner: str, folder: str | None) -> Any:
                record = await look(id, owner, folder)
                engine._same = look  # type: ignore[method-assign]
                await engine.delete(id, owner=owner)
                return record

            for is_rest in (False, True):
                job = await stub.CreateJob(create_parts())
                await engine.wait(job.id)
                engine._same = looked_and_lost  # type: ignore[method-assign]
                if is_rest:  # 204 would say that its end was told before
                    assert (await client.get(f"/jobs/{job.id}/events")).status_code == 404
                    continue
                with pytest.raises(grpc.RpcError) as caught:
                    _ = [event async for event in stub.WatchJob(pb.WatchJobRequest(id=job.id))]
                assert caught.value.code().name == "NOT_FOUND"

    play(scenario)


def _delete_between(engine: Engine) -> None:
    found = engine.result

    async def found_and_lost(id: str, *, owner: str = "") -> Any:
        result = await found(id, owner=owner)
        await engine.delete(id, owner=owner)
        return result

    engine.result = found_and_lost  # type: ignore[method-assign]


def test_an_upload_that_does_not_end_is_told_so_before_the_server_does(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with (
            serving(tmp_path, willing(), grpc_port=(port := free_port()), shutdown_seconds=2) as (engine, host, _),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
        ):
            call: Any = DenoiseServiceStub(channel).CreateJob(create_parts(stall=True))
            await until(lambda: any((tmp_path / "incoming").iterdir()))
            engine.drain()
            with pytest.raises(grpc.RpcError) as caught:
                await call
            assert caught.value.code().name == "UNAVAILABLE"
            assert "shutting down" in caught.value.details()
            assert not any((tmp_path / "incoming").iterdir())

    play(scenario)


def test_a_deadline_that_meets_a_slow_reader_is_no_fault_of_the_server(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    backend = willing(Large())

    async def scenario() -> None:
        async with (
            serving(tmp_path, backend, grpc_port=(port := free_port())) as (engine, host, http_port),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
        ):
            stub = DenoiseServiceStub(channel)
            job = await stub.CreateJob(create_parts())
            await engine.wait(job.id)
            for _ in range(4):
                call: Any = stub.DownloadResult(pb.DownloadResultRequest(id=job.id), timeout=0.3)
                await call.read()
                await asyncio.sleep(0.5)
                assert await call.code() == grpc.StatusCode.DEADLINE_EXCEEDED
            metrics = await asyncio.to_thread(httpx2.get, f"http://{host}:{http_port}/metrics")
            told = [line for line in metrics.text.splitlines() if 'requests_total{method="DownloadResult"' in line]
            assert told == ['straightpcf_grpc_requests_total{method="DownloadResult",status="CANCELLED"} 4.0']

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]


def test_a_fault_of_grpc_that_no_caller_made_is_one_of_the_server(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults: list[Exception] = []

    async def two_writes_at_once(service: object, request: object, context: Any) -> None:
        async with service._answering(context, "DownloadResult"):  # type: ignore[attr-defined]
            large = pb.DownloadResultResponse(chunk=bytes(1 << 20))
            while True:  # until a write waits for the caller, who does not read yet
                waiting = asyncio.create_task(context.write(large))
                if not (await asyncio.wait([waiting], timeout=0.5))[0]:
                    break
            try:
                await context.write(large)
            except grpc.aio.InternalError as fault:
                faults.append(fault)
                raise
            finally:
                await waiting

    monkeypatch.setattr(grpc_calls.DenoiseService, "DownloadResult", two_writes_at_once)
    monkeypatch.setattr(grpc_call, "_CANCELLED_WITHIN_SECONDS", 0.1)

    async def scenario() -> None:
        async with (
            serving(tmp_path, willing(), grpc_port=(port := free_port())) as (_, host, _),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
        ):
            call: Any = DenoiseServiceStub(channel).DownloadResult(pb.DownloadResultRequest())
            await until(lambda: faults)
            with pytest.raises(grpc.RpcError) as caught:
                _ = [answer async for answer in call]
            assert caught.value.code().name == "INTERNAL"
            assert "the server met an error of its own" in caught.value.details()

    play(scenario)
    assert [record for record in caplog.records if record.exc_info and "DownloadResult failed" in record.message]


@pytest.mark.parametrize("letter", ["q", "点"])
def test_an_error_of_any_length_arrives_as_what_it_is(tmp_path: Path, letter: str) -> None:
    text = letter * 20_000
    backend = willing(ObedientBackend(MalformedFile(text)))

    async def scenario() -> None:
        async with (
            serving(tmp_path, backend, grpc_port=(port := free_port())) as (engine, host, _),
            grpc.aio.insecure_channel(f"{host}:{port}") as channel,
        ):
            stub = DenoiseServiceStub(channel)
            with pytest.raises(grpc.RpcError) as caught:
                _ = [answer async for answer in stub.Denoise(denoise_parts())]
            assert caught.value.code().name == "INVALID_ARGUMENT"
            assert text.startswith(caught.value.details())
            assert len(caught.value.details()) >= 500
            backend.outcomes.append(MalformedFile(text))
            job = await stub.CreateJob(create_parts())
            record = await engine.wait(job.id)
            assert record.error is not None
            assert record.error.message == text[:1000]

    play(scenario)


@pytest.mark.slow
def test_calls_that_a_busy_server_has_not_taken_within_half_a_minute_wait_on(tmp_path: Path) -> None:
    def ask(port: int) -> list[str]:
        with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
            calls = [DenoiseServiceStub(channel).GetServerInfo.future(Empty()) for _ in range(20)]
            return [call.code().name for call in calls]

    async def scenario() -> None:
        async with serving(tmp_path, ObedientBackend(), grpc_port=(port := free_port())):
            codes = asyncio.get_running_loop().run_in_executor(None, ask, port)  # begins at once
            time.sleep(36)  # the event loop is held up; gRPC's own threads go on
            assert set(await codes) == {"OK"}

    asyncio.run(scenario())
