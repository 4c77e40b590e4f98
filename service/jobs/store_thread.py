"""The thread on which the store's transactions are made: SQLite blocks, and the event loop must not."""

from __future__ import annotations

import asyncio
import sqlite3
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from straightpcf.service.jobs.database import OpenedFile
from straightpcf.service.jobs.full_disk import full_disk_as_spool_full, is_full, release_reserve
from straightpcf.service.jobs.store import JobStore

__all__ = ["StoreThread"]

# How long a transaction may wait for another process's lock. It counts from when it was asked for: they follow one
# another here, and each would wait for the patience of all before it. On a machine that lags a little is always left.
LOCK_SECONDS, _LEAST_LOCK_SECONDS = 5.0, 0.2
# What ends or deletes jobs, and so may take the reserve of a full disk.
_MAKES_ROOM = frozenset[object]({JobStore.delete, JobStore.fail, JobStore.recover, JobStore.request_cancel})

_P = ParamSpec("_P")
_T = TypeVar("_T")


class StoreThread:
    """Own the store of a data directory, from `open` to `close`."""

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="job-store")
        self._store: JobStore
        self._file: OpenedFile

    async def open(self, bytes_of: Callable[[str], int]) -> None:
        """Open the store; raises as `open_database` does."""
        path = self._data_dir / "jobs.sqlite3"
        self._store = await asyncio.get_running_loop().run_in_executor(self._thread, JobStore, path, bytes_of)
        self._file = OpenedFile(path)

    async def close(self) -> None:
        """Close the store behind the last transaction."""
        await asyncio.get_running_loop().run_in_executor(self._thread, self._store.close)
        self._file.close()
        self._thread.shutdown()

    @property
    def in_place(self) -> bool:
        """Tell whether the store's file is where it was opened, and nobody else wrote into it."""
        return self._file.in_place

    async def __call__(
        self, function: Callable[Concatenate[JobStore, _P], _T], *args: _P.args, **kwargs: _P.kwargs
    ) -> _T:
        """Make one transaction; it is carried out even if the caller is cancelled.

        Raises SpoolFull where the disk is full (what makes room there takes the reserve), OSError where the store's
        file was deleted, replaced or overwritten, and sqlite3.OperationalError where others lock it for LOCK_SECONDS.
        """
        asked = time.monotonic()

        def carry_out() -> _T:
            self._file.check()
            self._store.wait_for_locks(max(_LEAST_LOCK_SECONDS, asked + LOCK_SECONDS - time.monotonic()))
            try:
                return function(self._store, *args, **kwargs)
            except sqlite3.Error as exc:
                if not (is_full(exc) and self._made_room(take_reserve=function in _MAKES_ROOM)):
                    raise
                return function(self._store, *args, **kwargs)
            finally:
                self._file.keep_up()

        with full_disk_as_spool_full():
            return await asyncio.get_running_loop().run_in_executor(self._thread, carry_out)

    def _made_room(self, *, take_reserve: bool) -> bool:
        """Tell whether a full disk has room for a transaction now: where the -wal was, if it could be emptied.

        Were the reserve left to what is written next, renewed leases would use it up within a minute.
        """
        try:
            self._store.empty_wal()
        except sqlite3.Error as exc:
            if not (is_full(exc) and take_reserve and release_reserve(self._data_dir)):
                return False
            with suppress(sqlite3.Error):
                self._store.empty_wal()
        return True
