"""Keep a folder clean: denoise every cloud that is put into it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from straightpcf.points.formats import FORMATS

__all__ = ["watch_folder"]

LOOK_SECONDS = 1.0

Outcome = tuple[Path, Any | Exception]


def watch_folder(
    folder: Path, target: Path, denoise: Callable[[Path, Path], Any], *, once: bool = False
) -> Iterator[Outcome]:
    """Denoise every cloud in `folder` that has no newer namesake in `target`, as they come; yield each outcome.

    A file is taken when its size and time have not changed for a second, so that one which is still being written is
    left alone; one that failed is tried again when it changes. once: end when nothing is left to do.
    """
    suffixes = {suffix for format in FORMATS for suffix in format.suffixes}
    failed: dict[Path, tuple[int, int]] = {}
    before: dict[Path, tuple[int, int]] = {}
    while True:
        seen = {
            path: _stamp(path)
            for path in sorted(folder.iterdir())
            if path.suffix.lower() in suffixes and not path.name.startswith(".") and path.is_file()
        }
        waiting = {
            path: stamp for path, stamp in seen.items() if failed.get(path) != stamp and not _is_done(path, target)
        }
        for path, stamp in waiting.items():
            if not once and before.get(path) != stamp:
                continue  # perhaps it still grows
            try:
                yield path, denoise(path, target / path.name)
            except Exception as error:
                failed[path] = stamp
                yield path, error
        if once:
            return
        before = seen
        time.sleep(LOOK_SECONDS)


def _stamp(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _is_done(path: Path, target: Path) -> bool:
    done = target / path.name
    return done.exists() and done.stat().st_mtime_ns >= path.stat().st_mtime_ns
