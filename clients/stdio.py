"""Files in the place of stdin, stdout and pipes: formats are read from files."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, TextIO

from straightpcf.clients.atomic import place_named
from straightpcf.clients.console import to_stdout
from straightpcf.points.errors import InvalidRequest

__all__ = ["STDIO", "content_of", "given_path", "input_file", "input_name", "is_stream", "output_file", "stdout"]

STDIO = Path("-")


def given_path(text: str) -> Path:
    """Return an argument as a path: ./- is a file, and its Path would be that of - alone."""
    found = Path(text)
    return found.absolute() if found == STDIO and text != "-" else found


def stdout() -> BinaryIO:
    """Return what takes bytes for stdout; raises InvalidRequest where it is closed."""
    return _open(sys.stdout, "stdout").buffer


def is_stream(source: Path) -> bool:
    """Say whether an input is stdin or a pipe, such as a shell's <(...): it can be read once, and has no size."""
    return source == STDIO or source.is_fifo() or source.is_char_device()


def input_name(source: Path) -> str | None:
    """Return what an input is called: nothing says it of stdin, and of /dev/stdin or /dev/fd/63."""
    return None if is_stream(source) and not source.suffix else source.name


@contextmanager
def _opened(source: Path) -> Iterator[BinaryIO]:
    """Open a stream; raises InvalidRequest where stdin is closed."""
    if source == STDIO:
        yield _open(sys.stdin, "stdin").buffer
    else:
        with source.open("rb") as stream:
            yield stream


def content_of(source: Path) -> bytes:
    """Return what a stream has."""
    with _opened(source) as stream:
        return stream.read()


@contextmanager
def input_file(source: Path, name: str | None) -> Iterator[Path]:
    """Lend the file to read, which for a stream holds what that had; name: what its format is told by."""
    from straightpcf.points.formats import recognised
    from straightpcf.points.formats.base import HEAD_BYTES

    if not is_stream(source):
        if not source.is_file():
            raise FileNotFoundError(f"{source} is {'a folder' if source.is_dir() else 'no file'}")
        yield source
        return
    with tempfile.NamedTemporaryFile() as spool:
        with _opened(source) as stream, place_named(spool.name):
            shutil.copyfileobj(stream, spool)
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
        with path.open("rb") as result, to_stdout():
            shutil.copyfileobj(result, out)
            out.flush()


def _open(stream: TextIO | None, name: str) -> TextIO:
    if stream is None:
        raise InvalidRequest(f"{name} is closed")
    return stream
