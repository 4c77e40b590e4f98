"""The store and the folders by themselves, as servers share them."""

from __future__ import annotations

import os
import sqlite3
import tempfile
import threading
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from straightpcf.points.errors import InternalError
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.jobs.database import OpenedFile
from straightpcf.service.jobs.folders import JobFolders
from straightpcf.service.jobs.record import NewJob
from straightpcf.service.jobs.store import JobStore

LONG_AGO = time.time() - 2 * 3600


def new_job(id: str, folder: str) -> NewJob:
    return NewJob(
        id=id, owner="", folder=folder, name=None, format=None, options=DenoiseOptions(), bytes=1, weight=1, spool=2,
        digest=folder,
    )  # fmt: skip


def test_a_fence_is_void_for_every_later_job_of_its_id_too(tmp_path: Path) -> None:
    with closing(JobStore(tmp_path / "jobs")) as here, closing(JobStore(tmp_path / "jobs")) as there:
        held: list[int] = []
        for round in range(4):
            there.create(new_job("foo", folder=str(round)))
            for _ in range(round + 1):  # an attempt that is put back
                claim = here.claim("here", 15.0)
                assert claim is not None
                assert there.extend([("foo", fence) for fence in held], 15.0) == ["lost"] * len(held)
                for fence in held:
                    assert not there.begin("foo", fence, device="cpu")
                    assert not there.fail("foo", fence, InternalError("old"), expires_in=60)
                assert here.extend([("foo", claim.fence)], 15.0) == ["held"]
                held.append(claim.fence)
                assert here.release("foo", claim.fence, "again", expires_in=60)
            there.delete("foo", str(round))
        assert len(set(held)) == len(held)


