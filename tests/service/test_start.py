"""What a server finds when it starts: what it cannot use it says in a line, what it can do without stops it not."""

from __future__ import annotations

import os
import resource
import sqlite3
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from straightpcf.points.errors import SpoolFull
from straightpcf.service.engine import Engine
from straightpcf.service.jobs.store import JobStore
from tests.conftest import clean_environment, run_server, serve
from tests.service.engines import play, submit
from tests.service.fakes import ObedientBackend


def _damage(folder: Path) -> None:
    """Spoil pages behind the first: the file still opens."""
    path = folder / "jobs.sqlite3"
    JobStore(path).close()
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA journal_mode = DELETE").fetchone() == ("delete",)
    with path.open("r+b") as file:
        file.seek(2 * 4096)
        file.write(b"\xa5" * (path.stat().st_size - 2 * 4096))


def _put_a_file_where_jobs_go(folder: Path) -> None:
    (folder / "jobs").write_bytes(b"")


@pytest.mark.parametrize("spoil", [_damage, _put_a_file_where_jobs_go])
def test_a_data_directory_that_cannot_be_used_is_said_in_a_line(tmp_path: Path, spoil: Callable[[Path], None]) -> None:
    spoil(tmp_path)
    done = serve("--data-dir", tmp_path)
    assert done.returncode == 2
    assert f"data_dir is {tmp_path}, which cannot hold jobs: " in done.stderr.replace("\n", "")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("kind", "most", "said"),
    [
        (resource.RLIMIT_NOFILE, 40, "may have 40 files open"),
        (resource.RLIMIT_FSIZE, 300_000, "may make a file of 300000 bytes at most"),
    ],
)
def test_limits_under_which_no_job_can_be_done_are_said_at_the_start(
    tmp_path: Path, kind: int, most: int, said: str
) -> None:
    """With them it was ready, and its first jobs never ended."""
    command = [sys.executable, "-m", "straightpcf.clients.cli", "serve", "--port", "0", "--data-dir", str(tmp_path)]
    limit = f"resource.setrlimit({int(kind)}, ({most}, {most}))"
    begin = f"import os, resource, sys; {limit}; os.execv(sys.argv[1], sys.argv[1:])"
    done = subprocess.run(
        [sys.executable, "-c", begin, *command], env=clean_environment(), capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"error [invalid_options]: this process {said}")
    assert done.stderr.count("\n") == 1


def test_a_first_sweep_that_fails_is_made_up_for_by_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(store: JobStore) -> list[str]:
        raise SpoolFull("the server's disk is full")

    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        monkeypatch.undo()
        await submit(engine)
        await engine._sweeper.sweep()

    monkeypatch.setattr(JobStore, "expire", full)
    play(tmp_path, scenario)


def test_a_server_whose_stdout_is_closed_starts(tmp_path: Path) -> None:
    with run_server(tmp_path, within=("/bin/sh", "-c", 'exec "$@" >&-', "sh")) as server:
        assert server._status("/livez") == 200


def test_a_server_whose_stdout_takes_nothing_goes_on_and_fills_no_other_log(tmp_path: Path) -> None:
    """As where it is a pipe to a program that has ended: the log of errors had a traceback of each request."""
    with run_server(tmp_path, within=("/bin/sh", "-c", 'exec "$@" >/dev/full', "sh")) as server:
        assert server._status("/livez") == 200
    assert server.process.returncode == 0
    assert "Traceback" not in server.log.read_text()


def test_a_server_starts_whatever_web_concurrency_says(tmp_path: Path) -> None:
    """Platforms set it for servers that fork; uvicorn reads it as a number, even where it is not to fork."""
    with run_server(tmp_path, environment={"WEB_CONCURRENCY": "auto"}) as server:
        assert server._status("/livez") == 200


def test_what_others_have_in_a_data_directory_stays_there(tmp_path: Path) -> None:
    """A folder of a project, say, that had `jobs` of its own before."""
    theirs = [tmp_path / "data" / name for name in ("jobs/2024/report.txt", "incoming/letter.txt", "servers/www.lock")]
    ours = tmp_path / "data" / "jobs" / uuid.uuid4().hex / "input"
    for path in (*theirs, ours):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("kept")
    for path in (tmp_path / "data").glob("*/*"):
        os.utime(path, (0, 0))
    with run_server(tmp_path) as server:  # which sweeps before it listens
        assert server._status("/livez") == 200
        assert [path.read_text() for path in theirs] == ["kept"] * len(theirs)
        assert not ours.exists()


def test_nobody_else_may_read_what_a_server_makes_in_folders_that_were_there(tmp_path: Path) -> None:
    async def scenario(engine: Engine, backend: ObedientBackend) -> None:
        backend.go.set()
        backend.finish.set()
        record, _ = await submit(engine)
        await engine.wait(record.id)
        made = [tmp_path / "jobs" / record.folder, *(tmp_path / "servers").iterdir(), tmp_path / "reserve"]
        assert [path.name for path in made if path.stat().st_mode & 0o077] == []

    before = os.umask(0o022)
    try:
        for name in ("jobs", "incoming", "servers"):
            (tmp_path / name).mkdir(mode=0o755)
        play(tmp_path, scenario)
    finally:
        os.umask(before)


@pytest.mark.skipif(not os.access("/dev/shm", os.W_OK), reason="no second disk here")
def test_folders_on_two_disks_are_refused_at_the_start(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as other:
        (tmp_path / "jobs").symlink_to(other)
        done = serve("--data-dir", tmp_path)
        assert done.returncode == 2
        assert f"{tmp_path}/jobs and {tmp_path}/incoming are not on one disk" in done.stderr
        assert "Traceback" not in done.stderr
        assert not [*Path(other).iterdir(), *(tmp_path / "incoming").iterdir()]
