"""One spawned process per device on this machine; a dead one is replaced."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from straightpcf.points.errors import InternalError, StraightPCFError
from straightpcf.service.backends.base import FileJob, FileReport, Listener, WorkerDied
from straightpcf.service.backends.process import WorkerProcess
from straightpcf.service.backends.worker import WorkerSpec

__all__ = ["LocalBackend"]

FIRST_RESTART_DELAY_SECONDS = 0.5
MAX_RESTART_DELAY_SECONDS = 30.0
STOP_PATIENCE_SECONDS = 5.0

logger = logging.getLogger("uvicorn.error")  # the log that `straightpcf serve` shows


class LocalBackend:
    """Keep one worker alive for every spec and give each job, in order of arrival, to the first that is idle.

    on_failure: called once if a worker says that it can never start (no such device, no such weights).
    """

    def __init__(self, specs: list[WorkerSpec], *, on_failure: Callable[[], None] = lambda: None) -> None:
        self._specs = specs
        self.on_failure = on_failure
        self._failure: StraightPCFError | None = None
        self._idle: asyncio.Queue[WorkerProcess | None] = asyncio.Queue()  # None: look at the failure
        self._turn = asyncio.Lock()  # fair, where a queue lets a newcomer overtake
        self._keepers: list[asyncio.Task[None]] = []
        self._warm: dict[WorkerProcess, str] = {}
        self.restarts = 0

    @property
    def devices(self) -> tuple[str, ...]:
        """Name the device of every worker that is warm."""
        return tuple(self._warm.values())

    @property
    def slots(self) -> int:
        """Say how many jobs run at once when every worker is warm."""
        return len(self._specs)

    @property
    def failure(self) -> StraightPCFError | None:
        """Say why no job will ever run here."""
        return self._failure

    async def start(self) -> None:
        """Begin to start one worker per spec."""
        self._keepers = [asyncio.create_task(self._keep(spec)) for spec in self._specs]

    async def stop(self) -> None:
        """End every worker; jobs must have been cancelled before."""
        for keeper in self._keepers:
            keeper.cancel()
        await asyncio.gather(*self._keepers, return_exceptions=True)

    async def wait_idle(self) -> None:
        """Return as soon as a worker is warm and free; raises `failure`."""
        self._idle.put_nowait(await self._claim())

    async def run(self, job: FileJob, listener: Listener) -> FileReport:
        """Run a job on the first worker that is free; raises its error, WorkerDied or FilesUnusable."""
        worker = await self._claim()
        try:
            listener.on_start(self._warm.get(worker, ""))
            return await worker.run(job, listener)
        finally:
            if worker.alive:
                self._idle.put_nowait(worker)

    async def _claim(self) -> WorkerProcess:
        async with self._turn:
            while True:
                worker = await self._idle.get()
                if worker is None:
                    self._idle.put_nowait(None)
                    raise self._failure or InternalError("no worker")
                if worker.alive:
                    return worker

    async def _keep(self, spec: WorkerSpec) -> None:
        """Keep one worker alive, waiting longer after each one that died before it was ready."""
        delay = FIRST_RESTART_DELAY_SECONDS
        while self._failure is None:
            try:
                await self._offer(spec)
                delay = FIRST_RESTART_DELAY_SECONDS
                continue
            except WorkerDied as death:
                logger.warning("%s; starting another in %g s", death, delay)
            except StraightPCFError as error:
                self._fail(error)
                continue
            except Exception:  # a machine without a thread left, say: it passes, and jobs wait for this worker
                logger.exception("a worker could not be looked after; starting another in %g s", delay)
            await asyncio.sleep(delay)
            delay = min(2 * delay, MAX_RESTART_DELAY_SECONDS)

    async def _offer(self, spec: WorkerSpec) -> None:
        """Start a worker, offer it to jobs and return when it has died; raises WorkerDied if it never was ready."""
        try:
            worker = WorkerProcess(spec)
        except OSError as exc:  # no file descriptor, process or memory is left: others may let go of some
            raise WorkerDied(f"a worker could not be started ({exc})") from exc
        try:
            try:
                self._warm[worker] = await asyncio.shield(worker.ready)
            except WorkerDied:  # where there is no memory for the network, say, again and again
                self.restarts += 1
                raise
            self._idle.put_nowait(worker)
            logger.info("worker %s is ready on %s", worker.pid, self._warm[worker])
            await asyncio.shield(worker.died)
            self.restarts += 1
            logger.warning("worker %s died; starting another", worker.pid)
        finally:
            self._warm.pop(worker, None)
            await worker.stop(patience_seconds=STOP_PATIENCE_SECONDS)

    def _fail(self, error: StraightPCFError) -> None:
        logger.error("no worker can start: %s", error)
        self._failure = error
        self._idle.put_nowait(None)
        self.on_failure()
