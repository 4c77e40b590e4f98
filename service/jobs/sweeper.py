"""Tidy up from time to time: what is over its time, what nobody owns, what died, what servers left."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Collection
from pathlib import Path

from straightpcf.points.errors import SpoolFull
from straightpcf.service.jobs.folders import JobFolders
from straightpcf.service.jobs.full_disk import DISK_TROUBLES, keep_reserve
from straightpcf.service.jobs.runner import StoreCall
from straightpcf.service.jobs.store import BATCH, JobStore
from straightpcf.service.jobs.troubles import Troubles

__all__ = ["Sweeper"]

SWEEP_SECONDS = 30.0
# Of what is over its time: after so many a sweep sees to the rest of its work, and the next one begins at once. A
# server that was off for long starts behind the first of them.
MOST_BATCHES = 100
PAUSE_SECONDS = 0.01  # between two of them: another server that waits for the database's lock finds it free

logger = logging.getLogger("uvicorn.error")  # the log that `straightpcf serve` shows


class Sweeper:
    """Sweep a data directory at the start and every SWEEP_SECONDS."""

    def __init__(
        self, data_dir: Path, *, folders: JobFolders, call: StoreCall, notify: Callable[[str], None],
        result_ttl_seconds: float, row_ttl_seconds: float,
    ) -> None:  # fmt: skip
        self._data_dir, self._folders, self._call, self._notify = data_dir, folders, call, notify
        self._result_ttl, self._row_ttl = result_ttl_seconds, row_ttl_seconds
        self._troubles = Troubles()
        self._is_behind = False
        self._loop: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Sweep once, and then from time to time."""
        await self.sweep(batches=1)
        self._loop = asyncio.create_task(self._keep_sweeping())

    async def stop(self) -> None:
        """Sweep no more."""
        if self._loop is not None:
            self._loop.cancel()
            await asyncio.wait([self._loop])

    async def sweep(self, *, batches: int = MOST_BATCHES) -> None:
        """Expire what is old, remove what nobody owns, take back what died: first what makes room.

        batches: how many of BATCH jobs may expire, and of as many old rows be forgotten.
        What keeps a step from its end keeps none of the others from their beginning.
        """
        steps: dict[str, Callable[[], Awaitable[None]]] = {
            "jobs that are over their time are kept": lambda: self._remove_expired(batches),
            "uploads that nobody finished are kept": self._drop_uploads,
            "files that no job owns are kept": self._remove_orphans,
            "jobs of servers that died are not taken back": self._recover,
            f"nothing is reserved in {self._data_dir} for a full disk": self._keep_reserve,
        }
        for trouble, step in steps.items():
            said = f"{trouble} until the next sweep of the job store"
            try:
                await step()
            except DISK_TROUBLES as fault:
                self._troubles.say(said, fault)
            except Exception:
                logger.exception(said)
            else:
                self._troubles.over(said)

    async def _keep_sweeping(self) -> None:
        while True:
            await asyncio.sleep(0 if self._is_behind else SWEEP_SECONDS)
            await self.sweep()

    async def _remove_expired(self, batches: int) -> None:
        """Expire batch by batch, for others to be served between two; what a crash leaves of one is an orphan."""
        self._is_behind = False
        for _ in range(batches):
            await self._remove(folders := await self._expire())
            forgotten = await self._call(JobStore.forget, rows_after=self._row_ttl)
            if not (folders or forgotten or await self._call(JobStore.shrink)):
                return
            await asyncio.sleep(PAUSE_SECONDS)
        self._is_behind = True

    async def _drop_uploads(self) -> None:
        await asyncio.to_thread(self._folders.drop_uploads)

    async def _remove_orphans(self) -> None:
        old = await asyncio.to_thread(self._folders.orphans)
        for at in range(0, len(old), BATCH):
            await self._remove(await self._call(JobStore.unknown, old[at : at + BATCH]))

    async def _recover(self) -> None:
        servers = await self._call(JobStore.servers)
        dead = await asyncio.to_thread(self._folders.dead_servers, servers - {self._folders.server})
        for id in await self._call(JobStore.recover, dead, expires_in=self._result_ttl):
            logger.warning("nobody worked on job %s any more: a server died, or could not write", id)
            self._notify(id)

    async def _keep_reserve(self) -> None:
        await asyncio.to_thread(keep_reserve, self._data_dir)

    async def _expire(self) -> list[str]:
        """Mark a batch of what is over its time; on a full disk files of it make the room that this takes."""
        removed = 0
        while True:
            try:
                expired: list[str] = await self._call(JobStore.expire)
                return expired
            except SpoolFull:
                if not (over := await self._call(JobStore.over, removed)):
                    raise
                await self._remove(over)
                removed += len(over)

    async def _remove(self, folders: Collection[str]) -> None:
        for folder in folders:
            await asyncio.to_thread(self._folders.remove, folder)
