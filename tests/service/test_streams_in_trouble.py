"""Answers that have begun, or are waited for, when the data directory cannot be used any more."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import httpx2
import pytest

from tests.service.engines import until
from tests.service.fakes import ObedientBackend
from tests.service.in_process import serving
from tests.service.test_races import CLOUD, play
from tests.service.test_unusable_data_dir import SAID, gone


def test_streams_end_without_a_traceback(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    backend = ObedientBackend()
    backend.go.set()

    async def scenario() -> None:
        async with (
            serving(tmp_path / "data", backend, shutdown_seconds=0.1) as (engine, host, port),
            httpx2.AsyncClient(base_url=f"http://{host}:{port}") as http,
        ):
            id = (await http.post("/jobs?filename=a.xyz", content=CLOUD)).json()["id"]
            await until(lambda: backend.runs)
            json_lines = {"Accept": "application/x-ndjson"}
            async with (
                http.stream("GET", f"/jobs/{id}/events") as events,
                http.stream("GET", f"/jobs/{id}/stream") as patches,
                http.stream("GET", f"/jobs/{id}/stream", headers=json_lines) as lines,
                gone(tmp_path / "data"),
            ):
                engine._notify(id)
                assert b"completed" not in await events.aread()
                assert await patches.aread() == b""
                assert json.loads(await lines.aread()) == {"error": {"code": "server_busy", "detail": SAID}}
            await engine.delete(id)

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]
    assert caplog.text.count("a request is sent away") == 3


def test_a_request_that_is_sent_away_leaves_no_job_behind(tmp_path: Path) -> None:
    backend = ObedientBackend()
    backend.go.set()

    async def scenario() -> None:
        async with (
            serving(tmp_path, backend, shutdown_seconds=0.1) as (engine, host, port),
            httpx2.AsyncClient(base_url=f"http://{host}:{port}") as http,
        ):
            asked = asyncio.create_task(http.post("/denoise?filename=a.xyz", content=CLOUD))
            await until(lambda: backend.runs)
            call = engine._call

            async def fails_once(*_: object) -> None:
                engine._call = call
                raise OSError(5, "Input/output error")

            engine._call = fails_once  # type: ignore[assignment]
            engine._notify(backend.runs[0].id)
            answer = await asked
            assert (answer.status_code, answer.json()["detail"]) == (503, SAID)
            assert (await engine.list())[0] == []

    play(scenario)
