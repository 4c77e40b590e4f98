"""Keep a folder clean: denoise every cloud that is put into it."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from straightpcf.points.errors import ConnectionFailed, JobExpired, NotFound, RequestTimeout, ServerBusy, Unauthorized
from straightpcf.points.formats import FORMATS

__all__ = ["watch_folder"]

LOOK_SECONDS = 1.0
MOST_LOOKS = 8  # that one waits for a server that is away
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)
_AWAY = (ConnectionFailed, RequestTimeout, ServerBusy)
_SUFFIXES = frozenset(suffix for format in FORMATS for suffix in format.suffixes)

Outcome = tuple[Path, Any | Exception]
Stamp = tuple[int, int]


def watch_folder(
    folder: Path, target: Path, denoise: Callable[[Path, Path], Any], *, once: bool = False
) -> Iterator[Outcome]:
    """Denoise every cloud in `folder` that has no namesake of the same time in `target`, as they come.

    A result gets the time of its input as it was before it was read: an input that is replaced meanwhile, even by an
    older file, is seen to be another. A namesake that was written after its input came is let be, too: somebody may
    have worked on a result. A file is taken when its size and time have not changed for a second, so that one which is
    still being written is left alone; one that failed is tried again when it changes, or, where only the server could
    not be had, which is said once, at a later look, or, where the disk was full or `target` away, when more of it is
    free or it is back, or, where it may not be read or `target` not be written into, when it may. A server that has
    lost a job, with its data, gets it once more. A `folder` that is away, as a share may be, is said once, and waited
    for. Yields each outcome. once: look once, and end. Raises Unauthorized: what a server that wants another key says
    of one file it says of all.
    """
    looks, is_away = _Looks(target, denoise, once=once), False
    while True:
        try:
            seen = _clouds_in(folder)
        except OSError as error:
            if once:
                raise
            if not is_away:
                yield folder, error
            is_away = True
        else:
            is_away = False
            yield from looks.take(seen)
            if once:
                return
        time.sleep(LOOK_SECONDS * looks.until_next)


class _Looks:
    """Remember, from look to look, what became of each cloud."""

    def __init__(self, target: Path, denoise: Callable[[Path, Path], Any], *, once: bool) -> None:
        self._target, self._denoise, self._once = target, denoise, once
        self._tried: dict[Path, Stamp] = {}  # the done ones too: not every file system keeps the time that it is told
        self._full: dict[Path, int] = {}  # bytes that were free when they were not enough, -1 where there was no folder
        self._shut: set[Path] = set()  # which this process might not read, or whose result it might not write
        self._lost: dict[Path, Stamp] = {}
        self._before: dict[Path, Stamp] = {}
        self._missed: Counter[Path] = Counter()  # how often each did not find the server
        self._said: set[str] = set()  # of a server that is away
        self.until_next = 1  # in LOOK_SECONDS; twice as long after each look at which the server was away

    def take(self, seen: dict[Path, Stamp]) -> Iterator[Outcome]:
        """Denoise those of the clouds in a folder whose turn it is, until one does not find the server.

        The next look begins with another one: it may be that this one alone is cut off on its way.
        """
        is_away = False
        for path, stamp in sorted(seen.items(), key=lambda item: self._missed[item[0]]):
            if (current := self._stamp_to_take(path, stamp)) is None:
                continue
            outcome = self._outcome(path, current)
            is_away = isinstance(outcome, _AWAY) and not self._once
            if not is_away or str(outcome) not in self._said:
                yield path, outcome
            if is_away:
                self._missed[path] += 1
                self._said.add(str(outcome))
                break
            self._said.clear()
        self.until_next = min(2 * self.until_next, MOST_LOOKS) if is_away else 1
        self._before = seen

    def _stamp_to_take(self, path: Path, stamp: Stamp) -> Stamp | None:
        """Return the stamp of a cloud as it is now, None where it is not its turn."""
        if self._tried.get(path) == stamp or _is_done(path, self._target / path.name, stamp):
            return None
        if path in self._full and _free(self._target) <= self._full[path]:
            return None
        if path in self._shut and _is_shut(path, self._target):
            return None
        self._shut.discard(path)
        if self._once:
            return _stamp(path)
        # It may still grow, and its turn may come long after the look.
        return stamp if self._before.get(path) == stamp == _stamp(path) else None

    def _outcome(self, path: Path, stamp: Stamp) -> Any | Exception:
        result = self._target / path.name
        try:
            report = self._denoise(path, result)
            os.utime(result, ns=(stamp[1], stamp[1]))
        except Unauthorized:
            raise
        except Exception as error:
            self._note_failure(path, stamp, error)
            return error
        self._tried[path] = stamp
        return report

    def _note_failure(self, path: Path, stamp: Stamp, error: Exception) -> None:
        if isinstance(error, _AWAY):
            return
        if isinstance(error, NotFound | JobExpired) and self._lost.get(path) != stamp:
            self._lost[path] = stamp
        elif isinstance(error, OSError) and error.errno in _NO_ROOM:
            self._full[path] = _free(self._target)
        elif _free(self._target) < 0:
            self._full[path] = -1
        elif isinstance(error, OSError) and _is_shut(path, self._target):
            self._shut.add(path)
        elif _stamp(path) is not None:  # else it is gone, or its folder is away: it may come back as it was
            self._tried[path] = stamp


def _clouds_in(folder: Path) -> dict[Path, Stamp]:
    """Return the stamps of a folder's clouds, by name; raises OSError where the folder is away."""
    return {
        path: stamp
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in _SUFFIXES and not path.name.startswith(".") and (stamp := _stamp(path))
    }


def _stamp(path: Path) -> Stamp | None:
    """Return the size and time of a file; None if it is none, or not any more."""
    try:
        status = path.stat()
    except OSError:  # gone meanwhile, a link to itself
        return None
    return (status.st_size, status.st_mtime_ns) if stat.S_ISREG(status.st_mode) else None


def _free(target: Path) -> int:
    """Return how many bytes are free where results go, -1 where no folder is there."""
    try:
        return shutil.disk_usage(target).free if target.is_dir() else -1
    except OSError:  # gone meanwhile, a share that hangs
        return -1


def _is_shut(path: Path, target: Path) -> bool:
    """Tell whether this process may not read a cloud, or not write into `target`."""
    return not (os.access(path, os.R_OK) and os.access(target, os.W_OK))


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
