"""Files in the place of stdin and stdout: formats are read from files, not from pipes."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, TextIO

from straightpcf.clients.atomic import place_named
from straightpcf.points.errors import InvalidRequest

__all__ = ["STDIO", "input_file", "output_file", "stdin", "stdout"]

STDIO = Path("-")


def stdin() -> BinaryIO:
    """Return stdin's bytes; raises InvalidRequest where it is closed."""
    return _open(sys.stdin, "stdin").buffer


def stdout() -> BinaryIO:
    """Return what takes bytes for stdout; raises InvalidRequest where it is closed."""
    return _open(sys.stdout, "stdout").buffer


@contextmanager
def input_file(source: Path, name: str | None) -> Iterator[Path]:
    """Lend the file to read, which for - holds what stdin had; name: what its format is told by."""
    from straightpcf.points.formats import recognised
    from straightpcf.points.formats.base import HEAD_BYTES

    if source != STDIO:
        if not source.is_file():
            raise FileNotFoundError(f"{source} is no file")
        yield source
        return
    with tempfile.NamedTemporaryFile() as spool:
        with place_named(spool.name):
            shutil.copyfileobj(stdin(), spool)
            spool.flush()
        spool.seek(0)
        recognised(spool.read(HEAD_BYTES), name)
        yield Path(spool.name)


@contextmanager
def output_file(target: Path, suffix: str) -> Iterator[Path]:
    """Lend the file to write, which for - goes to stdout if the block ends well."""
    if target != STDIO:
        yield target
        return
    out = stdout()
    with tempfile.TemporaryDirectory() as folder:
        with place_named(folder):
            yield (path := Path(folder) / f"result{suffix}")
        with path.open("rb") as result, place_named("stdout"):
            shutil.copyfileobj(result, out)
            out.flush()


def _open(stream: TextIO | None, name: str) -> TextIO:
    if stream is None:
        raise InvalidRequest(f"{name} is closed")
    return stream
