"""What `watch` takes, leaves and takes again."""

from __future__ import annotations

import errno
import os
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from straightpcf.clients import watch
from straightpcf.clients.sdk import Client, retry
from straightpcf.clients.watch import watch_folder
from straightpcf.points.errors import ConnectionFailed, JobExpired, MalformedFile, NotFound, RequestTimeout, ServerBusy
from tests.clouds import torus
from tests.conftest import RunningServer

Denoise = Callable[[Path, Path], Any]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    deadline, sleep = time.monotonic() + 30, time.sleep

    def look_again(seconds: float) -> None:
        assert time.monotonic() < deadline, "nothing more comes"
        sleep(seconds)

    monkeypatch.setattr(watch, "LOOK_SECONDS", 0.01)
    monkeypatch.setattr(watch, "time", SimpleNamespace(sleep=look_again))
    (tmp_path / "clean").mkdir()
    (tmp_path / "scan.ply").write_bytes(b"first")
    return tmp_path


def copy(source: Path, target: Path) -> str:
    target.write_bytes(source.read_bytes())
    return source.read_text()


def watched(folder: Path, denoise: Denoise) -> Iterator[Any]:
    return (outcome for _, outcome in watch_folder(folder, folder / "clean", denoise))


def once(folder: Path, denoise: Denoise = copy) -> list[Any]:
    return [outcome for _, outcome in watch_folder(folder, folder / "clean", denoise, once=True)]


def replace(path: Path, content: bytes, *, age: float) -> None:
    """Put another file in the place of one, as `mv` does: with a time of its own."""
    (new := path.with_name("new")).write_bytes(content)
    written = path.stat().st_mtime_ns - round(age * 1e9)
    os.utime(new, ns=(written, written))
    new.replace(path)


@pytest.mark.parametrize("age", [-5.0, 5.0])
def test_a_file_that_is_replaced_while_it_is_worked_on_is_done_again(folder: Path, age: float) -> None:
    def slowly(source: Path, target: Path) -> str:
        done = copy(source, target)
        if done == "first":
            replace(source, b"second", age=age)
        return done

    outcomes = watched(folder, slowly)
    assert [next(outcomes), next(outcomes)] == ["first", "second"]
    assert (folder / "clean" / "scan.ply").read_bytes() == b"second"
    assert once(folder) == []


@pytest.mark.parametrize("is_once", [True, False])
def test_what_is_taken_away_before_its_turn_is_no_failure_and_what_grows_is_let_grow(
    folder: Path, *, is_once: bool
) -> None:
    later, gone = folder / "y later.ply", folder / "x gone.ply"
    later.write_bytes(b"half")
    gone.write_bytes(b"gone")
    seen: list[bytes] = []

    def change(source: Path, target: Path) -> str:
        seen.append(source.read_bytes())
        if source.name == "scan.ply":
            gone.unlink()
            later.write_bytes(b"whole one")
        return copy(source, target)

    outcomes = once(folder, change) if is_once else list(islice(watched(folder, change), 2))
    assert outcomes == ["first", "whole one"]
    assert seen == [b"first", b"whole one"]


def test_what_is_done_stays_done_for_the_next_process_until_it_changes(folder: Path) -> None:
    assert once(folder) == ["first"]
    assert once(folder) == []
    replace(folder / "scan.ply", b"an older one", age=3600.0)
    assert once(folder) == ["an older one"]


def test_a_result_that_somebody_worked_on_is_let_be_until_its_input_changes(folder: Path) -> None:
    assert once(folder) == ["first"]
    time.sleep(0.05)  # a file system's clock ticks
    (result := folder / "clean" / "scan.ply").write_bytes(b"a part of the first")
    assert once(folder) == []
    assert result.read_bytes() == b"a part of the first"
    time.sleep(0.05)
    replace(folder / "scan.ply", b"an older one", age=3600.0)
    assert once(folder) == ["an older one"]


def test_a_file_system_that_keeps_no_exact_times_does_not_make_it_go_on_for_ever(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "utime", lambda path, ns: None)
    asked: list[str] = []
    seen = watched(folder, lambda source, target: asked.append(copy(source, target)))
    threading.Timer(0.3, lambda: (folder / "late.ply").write_bytes(b"late")).start()
    next(seen), next(seen)
    assert asked == ["first", "late"]


