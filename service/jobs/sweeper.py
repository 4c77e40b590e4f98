"""Tidy up from time to time: what is over its time, what nobody owns, what died, what servers left."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection
from pathlib import Path

from straightpcf.points.errors import SpoolFull
from straightpcf.service.jobs.folders import JobFolders
from straightpcf.service.jobs.full_disk import DISK_TROUBLES, keep_reserve
from straightpcf.service.jobs.runner import StoreCall
from straightpcf.service.jobs.store import JobStore

__all__ = ["Sweeper"]

SWEEP_SECONDS = 30.0

logger = logging.getLogger("uvicorn.error")  # the log that `straightpcf serve` shows


class Sweeper:
    """Sweep a data directory at the start and every SWEEP_SECONDS."""

    def __init__(
        self, data_dir: Path, *, folders: JobFolders, call: StoreCall, notify: Callable[[str], None],
        result_ttl_seconds: float, row_ttl_seconds: float,
    ) -> None:  # fmt: skip
        self._data_dir, self._folders, self._call, self._notify = data_dir, folders, call, notify
        self._result_ttl, self._row_ttl = result_ttl_seconds, row_ttl_seconds
        self._loop: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Sweep once, and then from time to time."""
        await self._try()
        self._loop = asyncio.create_task(self._keep_sweeping())

    async def stop(self) -> None:
        """Sweep no more."""
        if self._loop is not None:
            self._loop.cancel()
            await asyncio.wait([self._loop])

    async def sweep(self) -> None:
        """Expire what is old, remove what nobody owns, take back what died: first what makes room."""
        await self._remove(await self._expire())
        await self._remove(await self._call(JobStore.unknown, await asyncio.to_thread(self._folders.orphans)))
        servers = await self._call(JobStore.servers)
        dead = await asyncio.to_thread(self._folders.dead_servers, servers - {self._folders.server})
        for id in await self._call(JobStore.recover, dead, expires_in=self._result_ttl):
            logger.warning("nobody worked on job %s any more: a server died, or could not write", id)
            self._notify(id)
        await asyncio.to_thread(keep_reserve, self._data_dir)

    async def _keep_sweeping(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_SECONDS)
            await self._try()

    async def _try(self) -> None:
        try:
            await self.sweep()
        except DISK_TROUBLES as fault:
            logger.warning("a sweep of the job store failed; another follows: %r", fault)
        except Exception:
            logger.exception("a sweep of the job store failed; another follows")

    async def _expire(self) -> list[str]:
        """Mark what is over its time; on a full disk its files make the room that this takes."""
        try:
            return await self._mark_expired()
        except SpoolFull:
            await self._remove(await self._call(JobStore.over))
            return await self._mark_expired()

    async def _mark_expired(self) -> list[str]:
        expired: list[str] = await self._call(JobStore.expire, rows_after=self._row_ttl)
        return expired

    async def _remove(self, folders: Collection[str]) -> None:
        for folder in folders:
            await asyncio.to_thread(self._folders.remove, folder)
