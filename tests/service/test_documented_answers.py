"""What the OpenAPI document says of answers is what they are: their status, their media type, their headers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import httpx2
import pytest

from straightpcf.points.errors import TooFewPoints
from straightpcf.service.engine import Engine
from straightpcf.service.jobs.store import JobStore
from tests.service.engines import until
from tests.service.fakes import ObedientBackend
from tests.service.in_process import serving
from tests.service.test_races import CLOUD, willing

TELLING = ("Location", "Content-Range", "ETag", "Retry-After", "WWW-Authenticate", "Preference-Applied")
SSE = {"Accept": "text/event-stream"}
FORM = {"Content-Type": "multipart/form-data; boundary=b"}
EVIL = {"Host": "evil.example"}
KEY = {"Idempotency-Key": "one"}
RESULT, FILE = "/jobs/{id}/result", "/denoise/{filename}"

# A path of the document with its `{id}`, what is asked of it, and the statuses that come back, in this order.
ASKED: tuple[tuple[str, str, str, dict[str, str], bytes | None, int], ...] = (
    ("POST", "/denoise", "?filename=a.xyz", {}, CLOUD, 200),
    ("POST", "/denoise", "?filename=a.xyz&report=true", {}, CLOUD, 200),
    ("POST", "/denoise", "?filename=a.xyz", SSE, CLOUD, 200),
    ("POST", "/denoise", "?filename=a.xyz", {"Prefer": "wait=9"}, CLOUD, 200),
    ("POST", "/denoise", "?filename=a.xyz", {"Prefer": "respond-async"}, CLOUD, 202),
    ("POST", "/denoise", "", FORM, b"none", 400),
    ("POST", "/denoise", "?format=nope", {}, CLOUD, 415),
    ("POST", "/denoise", "?seed=x", {}, CLOUD, 422),
    ("PUT", FILE, "", {}, CLOUD, 200),
    ("PUT", FILE, "", {}, bytes(2000), 413),
    ("POST", "/jobs", "", KEY, CLOUD, 202),
    ("POST", "/jobs", "", KEY, CLOUD, 200),
    ("POST", "/jobs", "", {"Origin": "http://evil.example"}, CLOUD, 403),
    ("PUT", "/jobs/{id}", "?filename=a.xyz", {}, CLOUD, 202),
    ("PUT", "/jobs/{id}", "?filename=a.xyz", {}, CLOUD, 200),
    ("PUT", "/jobs/{id}", "?filename=b.xyz", {}, CLOUD, 409),
    ("GET", "/jobs", "", {}, None, 200),
    ("GET", "/jobs", "?cursor=x", {}, None, 400),
    ("GET", "/jobs", "?limit=0", {}, None, 422),
    ("GET", "/jobs", "?limit=1_0", {}, None, 422),
    ("GET", "/jobs", "?limit=%2B1", {}, None, 200),
    ("GET", "/jobs/{id}", "?wait=9", {}, None, 200),
    ("GET", "/jobs/{id}", "?wait=x", {}, None, 422),
    ("GET", "/jobs/{id}", "?wait=0_1", {}, None, 422),
    ("GET", "/jobs/{id}", "?wait=1e-3", {}, None, 200),
    ("GET", "/jobs/{id}/events", "", {}, None, 200),
    ("GET", "/jobs/{id}/events", "?after=99", {}, None, 204),
    ("GET", "/jobs/{id}/events", "?after=x", {}, None, 400),
    ("GET", "/jobs/{id}/stream", "", {}, None, 200),
    ("GET", "/jobs/{id}/stream", "", {"Accept": "application/x-ndjson"}, None, 200),
    ("GET", "/jobs/{id}/stream", "", {"Accept": "x" * 2000}, None, 400),
    ("GET", "/jobs/{id}/report", "", {}, None, 200),
    ("GET", RESULT, "", {}, None, 200),
    ("HEAD", RESULT, "", {}, None, 200),
    ("GET", RESULT, "", {"Range": "bytes=0-3"}, None, 206),
    ("GET", RESULT, "", {"Range": "bytes=0-1,4-5"}, None, 206),
    ("HEAD", RESULT, "", {"Range": "bytes=0-3"}, None, 200),
    ("GET", RESULT, "", {"If-None-Match": "*"}, None, 304),
    ("HEAD", RESULT, "", {"If-None-Match": "*"}, None, 304),
    ("GET", RESULT, "", {"If-Match": '"x"'}, None, 412),
    ("DELETE", "/jobs/{id}", "", {"If-Match": '"x"'}, None, 412),
    ("GET", RESULT, "", {"Range": "bytes=999-"}, None, 416),
    ("POST", "/jobs/{id}/cancel", "", {}, None, 200),
    ("DELETE", "/jobs/{id}", "", {}, None, 204),
    *(("GET", f"/jobs/{{id}}{part}", "", {}, None, 404) for part in ("", "/events", "/stream", "/report", "/result")),
    ("POST", "/jobs/{id}/cancel", "", {}, None, 404),
    ("DELETE", "/jobs/{id}", "", {}, None, 404),
    *(("GET", path, "", {}, None, 200) for path in ("/livez", "/healthz", "/readyz", "/v1/info")),
    *(("GET", path, "", EVIL, None, 421) for path in ("/livez", "/healthz", "/readyz", "/v1/info", "/jobs", RESULT)),
)


def play(scenario: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(asyncio.wait_for(scenario(), timeout=60))


class Reader:
    """Ask, and hold the answer against the document."""

    def __init__(self, http: httpx2.AsyncClient) -> None:
        self._http, self._paths = http, {}

    async def read(self) -> dict[str, Any]:
        self._paths: dict[str, Any] = (await self._http.get("/openapi.json")).json()["paths"]
        return self._paths

    async def ask(
        self, method: str, path: str, query: str, headers: dict[str, str], body: bytes | None, status: int
    ) -> None:
        url = path.format(id="some", filename="a.xyz") + query
        answer = await self._http.request(method, url, headers=headers, content=body)
        asked = f"{method} {url} {headers}"
        assert answer.status_code == status, (asked, answer.text)
        said = self._paths[path][method.lower()]["responses"].get(str(status))
        assert said is not None, asked
        if answer.content:
            media_type = answer.headers["content-type"].partition(";")[0]
            assert media_type in said["content"], asked
            assert (status < 400 or (path, status) == ("/readyz", 503)) or media_type == "application/problem+json"
        assert {name for name in TELLING if name in answer.headers} <= {*said.get("headers", ()), "Location"}, asked


def test_every_answer_is_a_documented_one(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing(), max_bytes=1000) as (engine, host, port), _client(host, port) as http:
            reader = Reader(http)
            await reader.read()
            for asked in ASKED:
                await reader.ask(*asked)
            await _while_it_ends(engine, reader)

    play(scenario)


async def _while_it_ends(engine: Engine, reader: Reader) -> None:
    engine.drain()
    await reader.ask("GET", "/readyz", "", {}, None, 503)
    await reader.ask("POST", "/jobs", "", {}, CLOUD, 503)


def test_what_is_not_finished_and_who_has_no_key_are_documented_too(tmp_path: Path) -> None:
    backend = ObedientBackend()
    key = {"Authorization": "Bearer secret"}

    async def scenario() -> None:
        async with serving(tmp_path, backend, api_keys="secret") as (_, host, port), _client(host, port) as http:
            reader = Reader(http)
            for path, operations in (await reader.read()).items():
                for method, operation in operations.items():
                    if "401" in operation["responses"]:
                        await reader.ask(method.upper(), path, "", {}, None, 401)
            await reader.ask("PUT", "/jobs/{id}", "", key, CLOUD, 202)
            backend.go.set()
            await until(lambda: backend.runs)
            for part in ("report", "result"):
                await reader.ask("GET", f"/jobs/{{id}}/{part}", "", key, None, 409)
            await reader.ask("POST", "/jobs/{id}/cancel", "", key, None, 202)
            await reader.ask("GET", "/jobs/{id}/stream", "", key, None, 409)

    play(scenario)


@pytest.mark.parametrize("path", ["/jobs/{id}", "/jobs"])
def test_a_fault_of_the_server_is_documented_too(tmp_path: Path, path: str) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, ObedientBackend()) as (engine, host, port), _client(host, port) as http:

            async def broken(*_: object, **__: object) -> None:
                raise RuntimeError

            engine.get = engine.list = broken  # type: ignore[assignment, method-assign]
            reader = Reader(http)
            await reader.read()
            await reader.ask("GET", path, "", {}, None, 500)

    play(scenario)


def test_an_expired_job_still_tells_what_became_of_it(tmp_path: Path) -> None:
    async def scenario() -> None:
        backend = willing(ObedientBackend(TooFewPoints("5 points")))  # of the first job
        async with (
            serving(tmp_path, backend, result_ttl_seconds=0.01) as (engine, host, port),
            _client(host, port) as http,
        ):
            for id in ("failed", "succeeded"):
                await http.put(f"/jobs/{id}?filename=a.xyz", content=CLOUD)
                before = (await http.get(f"/jobs/{id}?wait=9")).json()
                assert before["state"] == id
                await asyncio.sleep(0.05)
                await engine._call(JobStore.expire)
                assert (await http.get(f"/jobs/{id}")).json() == before | {"state": "expired"}
                assert (await http.get(f"/jobs/{id}/report")).status_code == (422 if id == "failed" else 410)

    play(scenario)


def _client(host: str, port: int) -> httpx2.AsyncClient:
    return httpx2.AsyncClient(base_url=f"http://{host}:{port}", timeout=20)
