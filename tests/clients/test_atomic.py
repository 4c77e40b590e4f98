"""Files are replaced as a whole, and stay what they were: their mode, a link."""

from __future__ import annotations

import errno
import os
import stat
from contextlib import suppress
from pathlib import Path

import pytest

from straightpcf.clients.atomic import check_target, replaced_when_complete


def write(path: Path, content: bytes) -> None:
    with replaced_when_complete(path) as unfinished:
        unfinished.write_bytes(content)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize("kept", [0o600, 0o640, 0o444])
def test_a_replaced_file_keeps_its_mode_and_is_never_open_to_more(kept: int, tmp_path: Path) -> None:
    (path := tmp_path / "a.ply").write_bytes(b"old")
    path.chmod(kept)
    with replaced_when_complete(path) as unfinished:
        assert mode(unfinished) == kept | stat.S_IWUSR
        unfinished.write_bytes(b"new")
    assert (path.read_bytes(), mode(path)) == (b"new", kept)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="root alone may give a file away")
@pytest.mark.parametrize("may", [True, False])
def test_a_replaced_file_stays_its_owners_where_the_system_lets_it(
    may: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path := tmp_path / "a.ply").write_bytes(b"old")
    path.chmod(0o600)
    os.chown(path, 1234, 4321)
    if not may:

        def refuse(*_: object) -> None:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

        monkeypatch.setattr(os, "chown", refuse)
    write(path, b"new")
    now = path.stat()
    assert (now.st_uid, now.st_gid) == ((1234, 4321) if may else (os.geteuid(), os.getegid()))
    assert (path.read_bytes(), mode(path)) == (b"new", 0o600)


def test_a_new_file_has_the_mode_of_any_new_file(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write(tmp_path / "a.ply", b"new")
    finally:
        os.umask(before)
    assert mode(tmp_path / "a.ply") == 0o640


def test_a_link_stays_one_and_what_it_points_to_is_replaced(tmp_path: Path) -> None:
    (elsewhere := tmp_path / "elsewhere").mkdir()
    (elsewhere / "real.ply").write_bytes(b"old")
    (link := tmp_path / "a.ply").symlink_to("elsewhere/real.ply")
    write(link, b"new")
    assert link.is_symlink()
    assert (elsewhere / "real.ply").read_bytes() == b"new"
    (dangling := tmp_path / "b.ply").symlink_to("elsewhere/none.ply")
    write(dangling, b"first")
    assert (elsewhere / "none.ply").read_bytes() == b"first"


def test_a_name_may_be_as_long_as_the_file_system_lets_it(tmp_path: Path) -> None:
    write(path := tmp_path / f"{'点' * 83}.xyz", b"new")  # 253 bytes
    assert path.read_bytes() == b"new"


def test_a_link_that_leads_nowhere_is_named(tmp_path: Path) -> None:
    (loop := tmp_path / "loop.ply").symlink_to("loop.ply")
    (lost := tmp_path / "lost.ply").symlink_to("none/real.ply")
    for path, said in ((loop, r"loop\.ply"), (lost, r"lost\.ply is a link to none/real\.ply")):
        with pytest.raises(OSError, match=said):
            check_target(path)


def test_a_disk_that_is_full_is_told_with_the_place(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"a\.ply"), replaced_when_complete(tmp_path / "a.ply"):
        Path("/dev/full").write_bytes(b"no room")


def test_a_block_that_fails_changes_and_leaves_nothing(tmp_path: Path) -> None:
    (path := tmp_path / "a.ply").write_bytes(b"old")
    with suppress(KeyboardInterrupt), replaced_when_complete(path) as unfinished:
        unfinished.write_bytes(b"half")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(fifo := tmp_path / "fifo")  # as little a file as /dev/null
    for path, said in ((fifo, "no file"), (tmp_path, "no file"), (tmp_path / "none" / "a.ply", "no folder")):
        for act in (check_target, lambda path: write(path, b"new")):
            with pytest.raises(OSError, match=said):
                act(path)
    assert fifo.is_fifo()
    assert list(tmp_path.iterdir()) == [fifo]


def test_it_is_on_the_disk_before_it_takes_a_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path := tmp_path / "a.ply").write_bytes(b"old")
    synced: list[tuple[bool, bytes]] = []
    real = os.fsync

    def fsync(handle: int) -> None:
        real(handle)
        synced.append((stat.S_ISDIR(os.fstat(handle).st_mode), path.read_bytes()))

    monkeypatch.setattr(os, "fsync", fsync)
    write(path, b"new")
    assert synced == [(False, b"old"), (True, b"new")]


def test_a_folder_that_takes_no_file_is_named_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"'/proc/self'$"):  # nobody may write there, root included
        check_target(Path("/proc/self/a.ply"))
    check_target(tmp_path / "a.ply")
    assert not any(tmp_path.iterdir())