@pytest.mark.parametrize("away", [ConnectionFailed("down"), RequestTimeout("slow"), ServerBusy("full")])
def test_a_server_that_cannot_be_had_is_no_failure_of_the_file(folder: Path, away: Exception) -> None:
    answers = iter([away, away, away, None, away, None])

    def denoise(source: Path, target: Path) -> str:
        if (error := next(answers)) is not None:
            raise error
        return copy(source, target)

    outcomes = watched(folder, denoise)
    assert [next(outcomes), next(outcomes)] == [away, "first"]  # said once
    replace(folder / "scan.ply", b"second", age=-5.0)
    assert [next(outcomes), next(outcomes)] == [away, "second"]


def test_of_many_files_one_a_look_finds_a_server_away_and_in_the_next_another(folder: Path) -> None:
    for name in ("a.ply", "b.ply"):
        (folder / name).write_bytes(name.encode())
    asked: list[str] = []

    def denoise(source: Path, target: Path) -> str:
        asked.append(source.name)
        if len(asked) < 5 or source.name == "a.ply":  # that one is always cut off on its way
            raise ConnectionFailed("down")
        return copy(source, target)

    outcomes = watched(folder, denoise)
    assert [str(next(outcomes)) for _ in range(3)] == ["down", "b.ply", "first"]
    assert asked == ["a.ply", "b.ply", "scan.ply", "a.ply", "b.ply", "scan.ply"]
    assert [str(outcome) for outcome in once(folder, denoise)] == ["down"]


@pytest.mark.parametrize("lost", [NotFound("no such job"), JobExpired("removed")])
def test_what_a_server_has_lost_it_gets_once_more(folder: Path, lost: Exception) -> None:
    asked: list[str] = []

    def denoise(source: Path, target: Path) -> str:
        asked.append(source.read_text())
        if len(asked) in (1, 3, 4):
            raise lost
        return copy(source, target)

    outcomes = watched(folder, denoise)
    assert [next(outcomes), next(outcomes)] == [lost, "first"]
    replace(folder / "scan.ply", b"second", age=-5)
    assert [next(outcomes), next(outcomes)] == [lost, lost]
    replace(folder / "scan.ply", b"third", age=-10)
    assert next(outcomes) == "third"
    assert asked == ["first", "first", "second", "second", "third"]


def test_a_server_that_comes_later_gets_what_was_put_there_before(
    server: RunningServer, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    np.save(folder / "scan.npy", torus(400))
    (folder / "scan.ply").unlink()
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))  # taken, and nobody listens
        with Client(f"http://127.0.0.1:{listener.getsockname()[1]}") as client:
            outcomes = watched(folder, lambda source, target: client.denoise(source, target, iterations=1))
            assert isinstance(next(outcomes), ConnectionFailed)
            listener.listen()
            threading.Thread(target=forward, args=(listener, server.url), daemon=True).start()
            results = (outcome for outcome in outcomes if not isinstance(outcome, ConnectionFailed))
            assert next(results).points == 400
    assert np.load(folder / "clean" / "scan.npy").shape == (400, 3)


def forward(listener: socket.socket, url: str) -> None:
    """Pass connections on, until the listener is closed."""
    host, port = url.removeprefix("http://").split(":")
    with suppress(OSError):
        while True:
            here, _ = listener.accept()
            there = socket.create_connection((host, int(port)))
            for source, sink in ((here, there), (there, here)):
                threading.Thread(target=copy_bytes, args=(source, sink), daemon=True).start()


def copy_bytes(source: socket.socket, sink: socket.socket) -> None:
    with suppress(OSError), sink:
        while data := source.recv(65536):
            sink.sendall(data)


def test_a_link_to_itself_is_no_cloud(folder: Path) -> None:
    (folder / "loop.ply").symlink_to("loop.ply")
    assert once(folder) == ["first"]


