"""REST where two things happen at one moment: a result that is deleted, a client that goes away."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest

from straightpcf.service.engine import Engine
from straightpcf.service.jobs.store import JobStore
from tests.service.engines import submit, until
from tests.service.fakes import CONTENT, ObedientBackend
from tests.service.in_process import serving

CLOUD = b"0 0 0\n" * 50
POST = b"POST /denoise?filename=a.xyz HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n%b" % (len(CLOUD), CLOUD)


def play(scenario: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(asyncio.wait_for(scenario(), timeout=20))


def willing(backend: ObedientBackend | None = None) -> ObedientBackend:
    backend = backend or ObedientBackend()
    backend.go.set()
    backend.finish.set()
    return backend


@pytest.mark.parametrize("method", ["GET", "HEAD"])
@pytest.mark.parametrize(("end", "status"), [("deleted", 404), ("expired", 410)])
def test_a_result_that_is_taken_away_before_it_is_opened_is_a_problem(
    tmp_path: Path, method: str, end: str, status: int, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        ttl = 3600.0 if end == "deleted" else 0.01
        async with (
            serving(tmp_path, willing(), result_ttl_seconds=ttl) as (engine, host, port),
            httpx2.AsyncClient(base_url=f"http://{host}:{port}") as http,
        ):
            id = (await http.post("/jobs?filename=a.xyz", content=CLOUD)).json()["id"]
            await engine.wait(id)
            found = engine.result

            async def found_and_lost(id: str, *, owner: str = "") -> Any:
                path, record = await found(id, owner=owner)
                if end == "deleted":
                    await engine.delete(id, owner=owner)
                elif path.exists():
                    await asyncio.sleep(ttl)
                    await engine._call(JobStore.expire)
                    path.unlink()
                return path, record

            engine.result = found_and_lost  # type: ignore[method-assign]
            answer = await http.request(method, f"/jobs/{id}/result")
            assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json")

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize("query", ["", "&report=true"])
def test_a_job_that_someone_else_deletes_during_its_download_leaves_the_connection_whole(
    tmp_path: Path, query: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing()) as (engine, host, port):
            delete = engine.delete

            async def late(id: str, *, owner: str = "") -> None:
                await delete(id, owner=owner)  # someone who was quicker
                await delete(id, owner=owner)

            engine.delete = late  # type: ignore[method-assign]
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(POST.replace(b"a.xyz", b"a.xyz" + query.encode()))
            assert CONTENT in await _answer(reader)
            writer.write(b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert b'"ok"' in await _answer(reader)
            writer.close()

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]


def test_a_client_that_goes_away_while_its_job_is_committed_leaves_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = Commit(monkeypatch)

    async def scenario() -> None:
        async with serving(tmp_path, ObedientBackend()) as (engine, host, port):
            _, writer = await asyncio.open_connection(host, port)
            writer.write(POST)
            await commit.left_alone(writer.close)
            await nothing_is_left(engine)

    play(scenario)


def test_a_job_that_is_deleted_while_its_file_is_on_its_way_is_none(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, ObedientBackend()) as (engine, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            put = POST.replace(b"POST /denoise", b"PUT /jobs/mine")
            writer.write(put[:-6])
            await until(lambda: any((tmp_path / "incoming").iterdir()))
            async with httpx2.AsyncClient(base_url=f"http://{host}:{port}") as http:
                assert (await http.delete("/jobs/mine")).status_code == 204
                assert (await http.delete("/jobs/other")).status_code == 404
            writer.write(put[-6:])
            assert b'"not_found"' in await _answer(reader)
            assert (await engine.list())[0] == []
            writer.write(put)  # the next one is another
            assert b'"mine"' in await _answer(reader)
            writer.close()

    play(scenario)


@asynccontextmanager
async def with_a_finished_job(data_dir: Path) -> AsyncIterator[tuple[Engine, ObedientBackend, httpx2.AsyncClient]]:
    backend = willing()
    async with (
        serving(data_dir, backend) as (engine, host, port),
        httpx2.AsyncClient(base_url=f"http://{host}:{port}") as http,
    ):
        await http.put("/jobs/mine?filename=a.xyz", content=CLOUD)
        await engine.wait("mine")
        yield engine, backend, http


def replacing(engine: Engine, backend: ObedientBackend, moment: Callable[..., Any], *, call: int = 1) -> list[str]:
    """Give a finished job's id to another one around the call of a store's method; return the folders of both."""
    through, folders, calls = engine._call, list[str](), 0

    async def replace() -> None:
        backend.finish.clear()
        folders.append((await engine.get("mine")).folder)
        await engine.delete("mine")
        folders.append((await submit(engine, b"1 1 1\n", id="mine"))[0].folder)

    async def with_another(function: Any, *args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls += function is moment
        if function is not moment or calls != call:
            return await through(function, *args, **kwargs)
        engine._call = through
        if moment is JobStore.result_file:
            await replace()
            return await through(function, *args, **kwargs)
        told = await through(function, *args, **kwargs)
        await replace()
        return told

    engine._call = with_another  # type: ignore[assignment]
    return folders


@pytest.mark.parametrize(
    ("method", "path", "moment"),
    [
        ("GET", "/result", JobStore.result_file), ("GET", "/report", JobStore.result_file),
        ("POST", "/cancel", JobStore.request_cancel), ("DELETE", "", JobStore.request_cancel),
    ],
)  # fmt: skip
def test_what_is_asked_of_a_job_whose_id_is_anothers_by_then_is_not_found(
    tmp_path: Path, method: str, path: str, moment: Callable[..., Any]
) -> None:
    """The other one was deleted in its place, shown for it, or a result it has not yet was a fault of the server."""

    async def scenario() -> None:
        async with with_a_finished_job(tmp_path) as (engine, backend, http):
            folders = replacing(engine, backend, moment)
            answer = await http.request(method, f"/jobs/mine{path}")
            assert (answer.status_code, answer.json()["code"]) == (404, "not_found")
            assert "another" in answer.json()["detail"]
            other = await engine.get("mine")
            assert (other.folder, other.finished) == (folders[1], False)
            await engine.delete("mine")

    play(scenario)


def test_a_jobs_last_event_brings_no_other_job_that_has_its_id_by_then(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with with_a_finished_job(tmp_path) as (engine, backend, http):
            replacing(engine, backend, JobStore.events, call=2)
            told = (await http.get("/jobs/mine/events")).text
            completed = json.loads(told.partition("event: completed\ndata: ")[2])
            assert (completed["state"], completed["bytes"]) == ("succeeded", len(CLOUD))
            await engine.delete("mine")

    play(scenario)


class Commit:
    """Hold a job's commit back, once it is made, until `may_end` is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begun, self.may_end = threading.Event(), threading.Event()
        create = JobStore.create

        def slowly(store: JobStore, job: Any) -> Any:
            made = create(store, job)
            self.begun.set()
            self.may_end.wait(10)
            return made

        monkeypatch.setattr(JobStore, "create", slowly)

    async def left_alone(self, leave: Callable[[], object]) -> None:
        """Let who asked for the job leave while it is being committed."""
        await until(self.begun.is_set)
        leave()
        await asyncio.sleep(0.2)  # for the server to see it
        self.may_end.set()


async def nothing_is_left(engine: Engine) -> None:
    async with asyncio.timeout(5):
        while (await engine.list())[0]:
            await asyncio.sleep(0.01)


async def _answer(reader: asyncio.StreamReader) -> bytes:
    head = await reader.readuntil(b"\r\n\r\n")
    size = head.lower().split(b"content-length: ")[1].split(b"\r\n")[0]
    return await reader.readexactly(int(size))


def test_what_nobody_foresaw_is_logged_under_the_id_that_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing()) as (engine, host, port), httpx2.AsyncClient() as http:

            async def broken(id: str, *, owner: str = "") -> None:
                raise RuntimeError("secret")

            engine.get = broken  # type: ignore[assignment, method-assign]
            answer = await http.get(f"http://{host}:{port}/jobs/a", headers={"X-Request-Id": "findme-123"})
            assert (answer.status_code, answer.json()["request_id"]) == (500, "findme-123")
            assert "secret" not in answer.text

    play(scenario)
    assert "request findme-123: GET '/jobs/a' failed" in caplog.text
