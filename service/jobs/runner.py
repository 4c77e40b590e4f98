"""Work on queued jobs: claim, hand to the backend, write down what happens, deliver; one loop per worker."""

from __future__ import annotations

import asyncio
import logging
import math
import sqlite3
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from typing import Any, Literal, Protocol

from straightpcf.points.errors import InternalError, JobCanceled, StraightPCFError
from straightpcf.points.formats import format_named
from straightpcf.service.backends.base import Backend, FileJob, FileReport, FilesUnusable, WorkerDied
from straightpcf.service.jobs.folders import INPUT, JobFolders
from straightpcf.service.jobs.full_disk import DISK_TROUBLES
from straightpcf.service.jobs.record import Claim, EventKind, ResultInfo
from straightpcf.service.jobs.result_name import result_name
from straightpcf.service.jobs.store import JobStore
from straightpcf.service.jobs.troubles import Troubles

__all__ = ["JobRunner", "StoreCall"]

MAX_DEATHS = 3
LEASE_SECONDS = 15.0
HEARTBEAT_SECONDS = 1.0
POLL_SECONDS = 1.0  # for jobs that another server took in
END_TRIES = 30  # to write down how a job ended, a POLL_SECONDS apart: what was computed is not computed again

_NOT_TAKEN = "jobs cannot be taken or written down; leases will run out"
_NOT_RENEWED = "the leases could not be renewed; another try follows"

Reason = Literal["canceled", "shutdown", "lost"]

logger = logging.getLogger("uvicorn.error")  # the log that `straightpcf serve` shows