def test_a_full_disk_is_tried_again_when_more_of_it_is_free(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = 100
    monkeypatch.setattr(watch.shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    asked: list[int] = []

    def denoise(source: Path, target: Path) -> str:
        asked.append(free)
        if free < 1000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return copy(source, target)

    outcomes = watched(folder, denoise)
    assert isinstance(next(outcomes), OSError)

    def tidied() -> None:
        nonlocal free
        free = 5000

    threading.Timer(0.3, tidied).start()
    assert next(outcomes) == "first"
    assert asked == [100, 5000]


@pytest.mark.parametrize(
    ("shut", "code"), [("scan.ply", errno.EACCES), ("clean", errno.EACCES), ("clean", errno.EROFS)]
)
def test_what_may_not_be_read_or_written_is_said_once_and_tried_again_when_it_may(
    shut: str, code: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    access, is_shut = os.access, True  # root may read and write everything
    monkeypatch.setattr(
        watch.os, "access", lambda path, mode: not (is_shut and path.name == shut) and access(path, mode)
    )

    def denoise(source: Path, target: Path) -> str:
        if is_shut:
            raise OSError(code, os.strerror(code), shut)
        return copy(source, target)

    outcomes = watched(folder, denoise)
    assert getattr(next(outcomes), "errno", None) == code

    def opened() -> None:  # as by chmod or a mount, of which neither size nor time tells
        nonlocal is_shut
        is_shut = False

    threading.Timer(0.1, opened).start()  # while it looks, some ten times
    assert next(outcomes) == "first"


def test_a_folder_for_results_that_goes_away_and_comes_back_is_no_failure_of_the_file(folder: Path) -> None:
    (folder / "clean").rmdir()
    outcomes = watched(folder, copy)
    assert isinstance(next(outcomes), FileNotFoundError)
    threading.Timer(0.1, (folder / "clean").mkdir).start()  # while it looks, some ten times
    assert next(outcomes) == "first"


def test_a_folder_for_results_that_goes_away_with_a_full_disk_is_waited_for(folder: Path) -> None:
    asked: list[str] = []

    def denoise(source: Path, target: Path) -> str:
        asked.append(source.name)
        if len(asked) == 1:
            target.parent.rmdir()
            raise OSError(errno.ENOSPC, "No space left on device")
        return copy(source, target)

    outcomes = watched(folder, denoise)
    assert isinstance(next(outcomes), OSError)
    threading.Timer(0.1, (folder / "clean").mkdir).start()  # while it looks, some ten times
    assert next(outcomes) == "first"
    assert len(asked) == 2


def test_a_folder_for_results_may_go_away_while_it_is_looked_at(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage, looks = shutil.disk_usage, iter([FileNotFoundError("gone"), OSError(errno.ESTALE, "stale")])

    def looked_at(path: Path) -> Any:
        if asked and (error := next(looks, None)):
            raise error
        return usage(path)

    asked: list[str] = []

    def denoise(source: Path, target: Path) -> str:
        asked.append(source.name)
        if len(asked) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        return copy(source, target)

    monkeypatch.setattr(watch.shutil, "disk_usage", looked_at)
    outcomes = watched(folder, denoise)
    assert isinstance(next(outcomes), OSError)
    assert next(outcomes) == "first"


def test_a_folder_that_goes_away_and_comes_back_is_watched_on_with_what_was_in_work(
    server: RunningServer, tmp_path: Path, folder: Path
) -> None:
    away = tmp_path.with_name("away")
    (results := tmp_path.with_name("results")).mkdir()
    (folder / "scan.ply").unlink()
    np.save(folder / "scan.npy", torus(400))
    asked: list[str] = []
    with Client(server.url) as client:

        def denoise(source: Path, target: Path) -> int:
            asked.append(source.name)
            if len(asked) == 1:
                folder.rename(away)  # as a share that is not to be reached
                threading.Timer(0.2, lambda: away.rename(folder)).start()  # while it looks, some twenty times
            return client.denoise(source, target, iterations=1).report.points

        outcomes = watch_folder(folder, results, denoise)
        of_file, of_folder, done = (next(outcomes) for _ in range(3))
    assert (of_file[0].name, type(of_file[1])) == ("scan.npy", FileNotFoundError)
    assert (of_folder[0], type(of_folder[1])) == (folder, FileNotFoundError)
    assert (done[0].name, done[1]) == ("scan.npy", 400)


def test_a_file_that_fails_is_tried_again_only_when_it_changes(folder: Path) -> None:
    asked: list[str] = []

    def denoise(source: Path, target: Path) -> str:
        asked.append(source.read_text())
        if asked[-1] == "first":
            raise MalformedFile("broken")
        return copy(source, target)

    outcomes = watched(folder, denoise)
    assert isinstance(next(outcomes), MalformedFile)
    threading.Timer(0.3, lambda: replace(folder / "scan.ply", b"second", age=-5.0)).start()
    assert next(outcomes) == "second"
    assert asked == ["first", "second"]
