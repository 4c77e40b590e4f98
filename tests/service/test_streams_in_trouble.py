"""Answers that have begun, or are waited for, when the data directory cannot be used any more."""

from __future__ import annotations

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