def test_a_date_that_jumps_takes_no_job_from_who_works_on_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As when the time is set from the network, or a virtual machine goes on after a pause."""
    with closing(JobStore(tmp_path / "jobs")) as here, closing(JobStore(tmp_path / "jobs")) as there:
        here.create(new_job("foo", folder="0"))
        claim = here.claim("here", 15.0)
        assert claim is not None
        now = time.time
        for jump in (3600.0, -3600.0):
            monkeypatch.setattr(time, "time", lambda jump=jump: now() + jump)
            assert there.recover(expires_in=60) == []
            assert here.extend([("foo", claim.fence)], 15.0) == ["held"]
        assert here.extend([("foo", claim.fence)], -1.0) == ["held"]
        assert there.recover(expires_in=60) == ["foo"]  # nobody renewed it


def test_the_locks_of_dead_servers_are_removed_also_of_those_that_held_no_job(tmp_path: Path) -> None:
    locks = tmp_path / "servers"
    with closing(JobFolders(tmp_path)) as ours, closing(JobFolders(tmp_path)) as other:
        dead, with_jobs, begun, foreign = *(uuid.uuid4().hex for _ in range(3)), "printer"
        for name in (dead, with_jobs, begun, foreign):
            (locks / f"{name}.lock").touch()
        for path in locks.iterdir():
            if path.stem != begun:  # which may be about to lock it
                os.utime(path, (LONG_AGO, LONG_AGO))
        assert ours.dead_servers({with_jobs, other.server}) == [with_jobs]
        assert {path.stem for path in locks.iterdir()} == {ours.server, other.server, begun, foreign}


def test_an_upload_that_nobody_finished_is_dropped_and_what_is_of_others_is_let_be(tmp_path: Path) -> None:
    with closing(JobFolders(tmp_path)) as folders:
        incoming, jobs = tmp_path / "incoming", tmp_path / "jobs"
        (incoming / "folder").mkdir()
        (incoming / "letter.txt").write_text("a letter")
        os.close(tempfile.mkstemp(dir=incoming)[0])
        (jobs / "2024").mkdir()
        (jobs / "2024" / "report.txt").write_text("a report")
        (jobs / (job := uuid.uuid4().hex)).mkdir()
        (jobs / job / "input").write_text("a cloud")
        assert (folders.incoming_bytes(), folders.used_bytes()) == (0, len("a cloud"))
        for path in (*incoming.iterdir(), *jobs.iterdir()):
            os.utime(path, (LONG_AGO, LONG_AGO))
        with folders.upload() as sending:  # slowly: longer than an upload that nobody owns is kept
            os.utime(sending, (0, 0))
            folders.drop_uploads()
            assert folders.orphans() == [job]
            assert sending.exists()
        assert {path.name for path in incoming.iterdir()} == {"folder", "letter.txt"}


def test_a_store_that_is_opened_again_is_not_written_to(tmp_path: Path) -> None:
    with closing(JobStore(path := tmp_path / "jobs.sqlite3")):
        log = path.with_name("jobs.sqlite3-wal")
        written = log.read_bytes()
        JobStore(path).close()
        assert log.read_bytes() == written


def test_what_a_job_showed_on_its_way_goes_with_its_files_and_the_room_is_given_back(tmp_path: Path) -> None:
    path = tmp_path / "jobs.sqlite3"
    with closing(JobStore(path)) as store:
        for id in ("over", "kept"):
            store.create(new_job(id, folder=id))
            claim = store.claim("here", 15.0)
            assert claim is not None
            for _ in range(50):
                assert store.note(id, claim.fence, "preview", {"xyz": [[0.1, 0.2, 0.3]] * 1000})
                assert store.note(id, claim.fence, "progress", {"fraction": 0.5})
            assert store.fail(id, claim.fence, InternalError("no"), expires_in=-1 if id == "over" else 60)
        assert len(store.events("over")) == 102
        assert store.expire() == ["over"]
        while store.shrink():
            pass
        assert [event.kind for event in store.events("over")] == ["queued", "completed"]
        assert len(store.events("kept")) == 102
    with sqlite3.connect(path) as db:
        assert db.execute("PRAGMA freelist_count").fetchone() == (0,)
    db.close()


def test_other_users_of_the_machine_cannot_look_into_what_is_kept(tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        with closing(JobFolders(tmp_path / "data")), closing(JobStore(tmp_path / "data" / "jobs.sqlite3")) as store:
            store.create(new_job("one", folder="one"))
            for path in (tmp_path / "data", *(tmp_path / "data").iterdir()):
                assert path.stat().st_mode & 0o077 == 0, path
    finally:
        os.umask(before)


OLD = """
CREATE TABLE jobs (seq INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE, owner TEXT NOT NULL,
  folder TEXT NOT NULL UNIQUE, state TEXT NOT NULL, name TEXT, format TEXT, options TEXT NOT NULL,
  bytes INTEGER NOT NULL, weight INTEGER NOT NULL, points INTEGER, progress REAL NOT NULL DEFAULT 0,
  attempts INTEGER NOT NULL DEFAULT 0, fence INTEGER NOT NULL DEFAULT 0, server TEXT, lease_until REAL,
  cancel_requested INTEGER NOT NULL DEFAULT 0, created_at REAL NOT NULL, started_at REAL, finished_at REAL,
  expires_at REAL, error TEXT, result TEXT, report TEXT, traceparent TEXT, idempotency_key TEXT, digest TEXT NOT NULL);
INSERT INTO jobs (id, owner, folder, state, options, bytes, weight, created_at, result, digest)
  VALUES ('old', '', 'old', 'succeeded', '{}', 7, 1, 0, '{"bytes": 5}', 'old');
