"""Own the folder of request files: one sub-folder per request, gone when the request is."""

from __future__ import annotations

import fcntl
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO

__all__ = ["Spool"]

_PREFIX = "spool-"
_LOCK = ".lock"


class Spool:
    """Hold one server's spool folder; opening also sweeps the folders of servers that were killed.

    A living server holds a file lock in its folder, so two servers can share a data_dir.
    """

    def __init__(self, data_dir: Path) -> None:
        data_dir.mkdir(parents=True, exist_ok=True)
        _sweep(data_dir)
        self._root = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=data_dir))
        self._lock: IO[bytes] = (self._root / _LOCK).open("wb")
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    def __enter__(self) -> Spool:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        shutil.rmtree(self._root, ignore_errors=True)
        self._lock.close()

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """Lend one fresh folder, removed with its contents at the end."""
        folder = Path(tempfile.mkdtemp(dir=self._root))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _sweep(data_dir: Path) -> None:
    for lock in data_dir.glob(f"{_PREFIX}*/{_LOCK}"):
        with lock.open("rb") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue  # its server lives
            shutil.rmtree(lock.parent, ignore_errors=True)
