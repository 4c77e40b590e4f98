"""A request that comes again: by the id or the key of the job that it made."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx2
import pytest

from straightpcf.points.errors import IdConflict, MalformedFile, ServerBusy, SpoolFull
from straightpcf.service.engine import Engine
from tests.conftest import RunningServer, run_server
from tests.service.engines import kinds, play, submit
from tests.service.fakes import ObedientBackend
from tests.waiting import wait_for

BODY = b"0 0 0\n" * 50


@pytest.fixture(scope="module")
def full_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A server that takes one job, whose worker never comes to it."""
    folder = tmp_path_factory.mktemp("full")
    with run_server(folder, "--grpc-port", "0", "--max-jobs", "1") as server:
        wait_for(lambda: _suspended(server))
        yield server
        os.kill(server.worker_pid(), signal.SIGKILL)


def _suspended(server: RunningServer) -> bool:
    with suppress(AssertionError, OSError):
        os.kill(server.worker_pid(), signal.SIGSTOP)
        return True
    return False


@pytest.fixture
def http(full_server: RunningServer) -> Iterator[httpx2.Client]:
    full_server.delete_jobs()
    with httpx2.Client(base_url=full_server.url, timeout=20) as client:
        yield client


@pytest.mark.parametrize("key", [{}, {"Idempotency-Key": "k"}])
@pytest.mark.parametrize(("method", "path"), [("PUT", "/jobs/one"), ("POST", "/jobs")])
def test_a_repeat_of_what_was_accepted_is_answered_where_another_is_refused(
    http: httpx2.Client, method: str, path: str, key: dict[str, str]
) -> None:
    first = http.request(method, path, content=BODY, headers=key)
    assert first.status_code == 202
    again = http.request(method, path, content=BODY, headers=key)
    if method == "PUT" or key:
        assert (again.status_code, again.json()["id"]) == (200, first.json()["id"])
    else:
        assert again.status_code == 503
    for refused in (http.put("/jobs/two", content=BODY), http.post("/jobs", content=BODY)):
        assert (refused.status_code, refused.json()["code"]) == (503, "server_busy")


def test_grpc_answers_a_repeat_too(full_server: RunningServer, http: httpx2.Client) -> None:
    grpc = pytest.importorskip("grpc")
    from straightpcf.points.wire import straightpcf_pb2 as pb
    from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub

    with grpc.insecure_channel(full_server.grpc_url.removeprefix("grpc://")) as channel:

        def create(id: str = "", key: str = "") -> Any:
            parts = [pb.CreateJobRequest(config=pb.JobConfig(id=id)), pb.CreateJobRequest(chunk=BODY)]
            metadata = (("idempotency-key", key),) if key else ()
            return DenoiseServiceStub(channel).CreateJob(iter(parts), metadata=metadata)

        assert create(id="one").id == create(id="one").id == "one"
        with pytest.raises(grpc.RpcError) as refused:
            create(id="two")
        assert refused.value.code() == grpc.StatusCode.UNAVAILABLE
        http.delete("/jobs/one")
        assert create(key="k").id == create(key="k").id


def test_a_format_is_one_in_any_letters(http: httpx2.Client) -> None:
    first = http.put("/jobs/one?filename=a.xyz&format=PLY&iterations=AUTO", content=BODY)
    again = http.put("/jobs/one?filename=a.xyz&format=ply&iterations=auto", content=BODY)
    assert (first.status_code, again.status_code) == (202, 200)
    assert first.json()["format"] == "ply"


def test_a_key_finds_its_job_whatever_the_id(http: httpx2.Client) -> None:
    # The SDK chooses an id for every call, so that it can cancel what it never heard of.
    key = {"Idempotency-Key": "k"}
    assert http.put("/jobs/ida", content=BODY, headers=key).status_code == 202
    again = http.put("/jobs/idb", content=BODY, headers=key)
    assert (again.status_code, again.json()["id"]) == (200, "ida")


def test_a_repeat_takes_no_room_on_the_disk_either(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        made = [(await submit(engine, **named))[0].id for named in ({"id": "one"}, {"idempotency_key": "k"})]
        for named in ({"id": "two"}, {"id": "one", "owner": "another"}):
            with pytest.raises(SpoolFull):
                await engine.check_room(size=6, **named)
        for named, id in zip(({"id": "one"}, {"idempotency_key": "k"}), made, strict=True):
            await engine.check_room(size=6, **named)
            record, created = await submit(engine, **named)
            assert (record.id, created) == (id, False)
        engine.drain()
        with pytest.raises(ServerBusy):
            await engine.check_room(id="one")

    play(tmp_path, scenario, max_spool_bytes=30)


@pytest.mark.parametrize("named", [{"id": "one"}, {"idempotency_key": "k"}, {"id": "one", "idempotency_key": "k"}])
def test_a_job_that_failed_for_want_of_room_is_made_anew_by_the_same_request(
    tmp_path: Path, named: dict[str, str]
) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        first, _ = await submit(engine, **named)
        failed = await engine.wait(first.id)
        assert isinstance(failed.error, SpoolFull)
        if "id" in named:
            with pytest.raises(IdConflict):
                await submit(engine, b"1 1 1\n", id="one")
        again, created = await submit(engine, **named)
        assert (created, again.id, again.state, again.attempts) == (True, first.id, "queued", 0)
        assert (await engine.wait(first.id)).state == "succeeded"
        assert (await kinds(engine, first.id)).count("completed") == 1
        assert [path.name for path in (tmp_path / "jobs").iterdir()] == [again.folder]
        assert not (await submit(engine, **named))[1]

    play(tmp_path, scenario, SpoolFull("the server's disk is full"))


def test_a_job_that_can_never_succeed_is_found_by_the_same_request(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        first, _ = await submit(engine, id="one")
        assert (await engine.wait(first.id)).state == "failed"
        again, created = await submit(engine, id="one")
        assert (again.state, again.folder, created) == ("failed", first.folder, False)

    play(tmp_path, scenario, MalformedFile("line 3"))