class StoreCall(Protocol):
    """Run one method of the store on its thread."""

    def __call__(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Awaitable[Any]:
        """Return what it returns."""


class JobRunner:
    """Run jobs on a backend under a lease that a heartbeat renews."""

    def __init__(
        self, backend: Backend, *, folders: JobFolders, call: StoreCall, notify: Callable[[str], None],
        max_points: int, result_ttl_seconds: float,
    ) -> None:  # fmt: skip
        self._backend, self._folders, self._call, self._notify = backend, folders, call, notify
        self._max_points, self._ttl = max_points, result_ttl_seconds
        self._running: set[_Running] = set()
        self._troubles = Troubles()  # of all loops together: their disk is one
        self._work = asyncio.Event()
        self._loops: list[asyncio.Task[None]] = []
        self._stopping = False

    def start(self) -> None:
        """Begin to take jobs as soon as workers are warm."""
        self._loops = [asyncio.create_task(self._serve()) for _ in range(self._backend.slots)]
        self._loops.append(asyncio.create_task(self._beat()))

    def wake(self) -> None:
        """Tell that there is a new job."""
        self._work.set()

    async def cancel(self, folder: str) -> None:
        """Stop working on the job of a folder, if this server does."""
        for running in [running for running in self._running if running.claim.record.folder == folder]:
            await running.end("canceled")

    async def stop(self, patience: Callable[[], float]) -> None:
        """Take nothing more, let what runs finish for a while, and put back what did not.

        patience: says how many seconds of that while are left.
        """
        self._stopping = True
        while self._running and (left := patience()) > 0:
            overs = [running.over for running in self._running]
            await asyncio.wait(overs, timeout=min(left, POLL_SECONDS))
        await asyncio.gather(*(running.end("shutdown") for running in self._running))
        for loop in self._loops:
            loop.cancel()
        await asyncio.gather(*self._loops, return_exceptions=True)

    async def _serve(self) -> None:
        while not self._stopping:
            try:
                await self._backend.wait_idle()
            except StraightPCFError as failure:  # no worker will ever start
                logger.error("no more jobs are run here: %s", failure)
                return
            try:
                await self._serve_one()
            except DISK_TROUBLES as fault:
                self._troubles.say(_NOT_TAKEN, fault)
                await asyncio.sleep(POLL_SECONDS)
            except Exception:
                logger.exception("a job could not be written down; its lease will run out")
                await asyncio.sleep(POLL_SECONDS)

    async def _serve_one(self) -> None:
        self._work.clear()
        claim = await self._call(JobStore.claim, self._folders.server, LEASE_SECONDS)
        self._troubles.over(_NOT_TAKEN)
        if claim is None:
            await self._wait_for_work()
            return
        running = _Running(claim, asyncio.create_task(self._compute(claim)))
        self._running.add(running)
        try:
            await self._settle(running)
        finally:
            self._running.discard(running)
            running.over.set_result(None)
            self._notify(claim.record.id)

    async def _wait_for_work(self) -> None:
        try:
            async with asyncio.timeout(POLL_SECONDS):
                await self._work.wait()
        except TimeoutError:
            pass

    async def _beat(self) -> None:
        while True:
            await asyncio.sleep(HEARTBEAT_SECONDS)
            tended = list(self._running)
            if not tended:
                continue
            try:  # of these alone: the lease of a job whose end could not be written must run out
                held = [(running.claim.record.id, running.claim.fence) for running in tended]
                holds = await self._call(JobStore.extend, held, LEASE_SECONDS)
            except DISK_TROUBLES as fault:
                self._troubles.say(_NOT_RENEWED, fault)
                continue
            except Exception:
                logger.exception(_NOT_RENEWED)
                continue
            self._troubles.over(_NOT_RENEWED)
            for running, hold in zip(tended, holds, strict=True):
                if hold != "held":
                    running.begin_to_end(hold)  # waits for nothing: the leases of the others go on

    async def _compute(self, claim: Claim) -> FileReport:
        record = claim.record
        folder = self._folders.path(record.folder)
        log = _Log(claim, self._call, self._notify)
        try:
            # Earlier ones' alone: one that was held up here, and whose job is another's by now, harms no later one.
            earlier = [name(attempt) for attempt in range(1, record.attempts) for name in (_patches, _target)]
            await asyncio.to_thread(self._folders.remove_files, record.folder, earlier)
            return await self._backend.run(
                FileJob(
                    id=record.id,
                    source=folder / INPUT,
                    target=folder / _target(record.attempts),
                    options=record.options,
                    max_points=self._max_points,
                    name=record.name,
                    format=record.format,
                    patches=folder / _patches(record.attempts),
                ),
                log,
            )
        finally:
            await log.close()

    async def _settle(self, running: _Running) -> None:
        """Wait for a job's end and write it down; not in its task, which may be cancelled before it has begun.

        Where a disk has no room for it, it is tried again under the job's lease, and at last left to the lease's end.
        """
        await asyncio.wait([running.task])
        if not running.task.cancelled() and isinstance(fault := running.task.exception(), OSError | sqlite3.Error):
            raise fault  # this server's trouble, and no end to write down
        troubles = Troubles()
        for _ in range(END_TRIES):
            try:
                await self._write_end(running)
            except DISK_TROUBLES as fault:
                if self._stopping:
                    raise
                troubles.say(f"job {running.claim.record.id}: its end could not be written down yet", fault)
                await asyncio.sleep(POLL_SECONDS)
            else:
                return
        await self._write_end(running)

    async def _write_end(self, running: _Running) -> None:
        claim = running.claim
        if running.task.cancelled():
            await self._after_cancel(claim, running.reason)
            return
        match running.task.exception():
            case None:
                try:
                    await self._deliver(claim, running.task.result())
                except DISK_TROUBLES:
                    raise
                except Exception as fault:  # no later attempt would write it down either
                    await self._fail_on(claim, fault)
            case WorkerDied() as death:
                await self._after_death(claim, death, "its worker died")
            case FilesUnusable() as trouble:
                await self._after_death(claim, trouble, "its worker could not use its files")
            case StraightPCFError() as error:
                logger.info("job %s: %s: %s%s", claim.record.id, error.code, error.message, _trace(claim))
                await self._fail(claim, error)
            case fault:
                await self._fail_on(claim, fault)

    async def _deliver(self, claim: Claim, report: FileReport) -> None:
        record = claim.record
        logger.info(
            "job %s: %d points, %d passes on %s, %.2f s%s", record.id, report.points, report.iterations,
            report.device, report.seconds, _trace(claim),
        )  # fmt: skip
        await self._call(
            JobStore.succeed, record.id, claim.fence, result=_result_info(record.name, report),
            report=_report(report), file=_target(record.attempts), expires_in=self._ttl,
        )  # fmt: skip

    async def _after_cancel(self, claim: Claim, reason: Reason | None) -> None:
        if reason == "canceled":
            await self._fail(claim, JobCanceled(f"job {claim.record.id} was canceled"))
        elif reason == "shutdown":
            await self._release(claim, "the server shut down; the job starts again")

    async def _after_death(self, claim: Claim, death: Exception, told: str) -> None:
        logger.warning("%s (the job's death %d of %d)", death, claim.deaths + 1, MAX_DEATHS)
        if claim.deaths + 1 < MAX_DEATHS:
            await self._release(claim, f"{told}; the job starts again", died=True)
        else:
            error = InternalError(f"{told}, {MAX_DEATHS} times; the cloud was then given up")
            await self._fail(claim, error)

    async def _fail_on(self, claim: Claim, fault: BaseException) -> None:
        logger.error("job %s: %r%s", claim.record.id, fault, _trace(claim), exc_info=fault)
        await self._fail(claim, InternalError("the server failed on this job; its log says how"))

    async def _fail(self, claim: Claim, error: StraightPCFError) -> None:
        await self._call(JobStore.fail, claim.record.id, claim.fence, error, expires_in=self._ttl)

    async def _release(self, claim: Claim, message: str, *, died: bool = False) -> None:
        await self._call(JobStore.release, claim.record.id, claim.fence, message, expires_in=self._ttl, died=died)


class _Running:
    """Hold one job's task, why it was ended early, and, as `over`, that nothing more is written about it here."""

    def __init__(self, claim: Claim, task: asyncio.Task[FileReport]) -> None:
        self.claim, self.task = claim, task
        self.over: asyncio.Future[None] = task.get_loop().create_future()
        self.reason: Reason | None = None

    def begin_to_end(self, reason: Reason) -> None:
        if self.reason is None and not self.task.done():
            self.reason = reason
            self.task.cancel()

    async def end(self, reason: Reason) -> None:
        self.begin_to_end(reason)
        await asyncio.wait([self.over])


class _Log:
    """Write down what a worker tells, in order and off the callbacks, which may not wait."""

    def __init__(self, claim: Claim, call: StoreCall, notify: Callable[[str], None]) -> None:
        self._id, self._fence = claim.record.id, claim.fence
        self._call, self._notify = call, notify
        self._told: asyncio.Queue[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]] | None] = asyncio.Queue()
        self._progress, self._iteration = 0.0, 0
        self._troubles = Troubles()
        self._writer = asyncio.create_task(self._write())

    def on_start(self, device: str) -> None:
        self._tell(JobStore.begin, device=device)

    def on_progress(self, fraction: float, iteration: int) -> None:
        if fraction - self._progress >= 0.01 or iteration != self._iteration:  # the log of a job stays short
            self._progress, self._iteration = fraction, iteration
            data = {"progress": fraction, "iteration": iteration}
            self._tell(JobStore.note, "progress", data, progress=fraction)
        else:
            self._notify(self._id)  # for those who follow the patches

    def on_preview(self, iteration: int, indices: list[int], xyz: list[list[float]]) -> None:
        kind: EventKind = "preview"
        self._tell(JobStore.note, kind, {"iteration": iteration, "indices": indices, "xyz": xyz})

    async def close(self) -> None:
        """Return when everything is written, also if the caller is being cancelled."""
        self._told.put_nowait(None)
        await asyncio.wait([self._writer])

    def _tell(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
        self._told.put_nowait((function, args, kwargs))

    async def _write(self) -> None:
        while (told := await self._told.get()) is not None:
            function, args, kwargs = told
            try:
                await self._call(function, self._id, self._fence, *args, **kwargs)
            except Exception as fault:  # the disk may be full by now and have room at the job's end
                self._troubles.say(f"job {self._id}: what its worker told could not be written down", fault)
            self._notify(self._id)


def _target(attempt: int) -> str:
    """Name an attempt's own result: one that comes back from the dead harms no later one."""
    return f"result-{attempt}"


def _patches(attempt: int) -> str:
    return f"patches-{attempt}"


def _trace(claim: Claim) -> str:
    traceparent = claim.record.traceparent
    return "" if traceparent is None else f" [traceparent {traceparent[:64]!r}]"


def _result_info(name: str | None, report: FileReport) -> ResultInfo:
    return ResultInfo(
        bytes=report.bytes,
        sha256=report.sha256,
        media_type=format_named(report.format).media_type,
        filename=result_name(name, report.format),
        format=report.format,
    )


def _report(report: FileReport) -> dict[str, Any]:
    """Return the report as docs/api.md has it; JSON has no NaN."""
    values = {name: value for name, value in asdict(report).items() if name not in ("bytes", "sha256")}
    for name in ("noise_before", "noise_after"):
        values[name] = values[name] if math.isfinite(values[name]) else None
    return values
