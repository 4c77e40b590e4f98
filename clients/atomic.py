"""Write a file so that it is there complete, or not at all."""

from __future__ import annotations

import os
import stat
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["check_target", "replaced_when_complete"]


def check_target(path: Path) -> None:
    """Raise OSError where a file cannot be written or replaced, before work is put into what would be lost."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent} is no folder to write {path.name} to")
    if path.exists() and not path.is_file():  # /dev/null, too, would be taken away
        raise FileExistsError(f"{path} is there and is no file: a result cannot take its place")


@contextmanager
def replaced_when_complete(path: Path) -> Iterator[Path]:
    """Lend an empty file beside `path`, which takes its place if the block ends well, else it vanishes.

    A file that is replaced hands on its mode, and a symbolic link stays one: what it points to is replaced.
    """
    check_target(path)
    target = path.resolve()
    mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else None
    unfinished = target.with_name(f".{target.stem}.{uuid.uuid4().hex[:12]}.part{target.suffix}")
    # Nobody who may not read the result can read it while it is written; a read-only one has to be written, too.
    os.close(os.open(unfinished, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666 if mode is None else mode | stat.S_IWUSR))
    try:
        yield unfinished
        if mode is not None:
            unfinished.chmod(mode)
        unfinished.replace(target)
    finally:
        unfinished.unlink(missing_ok=True)
