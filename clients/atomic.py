"""Write a file so that it is there complete, or not at all."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["replaced_when_complete"]


@contextmanager
def replaced_when_complete(path: Path) -> Iterator[Path]:
    """Lend a path beside `path`; the file written there takes its place if the block ends well, else it vanishes."""
    unfinished = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.part{path.suffix}")
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
