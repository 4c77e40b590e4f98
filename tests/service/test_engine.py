"""The engine against a backend that does as it is told, with a real store on a real disk."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

import pytest

from straightpcf.points.errors import (
    IdConflict,
    IdempotencyConflict,
    InvalidRequest,
    JobCanceled,
    JobNotFinished,
    MalformedFile,
    NotFound,
    QuotaExceeded,
    ServerBusy,
    TooManyBytes,
    UnknownFormat,
)
from straightpcf.points.options import DenoiseOptions
from straightpcf.service import engine as engine_module
from straightpcf.service.engine import CHUNK_BYTES, Engine
from straightpcf.service.jobs.record import JobRecord
from straightpcf.service.jobs.store import JobStore
from tests.service.engines import kinds, play, submit
from tests.service.fakes import CONTENT, ObedientBackend


def test_a_job_tells_its_events_in_order_to_those_who_come_early_late_or_again(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, created = await submit(engine)
        assert (created, record.state, record.position) == (True, "queued", 0)
        early = asyncio.create_task(kinds(engine, record.id))
        backend.go.set()
        backend.finish.set()
        assert (await engine.wait(record.id)).state == "succeeded"
        whole = ["queued", "start", "progress", "log", "output", "completed"]
        assert await early == await kinds(engine, record.id) == whole
        assert await kinds(engine, record.id, after=3) == whole[3:]

    play(tmp_path, scenario)


def test_who_follows_a_job_is_not_led_into_another_that_takes_its_id(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        backend.patches = b"A" * (3 * CHUNK_BYTES)
        await submit(engine, id="one")
        await engine.wait("one")
        patches, events = engine.patches("one"), engine.events("one")
        assert set(await anext(patches)) == {ord("A")}
        assert (await anext(events)).kind == "queued"
        await engine.delete("one")
        backend.patches = b"B" * (3 * CHUNK_BYTES)
        await submit(engine, b"9 9 9\n", id="one")
        await engine.wait("one")
        with pytest.raises(NotFound, match="deleted"):
            b"".join([chunk async for chunk in patches])
        kept = [event.kind async for event in events]  # read at once, before the job was deleted
        assert kept == ["start", "progress", "log", "output", "completed"]

    play(tmp_path, scenario)


def test_who_follows_a_job_does_not_have_the_whole_queue_counted_at_each_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_module, "POLL_SECONDS", 0.02)
    steps = 0

    def count() -> int:
        nonlocal steps
        steps += 1
        return 0

    def crowd(store: JobStore) -> None:
        store._db.execute(
            "WITH RECURSIVE n (i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 3000) INSERT INTO jobs"
            " (id, owner, folder, state, options, bytes, weight, created_at, digest)"
            " SELECT i, '', i, 'queued', '{}', 1, 1, 0, i FROM n"
        )
        store._db.set_progress_handler(count, 1)  # of SQLite's machine, of which a row takes several

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, _ = await submit(engine)
        await engine._call(crowd)
        looks = [engine.wait(record.id), kinds(engine, record.id), anext(aiter(engine.patches(record.id)))]
        await asyncio.wait(followers := [asyncio.ensure_future(look) for look in looks], timeout=0.3)
        assert 50 < steps < 3000
        for follower in followers:
            follower.cancel()
        assert (await engine.wait(record.id, seconds=0)).position == 0

    play(tmp_path, scenario)


def test_a_result_is_there_when_the_job_has_succeeded_and_not_before(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, _ = await submit(engine, name="scan.xyz")
        with pytest.raises(JobNotFinished):
            await engine.result(record.id)
        backend.go.set()
        backend.finish.set()
        await engine.wait(record.id)
        path, record = await engine.result(record.id)
        assert path.read_bytes() == CONTENT
        assert record.result is not None
        assert record.result.filename == "scan_clean.xyz"
        assert record.report is not None
        assert record.report["noise_before"] is None  # JSON has no NaN

    play(tmp_path, scenario)


def test_what_a_server_leaves_the_next_one_does(tmp_path: Path) -> None:
    ids: list[str] = []

    async def leave(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        ids.extend([(await submit(engine, bytes([65 + n])))[0].id for n in range(3)])
        while not backend.runs:
            await asyncio.sleep(0.01)

    async def finish(engine: Engine, backend: ObedientBackend) -> None:
        assert [(await engine.get(id)).state for id in ids] == ["queued"] * 3
        backend.go.set()
        backend.finish.set()
        assert [(await engine.wait(id)).state for id in ids] == ["succeeded"] * 3

    play(tmp_path, leave)
    play(tmp_path, finish)


def test_the_same_idempotency_key_finds_the_same_job_and_another_request_is_a_conflict(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        made = await asyncio.gather(*(submit(engine, idempotency_key="k") for _ in range(8)))
        assert len({record.id for record, _ in made}) == 1
        assert sum(created for _, created in made) == 1
        for change in ({"content": b"1 1 1\n"}, {"options": DenoiseOptions(seed=1)}, {"endpoint": "denoise"}):
            with pytest.raises(IdempotencyConflict):
                await submit(engine, idempotency_key="k", **change)
        assert (await submit(engine, idempotency_key="k", owner="another"))[1]
        assert len(list((tmp_path / "jobs").iterdir())) == 2  # no repetition left a folder

    play(tmp_path, scenario)


def test_a_chosen_id_makes_one_job_and_must_be_a_plain_name(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        assert (await submit(engine, id="scan-1"))[0].id == "scan-1"
        assert not (await submit(engine, id="scan-1"))[1]
        with pytest.raises(IdConflict):
            await submit(engine, b"1 1 1\n", id="scan-1")
        with pytest.raises(IdConflict):
            await submit(engine, id="scan-1", owner="another")
        for id in ("", "..", ".x", "a/b", "a" * 65, "ü", "a b"):
            with pytest.raises(InvalidRequest):
                await submit(engine, id=id)

    play(tmp_path, scenario)


def test_canceling_works_in_every_state_and_reaches_the_worker(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        waiting, _ = await submit(engine)
        assert (await engine.cancel(waiting.id)).state == "canceled"
        backend.go.set()
        running_, _ = await submit(engine)
        while not backend.runs:
            await asyncio.sleep(0.01)
        assert (await engine.cancel(running_.id)).state == "canceled"
        assert backend.canceled == [running_.id]
        with pytest.raises(JobCanceled):
            await engine.result(running_.id)
        backend.finish.set()
        done, _ = await submit(engine)
        await engine.wait(done.id)
        assert (await engine.cancel(done.id)).state == "succeeded"
        assert (await kinds(engine, waiting.id))[-1] == "completed"

    play(tmp_path, scenario)


def test_a_deleted_job_leaves_no_file_and_no_row(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        record, _ = await submit(engine)
        while not backend.runs:
            await asyncio.sleep(0.01)
        await engine.delete(record.id)
        with pytest.raises(NotFound):
            await engine.get(record.id)
        assert not list((tmp_path / "jobs").iterdir())

    play(tmp_path, scenario)


def test_a_job_of_another_owner_does_not_exist(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        record, _ = await submit(engine, owner="a")
        for ask in (engine.get, engine.cancel, engine.delete, engine.result, engine.wait):
            with pytest.raises(NotFound):
                await ask(record.id, owner="b")
        assert await engine.list(owner="b") == ([], None)
        assert [job.id for job in (await engine.list(owner="a"))[0]] == [record.id]

    play(tmp_path, scenario)


def test_pages_list_every_job_once_newest_first(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        ids = [(await submit(engine, bytes([65 + n])))[0].id for n in range(7)]
        await engine.cancel(ids[2])
        seen, cursor = [], None
        while True:
            page, cursor = await engine.list(limit=3, cursor=cursor)
            seen += [record.id for record in page]
            if cursor is None:
                break
        assert seen == ids[::-1]
        assert [record.id for record in (await engine.list(states=["canceled"]))[0]] == [ids[2]]
        with pytest.raises(InvalidRequest, match="cursor"):
            await engine.list(cursor="nonsense")

    play(tmp_path, scenario)


def test_what_is_over_a_limit_is_refused_and_costs_nothing(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        with pytest.raises(UnknownFormat):
            await submit(engine, format="no-such-format")
        with pytest.raises(TooManyBytes, match="100"):
            await submit(engine, b"x" * 101)
        first, _ = await submit(engine, owner="a")
        with pytest.raises(QuotaExceeded):
            await submit(engine, b"1 1 1\n", owner="a")
        await submit(engine, owner="b")
        with pytest.raises(ServerBusy, match="holds 2"):
            await submit(engine, owner="c")
        await engine.cancel(first.id, owner="a")
        await submit(engine, owner="c")
        assert len(list((tmp_path / "jobs").iterdir())) == 3
        assert not list((tmp_path / "incoming").iterdir())

    play(tmp_path, scenario, max_jobs=2, max_jobs_per_key=1)


def test_finished_jobs_expire_and_are_then_forgotten(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        record, _ = await submit(engine)
        await engine.wait(record.id)
        await engine._sweeper.sweep()
        assert (await engine.get(record.id)).state == "expired"
        assert not list((tmp_path / "jobs").iterdir())

    play(tmp_path, scenario, result_ttl_seconds=1e-6)


def test_the_error_of_a_job_is_raised_as_it_is(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        record, _ = await submit(engine)
        assert (await engine.wait(record.id)).state == "failed"
        with pytest.raises(MalformedFile, match="line 3"):
            await engine.result(record.id)

    play(tmp_path, scenario, MalformedFile("line 3"))


def test_what_runs_has_one_limit_from_the_moment_that_a_server_drains(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        assert engine.patience_seconds == 60
        engine.drain()
        await asyncio.sleep(0.2)
        engine.drain()  # again, by whoever stops next
        assert 0 < engine.patience_seconds <= 59.8
        engine._ends_at = 0.0
        assert engine.patience_seconds == 0

    play(tmp_path, scenario, shutdown_seconds=60.0)


@pytest.mark.parametrize("swapped", ["get", "cancel"])
def test_whoever_deletes_a_job_harms_no_other_that_has_its_id_by_then(tmp_path: Path, swapped: str) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        await submit(engine, owner="one", id="x")
        look = getattr(engine, swapped)

        async def late(id: str, *, owner: str = "") -> JobRecord:
            setattr(engine, swapped, look)
            record: JobRecord = await look(id, owner=owner)
            await engine.delete(id, owner="one")  # asked for twice, and this one was quicker
            await submit(engine, b"1 1 1\n", owner="another", id="x")
            return record

        setattr(engine, swapped, late)
        with contextlib.suppress(NotFound):
            await engine.delete("x", owner="one")
        assert (await engine.get("x", owner="another")).state == "queued"

    play(tmp_path, scenario)


def test_a_traceparent_of_any_length_takes_little_room(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        usual = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"
        assert (await submit(engine, traceparent=usual))[0].traceparent == usual
        assert (await submit(engine, traceparent="a" * 60_000))[0].traceparent == "a" * 64

    play(tmp_path, scenario)
