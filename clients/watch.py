"""Keep a folder clean: denoise every cloud that is put into it."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from straightpcf.points.errors import ConnectionFailed, JobExpired, NotFound, RequestTimeout, ServerBusy, Unauthorized
from straightpcf.points.formats import FORMATS

__all__ = ["watch_folder"]

LOOK_SECONDS = 1.0
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)

Outcome = tuple[Path, Any | Exception]
Stamp = tuple[int, int]


def watch_folder(
    folder: Path, target: Path, denoise: Callable[[Path, Path], Any], *, once: bool = False
) -> Iterator[Outcome]:
    """Denoise every cloud in `folder` that has no namesake of the same time in `target`, as they come.

    A result gets the time of its input as it was before it was read: an input that is replaced meanwhile, even by an
    older file, is seen to be another. A namesake that was written after its input came is let be, too: somebody may
    have worked on a result. A file is taken when its size and time have not changed for a second, so that one
    which is still being written is left alone; one that failed is tried again when it changes, or, where only the
    server could not be had, at the next look, or, where the disk was full or `target` away, when more of it is free
    or it is back. A server that has lost a job, with its data, gets it once more. A `folder` that is away, as a share
    may be, is said once, and waited for. Yields each outcome. once: look once, and end. Raises Unauthorized: what a
    server that wants another key says of one file it says of all.
    """
    suffixes = {suffix for format in FORMATS for suffix in format.suffixes}
    tried: dict[Path, Stamp] = {}  # the done ones too: not every file system keeps the time that it is told
    full: dict[Path, int] = {}  # bytes that were free when they were not enough, -1 where there was no folder
    lost: dict[Path, Stamp] = {}
    before: dict[Path, Stamp] = {}
    is_away = False
    while True:
        try:
            inside = sorted(folder.iterdir())
        except OSError as error:
            if once:
                raise
            if not is_away:
                yield folder, error
            is_away = True
            time.sleep(LOOK_SECONDS)
            continue
        is_away = False
        seen = {
            path: stamp
            for path in inside
            if path.suffix.lower() in suffixes and not path.name.startswith(".") and (stamp := _stamp(path))
        }
        for path, stamp in seen.items():
            result = target / path.name
            if tried.get(path) == stamp or _is_done(path, result, stamp) or _is_full(target, full.get(path)):
                continue
            if not once and before.get(path) != stamp:
                continue  # perhaps it still grows
            now = _stamp(path)  # its turn may come long after the look
            if now is None or (now != stamp and not once):
                continue
            stamp = now
            try:
                report = denoise(path, result)
                os.utime(result, ns=(stamp[1], stamp[1]))
            except Unauthorized:
                raise
            except (ConnectionFailed, RequestTimeout, ServerBusy) as error:
                yield path, error
            except Exception as error:
                if isinstance(error, NotFound | JobExpired) and lost.get(path) != stamp:
                    lost[path] = stamp
                elif isinstance(error, OSError) and error.errno in _NO_ROOM:
                    full[path] = shutil.disk_usage(target).free
                elif not target.is_dir():
                    full[path] = -1
                elif _stamp(path) is not None:  # else it is gone, or its folder is away: it may come back as it was
                    tried[path] = stamp
                yield path, error
            else:
                tried[path] = stamp
                yield path, report
        if once:
            return
        before = seen
        time.sleep(LOOK_SECONDS)


def _stamp(path: Path) -> Stamp | None:
    """Return the size and time of a file; None if it is none, or not any more."""
    try:
        status = path.stat()
    except OSError:  # gone meanwhile, a link to itself
        return None
    return (status.st_size, status.st_mtime_ns) if stat.S_ISREG(status.st_mode) else None


def _is_full(target: Path, free: int | None) -> bool:
    return free is not None and (not target.is_dir() or shutil.disk_usage(target).free <= free)


def _is_done(path: Path, result: Path, stamp: Stamp) -> bool:
    done = _stamp(result)
    return done is not None and (done[1] == stamp[1] or _is_later(result, path))


def _is_later(result: Path, path: Path) -> bool:
    """Tell whether a result was written after its input came, in its place or by itself: of which `ctime` tells."""
    try:
        came, written = path.stat().st_ctime_ns, result.stat()
    except OSError:
        return False
    # Both: the time of a result may be told, as that of an input.
    return os.name == "posix" and min(written.st_mtime_ns, written.st_ctime_ns) > came
