"""An engine with an obedient backend, and what its tests do with it."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

from straightpcf.points.options import DenoiseOptions
from straightpcf.service.admission import Limits
from straightpcf.service.engine import Engine, JobRequest
from straightpcf.service.jobs.record import JobRecord
from straightpcf.service.jobs.store import JobStore
from straightpcf.service.settings import Settings
from tests.service.fakes import ObedientBackend

SMALL: dict[str, Any] = {limit.name: getattr(Settings(), limit.name) for limit in fields(Limits)}
SMALL |= {"max_bytes": 100, "max_points": 10, "min_free_bytes": 0, "shutdown_seconds": 0.0}
Scenario = Callable[[Engine, ObedientBackend], Coroutine[Any, Any, None]]


@asynccontextmanager
async def running(folder: Path, backend: ObedientBackend, **limits: Any) -> AsyncIterator[Engine]:
    engine = Engine(backend, limits=Limits(**SMALL | limits), data_dir=folder)
    await engine.start()
    try:
        yield engine
    finally:
        await engine.stop()


async def submit(engine: Engine, content: bytes = b"0 0 0\n", **request: Any) -> tuple[JobRecord, bool]:
    with engine.upload() as path:
        path.write_bytes(content)
        return await engine.submit(path, JobRequest(**{"options": DenoiseOptions()} | request))


def play(folder: Path, scenario: Scenario, *outcomes: Exception, **limits: Any) -> None:
    async def scene() -> None:
        backend = ObedientBackend(*outcomes)
        async with running(folder, backend, **limits) as engine:
            await asyncio.wait_for(scenario(engine, backend), timeout=20)

    asyncio.run(scene())


async def until(look: Callable[[], object]) -> None:
    while not look():
        await asyncio.sleep(0.01)


def fill(store: JobStore, id: str) -> None:
    """Leave SQLite no room for one more event of a job."""
    store._db.execute("PRAGMA max_page_count = 1")  # it takes what there is
    for size in (2000, 200, 20, 0):
        with suppress(sqlite3.OperationalError):
            while True:
                store._add_event(id, "log", {"level": "warning", "message": "x" * size})


async def run_first_and_fill(engine: Engine, backend: ObedientBackend) -> JobRecord:
    """Let a job's end, which comes when `finish` is set, find no room."""
    record, _ = await submit(engine)
    backend.go.set()
    await until(lambda: backend.runs)
    await engine._call(fill, record.id)
    return record


def make_room(store: JobStore) -> None:
    store._db.execute("PRAGMA max_page_count = 1000000")


async def kinds(engine: Engine, id: str, after: int = 0) -> list[str]:
    return [event.kind async for event in engine.events(id, after=after)]
