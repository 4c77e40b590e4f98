"""Write a file so that it is there complete, or not at all."""

from __future__ import annotations

import errno
import os
import stat
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["check_target", "place_named", "replaced_when_complete"]

_NAME = 40  # characters of a name that a file beside it begins with: with its marks it may be no longer than 255 bytes
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def check_target(path: Path) -> None:
    """Raise OSError where a file cannot be written or replaced, before work is put into what would be lost."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent} is no folder to write {path.name} to")
    if not _target(path).parent.is_dir():
        raise FileNotFoundError(f"{path} is a link to {path.readlink()}, in a folder that is not there")
    if path.exists() and not path.is_file():  # /dev/null, too, would be taken away
        raise FileExistsError(f"{path} is there and is no file: a result cannot take its place")
    probe = _beside(_target(path))
    try:  # which a read-only disk lets nobody, whatever the folder's mode says
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        probe.unlink()
    except OSError as error:
        raise type(error)(error.errno, error.strerror, os.fspath(path.parent)) from None


@contextmanager
def place_named(path: str | Path) -> Iterator[None]:
    """Say of a disk that is full, or a file that may not grow, where that is: to a write nobody has told it."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno in _NO_ROOM:
            error.filename = os.fspath(path)
        raise


@contextmanager
def replaced_when_complete(path: Path) -> Iterator[Path]:
    """Lend an empty file beside `path`, which takes its place if the block ends well, else it vanishes.

    It is on the disk before it does: what it replaces may be all that is left of a result. A file that is replaced
    hands on its mode, and its owner and group where the system lets it; a symbolic link stays one: what it points to is
    replaced.
    """
    check_target(path)
    target = _target(path)
    before = target.stat() if target.exists() else None
    mode = 0o666 if before is None else stat.S_IMODE(before.st_mode) | stat.S_IWUSR
    unfinished = _beside(target)
    # Nobody who may not read the result can read it while it is written; a read-only one has to be written, too.
    os.close(os.open(unfinished, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode))
    try:
        with place_named(path):
            yield unfinished
            with unfinished.open("rb+") as file:
                os.fsync(file.fileno())
        if before is not None:
            _hand_over(unfinished, before)
            unfinished.chmod(stat.S_IMODE(before.st_mode))  # after that: a new owner takes bits of it away
        unfinished.replace(target)
        _sync_folder(target.parent)
    finally:
        unfinished.unlink(missing_ok=True)


def _beside(target: Path) -> Path:
    return target.with_name(f".{target.stem[:_NAME]}.{uuid.uuid4().hex[:12]}.part{target.suffix[:_NAME]}")


def _hand_over(path: Path, before: os.stat_result) -> None:
    """Give a file the owner and group of the one that it replaces: root's would lock its owner out of a private one."""
    now = path.stat()
    if os.name != "posix" or (now.st_uid, now.st_gid) == (before.st_uid, before.st_gid):
        return
    try:
        os.chown(path, before.st_uid, before.st_gid)
    except OSError:  # root alone may give a file away; to a group of one's own anybody may
        with suppress(OSError):
            os.chown(path, -1, before.st_gid)


def _sync_folder(folder: Path) -> None:
    if os.name != "posix":  # Windows opens no folders
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _target(path: Path) -> Path:
    """Follow links; what they end at need not be there."""
    target = Path(os.path.realpath(path))
    if target.is_symlink():  # of a circle one is left
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), os.fspath(path))
    return target
