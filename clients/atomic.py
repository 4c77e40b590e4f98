"""Write a file so that it is there complete, or not at all."""

from __future__ import annotations

import os
import stat
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["replaced_when_complete"]


@contextmanager
def replaced_when_complete(path: Path) -> Iterator[Path]:
    """Lend an empty file beside `path`, which takes its place if the block ends well, else it vanishes.

    A file that is replaced hands on its mode, and a symbolic link stays one: what it points to is replaced.
    """
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
