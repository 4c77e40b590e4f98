"""A disk that is not there for hours: what a server says of it, and what it does all the same."""

from __future__ import annotations

import asyncio
import logging
import sqlite3
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from straightpcf.service.jobs import runner
from straightpcf.service.jobs.folders import JobFolders
from straightpcf.service.jobs.full_disk import RESERVE
from straightpcf.service.jobs.runner import JobRunner
from straightpcf.service.jobs.store import JobStore
from straightpcf.service.jobs.sweeper import Sweeper
from tests.service.fakes import ObedientBackend


def test_a_disk_that_is_gone_is_said_once_whatever_the_workers_and_again_only_when_that_changes(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "uvicorn.error")
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.001)
    gone = OSError(5, "gone", "/data/jobs.sqlite3")
    calls = iter([*[gone] * 20, *[sqlite3.OperationalError("database is locked")] * 20, *[None] * 4, *[gone] * 20])
    backend, over = ObedientBackend(), asyncio.Event()
    backend.go.set()
    monkeypatch.setattr(backend, "slots", 3)

    async def call(*args: Any, **kwargs: Any) -> None:
        fault = next(calls, over)
        if fault is over:
            over.set()
        elif fault is not None:
            raise cast(Exception, fault)

    async def scenario() -> None:
        jobs = JobRunner(
            backend, folders=cast(JobFolders, SimpleNamespace(server="here")), call=call, notify=lambda id: None,
            max_points=1, result_ttl_seconds=1.0,
        )  # fmt: skip
        jobs.start()
        async with asyncio.timeout(5):
            await over.wait()
        await jobs.stop(lambda: 0.0)

    asyncio.run(scenario())
    said = [record.getMessage().rpartition("leases will run out")[2] for record in caplog.records]
    locked = ": OperationalError('database is locked')"
    assert said == [f": {gone!r}", locked, "", f": {gone!r}", ""]


def test_what_keeps_a_step_of_a_sweep_from_its_end_keeps_none_of_the_others_from_their_beginning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recovered: list[str] = []

    def fails(*_: object) -> Any:
        raise OSError(5, "cannot be read")

    async def call(function: Any, *args: Any, **kwargs: Any) -> Any:
        return {JobStore.servers: lambda: {"dead"}, JobStore.recover: lambda: args[0]}.get(function, fails)()

    async def scenario() -> None:
        folders = SimpleNamespace(
            server="here", drop_uploads=fails, orphans=lambda: ["folder"], dead_servers=lambda servers: sorted(servers)
        )
        sweeper = Sweeper(
            tmp_path, folders=cast(JobFolders, folders), call=call, notify=recovered.append, result_ttl_seconds=1.0,
            row_ttl_seconds=1.0,
        )  # fmt: skip
        for _ in range(2):
            await sweeper.sweep()

    asyncio.run(scenario())
    assert recovered == ["dead", "dead"]
    assert (tmp_path / RESERVE).exists()
    troubles = [record.getMessage().partition(" until")[0] for record in caplog.records]
    kept = ["jobs that are over their time", "uploads that nobody finished", "files that no job owns"]
    assert [said for said in troubles if "are kept" in said] == [f"{what} are kept" for what in kept]
