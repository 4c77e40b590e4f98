"""Jobs whose time is over all at once, as behind a night of many small ones: batch by batch, and others are served."""

from __future__ import annotations

import asyncio
import os
import sqlite3
import time
from collections.abc import Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import pytest

from straightpcf.points.errors import SpoolFull
from straightpcf.service.jobs.folders import JobFolders
from straightpcf.service.jobs.store import BATCH, SHRINK_PAGES, JobStore
from tests.service.engines import running, until
from tests.service.fakes import ObedientBackend

MANY = 3 * BATCH + 1


def leave(folder: Path, *, files: bool = True, since: float = 60.0) -> None:
    """Make a data directory of jobs that have been over their time for so many seconds, each with some events."""
    with closing(JobFolders(folder)) as folders, closing(JobStore(folder / "jobs.sqlite3")) as store:
        ids = [f"{number:032x}" for number in range(MANY)]
        query = (
            "INSERT INTO jobs (id, owner, folder, state, options, bytes, weight, spool, created_at, finished_at,"
            " expires_at, digest) VALUES (?1, '', ?1, 'succeeded', '{}', 1, 1, 1, 0, 0, ?2, ?1)"
        )
        with store._transaction():
            store._db.executemany(query, [(id, time.time() - since) for id in ids])
            kinds = ("queued", "preview", "progress", "completed")
            events = [(number + 1, at, kind, "{}") for number in range(MANY) for at, kind in enumerate(kinds)]
            store._db.executemany("INSERT INTO events VALUES (?, ?, ?, ?, 0)", events)
        for id in ids if files else ():
            folders.path(id).mkdir()
            (folders.path(id) / "input").write_bytes(b"0 0 0\n")


def states(folder: Path) -> dict[str, int]:
    with closing(sqlite3.connect(folder / "jobs.sqlite3")) as db:
        return dict(db.execute("SELECT state, COUNT(*) FROM jobs GROUP BY state"))


def test_others_are_served_while_much_expires(tmp_path: Path) -> None:
    """All of it was one transaction: with 300,000 rows the whole service waited for more than ten seconds."""
    leave(tmp_path, files=False)

    async def scene() -> None:
        async with running(tmp_path, ObedientBackend()) as engine:  # which sweeps before it listens
            seen = [expired := states(tmp_path)["expired"]]
            while expired < MANY:
                expired = (await engine._call(JobStore.counts))["expired"]
                seen.append(expired)
        assert seen[0] < MANY
        assert max(later - earlier for earlier, later in pairwise([0, *seen])) <= BATCH

    asyncio.run(asyncio.wait_for(scene(), timeout=20))


def test_no_transaction_is_about_more_than_a_batch(tmp_path: Path) -> None:
    leave(tmp_path, files=False)
    with closing(JobStore(tmp_path / "jobs.sqlite3")) as store:
        rows = []
        for step in (store.expire, lambda: store.forget(rows_after=0.0), store.shrink):
            before = store._db.total_changes
            while step():
                rows.append(store._db.total_changes - before)
                before = store._db.total_changes
        assert max(rows) <= 5 * BATCH  # a job and its events
        assert sum(rows) >= MANY
        assert store.counts() == {}


def test_room_is_given_back_bit_by_bit(tmp_path: Path) -> None:
    with closing(JobStore(tmp_path / "jobs.sqlite3")) as store:
        with store._transaction():
            store._db.execute("CREATE TABLE large (x)")
            store._db.executemany("INSERT INTO large VALUES (zeroblob(4000))", [()] * (2 * SHRINK_PAGES))
            store._db.execute("DROP TABLE large")
        free = store._free_pages()
        assert store.shrink()
        assert store._free_pages() == free - SHRINK_PAGES
        while store.shrink():
            pass
        assert store._free_pages() == 0


def test_a_file_that_gives_no_room_back_is_not_asked_for_it_for_ever(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "jobs.sqlite3")) as db:
        db.executescript("CREATE TABLE large (x); INSERT INTO large VALUES (zeroblob(100000)); DROP TABLE large")
    with closing(JobStore(tmp_path / "jobs.sqlite3")) as store:
        assert store._free_pages()
        assert not store.shrink()


def test_what_a_crash_leaves_between_two_batches_is_tidied_up_by_the_next_server(tmp_path: Path) -> None:
    leave(tmp_path, since=1e6)
    with closing(JobStore(tmp_path / "jobs.sqlite3")) as store:
        assert len(store.expire()) == BATCH  # and then it died: their files are still there
    for folder in (tmp_path / "jobs").iterdir():
        os.utime(folder, (0, 0))

    async def scene() -> None:
        async with running(tmp_path, ObedientBackend()):
            await until(lambda: not states(tmp_path) and not list((tmp_path / "jobs").iterdir()))

    asyncio.run(asyncio.wait_for(scene(), timeout=20))


def test_a_full_disk_is_made_room_on_batch_by_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the first files that go are not enough for the marks."""
    leave(tmp_path, since=1e6)
    expire, left = JobStore.expire, lambda: len(list((tmp_path / "jobs").iterdir()))

    def expire_if_there_is_room(store: JobStore) -> Sequence[str]:
        if left() > 1:
            raise SpoolFull("the server's disk is full")
        return expire(store)

    monkeypatch.setattr(JobStore, "expire", expire_if_there_is_room)

    async def scene() -> None:
        async with running(tmp_path, ObedientBackend()):
            await until(lambda: not states(tmp_path) and not left())

    asyncio.run(asyncio.wait_for(scene(), timeout=20))