"""


def test_servers_that_start_at_once_on_an_old_file_all_do(tmp_path: Path) -> None:
    for attempt in range(20):
        path = tmp_path / f"{attempt}.sqlite3"
        with closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA journal_mode = WAL")
            db.executescript(OLD)
        with ThreadPoolExecutor(3) as pool:
            for store in pool.map(JobStore, [path] * 3):
                assert store.load().bytes == 12
                store.close()


def test_a_server_that_starts_while_another_makes_the_file_waits_for_it(tmp_path: Path) -> None:
    path = tmp_path / "jobs.sqlite3"
    other = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
    other.execute("CREATE TABLE begun (x)")
    other.execute("BEGIN IMMEDIATE")  # it has no -wal yet, and is written to
    other.execute("INSERT INTO begun VALUES (1)")
    end = threading.Timer(0.2, lambda: other.execute("COMMIT"))
    end.start()
    JobStore(path).close()
    end.join()
    other.close()


def test_what_another_server_moves_into_the_database_during_a_look_is_no_overwriting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, read = tmp_path / "jobs.sqlite3", os.pread
    with closing(JobStore(path)) as store, closing(JobStore(path)) as other:
        store.create(new_job("one", folder="one"))
        os.utime(path, ns=(1, 1))  # so that what is written next is seen, whatever the clock's ticks
        opened = OpenedFile(path)

        def moved_behind(handle: int, size: int, offset: int) -> bytes:
            head = read(handle, size, offset)
            other.empty_wal()
            return head

        monkeypatch.setattr(os, "pread", moved_behind)
        opened.check()
        assert path.stat().st_mtime_ns > 1
        opened.check()
    opened.close()  # behind the database


def test_what_every_upload_asks_for_is_answered_by_an_index(tmp_path: Path) -> None:
    path = tmp_path / "jobs.sqlite3"
    asked: list[str] = []
    with closing(JobStore(path)) as store:
        store.create(new_job("one", folder="one"))
        store._db.set_trace_callback(asked.append)
        for owner in (None, ""):
            assert store.load(owner).bytes == 2
    with closing(sqlite3.connect(path)) as db:
        plans = [row[3] for query in asked for row in db.execute(f"EXPLAIN QUERY PLAN {query}")]
    assert len(plans) >= 4
    assert all("INDEX" in plan for plan in plans), plans


def test_what_uploads_and_waiting_jobs_ask_for_passes_over_all_that_is_over(tmp_path: Path) -> None:
    with closing(JobStore(tmp_path / "jobs.sqlite3")) as store:
        store._db.execute(
            "WITH RECURSIVE over (i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM over WHERE i < 3000) INSERT INTO jobs"
            " (id, owner, folder, state, options, bytes, weight, created_at, digest)"
            " SELECT i, '', i, 'expired', '{}', 1, 1, 0, i FROM over"
        )
        store.create(new_job("one", folder="one"))
        steps = 0

        def count() -> int:
            nonlocal steps
            steps += 1
            return 0

        store._db.set_progress_handler(count, 1)  # of SQLite's machine, of which a row takes several
        assert store.load("").jobs == 1
        assert store.get("one").position == 0
        assert [job.id for job in store.page(owner="", states=("queued", "failed"))[0]] == ["one"]
        assert steps < 3000


def test_a_page_of_jobs_says_where_each_stands_in_the_queue(tmp_path: Path) -> None:
    with closing(JobStore(tmp_path / "jobs.sqlite3")) as store:
        for number in range(7):
            store.create(replace(new_job(f"j{number}", folder=str(number)), owner="other" if number % 3 == 1 else ""))
        store.claim("here", 15.0)
        page, _ = store.page(owner="", limit=10)
        assert [(job.id, job.position) for job in page] == [(job.id, store.get(job.id).position) for job in page]
        assert [job.position for job in page] == [5, 4, 3, 1, None]


def test_a_key_of_many_jobs_delays_those_of_another_by_one_also_where_that_one_deletes_them(tmp_path: Path) -> None:
    with closing(JobStore(tmp_path / "jobs.sqlite3")) as store:

        def submit(*ids: str) -> None:
            for id in ids:
                store.create(replace(new_job(id, folder=id), owner=id[0]))

        def taken() -> str:
            waiting = [job for owner in "abc" for job in store.page(owner=owner, states=("queued",))[0]]
            first = next(job.id for job in waiting if job.position == 0)
            assert sorted(job.position or 0 for job in waiting) == list(range(len(waiting)))
            claim = store.claim("here", 15.0)
            assert claim is not None
            assert claim.record.id == first
            if first[0] == "b":
                store.delete(first, first)
            return first

        submit("a1", "a2", "a3", "a4", "b1", "b2")
        assert [taken(), taken()] == ["a1", "b1"]
        submit("b3", "c1")
        assert [taken() for _ in range(6)] == ["c1", "a2", "b2", "a3", "b3", "a4"]
        assert store.claim("here", 15.0) is None
