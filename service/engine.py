"""The one core behind every transport: admission, durable jobs, running, events, results. Knows no HTTP."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import time
import uuid
from collections.abc import AsyncGenerator, AsyncIterator, Collection, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from weakref import WeakValueDictionary

from straightpcf.points.errors import InvalidRequest, JobExpired, JobNotFinished, NotFound, ServerBusy
from straightpcf.points.formats import estimate_points, format_named
from straightpcf.points.options import DenoiseOptions
from straightpcf.points.wire.jobs import JOB_ID, JOB_ID_RULE
from straightpcf.service.admission import Limits
from straightpcf.service.backends.base import Backend
from straightpcf.service.jobs.folders import JobFolders, digest_of
from straightpcf.service.jobs.full_disk import DISK_TROUBLES, keep_reserve
from straightpcf.service.jobs.record import JobEvent, JobRecord, JobState, NewJob
from straightpcf.service.jobs.runner import JobRunner
from straightpcf.service.jobs.store import JobStore
from straightpcf.service.jobs.store_thread import StoreThread
from straightpcf.service.jobs.sweeper import Sweeper

__all__ = ["Engine", "JobRequest", "Usage"]

# Another server may work on a job of ours, and tells us nothing: readers look again after this.
POLL_SECONDS = 1.0
# Who still waits when a server ends is answered so long before what runs is cut off.
FAREWELL_SECONDS = 1.5 * POLL_SECONDS
CHUNK_BYTES = 2**20
_TRACE = 64  # characters of a traceparent that are kept, of the 55 that it has: a header may have 64 KiB

logger = logging.getLogger("uvicorn.error")  # the log that `straightpcf serve` shows


@dataclass(frozen=True, kw_only=True)
class JobRequest:
    """Ask for a job; an idempotency key stands for the endpoint, the options, the names and the content."""

    options: DenoiseOptions
    name: str | None = None
    format: str | None = None
    owner: str = ""
    id: str | None = None
    idempotency_key: str | None = None
    endpoint: str = "jobs"
    traceparent: str | None = None


@dataclass(frozen=True, kw_only=True)
class Usage:
    """Sum up jobs: counts: by state; points: that wait or run, as estimated; bytes: of their files on the disk."""

    counts: Mapping[str, int]
    points: int
    bytes: int


class Engine:
    """Admit jobs, keep them safe, run them on a backend, and tell what becomes of them.

    A job is committed before `submit` returns; a server or worker that dies loses none. `owner` is a key's
    fingerprint: the jobs of others raise NotFound.
    """

    def __init__(self, backend: Backend, *, limits: Limits, data_dir: Path) -> None:
        self.backend = backend
        self.limits = limits
        self._ends_at: float | None = None  # time.monotonic(), once it drains
        self._data_dir = data_dir
        self._lent: dict[str, str] = {}  # owners by id
        self._call = StoreThread(data_dir)
        self._news: WeakValueDictionary[str, asyncio.Event] = WeakValueDictionary()
        self._folders: JobFolders
        self._runner: JobRunner
        self._sweeper: Sweeper

    @property
    def ready(self) -> bool:
        """Tell whether a job that is submitted now finds a warm worker."""
        return bool(self.backend.devices) and not self.draining and self.in_place

    @property
    def in_place(self) -> bool:
        """Tell whether the store's file is still there, for what is written to one that was deleted is lost."""
        return self._call.in_place

    @property
    def ending(self) -> bool:
        """Tell whether this server ends so soon that who still waits has to be answered now."""
        return self.draining and self.patience_seconds < min(FAREWELL_SECONDS, self.limits.shutdown_seconds / 2)

    async def start(self) -> None:
        """Open the store, take back what dead servers left, and begin to start the backend; `ready` says when it is."""
        self._folders = await asyncio.to_thread(JobFolders, self._data_dir)
        await self._call.open(self._folders.job_bytes)
        self._runner = JobRunner(
            self.backend, folders=self._folders, call=self._call, notify=self._notify,
            max_points=self.limits.max_points, result_ttl_seconds=self.limits.result_ttl_seconds,
        )  # fmt: skip
        self._sweeper = Sweeper(
            self._data_dir, folders=self._folders, call=self._call, notify=self._notify,
            result_ttl_seconds=self.limits.result_ttl_seconds, row_ttl_seconds=self.limits.row_ttl_seconds,
        )  # fmt: skip
        await self._sweeper.start()
        await self.backend.start()
        self._runner.start()

    def drain(self) -> None:
        """Take nothing new from now on; what runs goes on."""
        if self._ends_at is None:
            self._ends_at = time.monotonic() + self.limits.shutdown_seconds

    def hurry(self) -> None:
        """Let what runs go on no longer: jobs are put back into the queue."""
        self._ends_at = time.monotonic()

    @property
    def draining(self) -> bool:
        """Whether nothing new is taken."""
        return self._ends_at is not None

    @property
    def patience_seconds(self) -> float:
        """How long what runs may go on: one limit for requests, calls and jobs, from the moment that it drains."""
        return self.limits.shutdown_seconds if self._ends_at is None else max(0.0, self._ends_at - time.monotonic())

    async def stop(self) -> None:
        """Let running jobs finish for a while, put the others back into the queue, and end the backend."""
        self.drain()
        await self._sweeper.stop()
        await self._runner.stop(lambda: self.patience_seconds)
        for id, owner in list(self._lent.items()):  # their calls were cut off
            await self.forget(id, owner=owner)
        await self.backend.stop()
        await self._call.close()
        self._folders.close()

    # --- taking jobs

    async def check_room(
        self, *, size: int = 0, owner: str = "", id: str | None = None, idempotency_key: str | None = None
    ) -> None:
        """Raise what would keep a job of `size` bytes from being admitted, as far as it is known before its body.

        A request with an id or a key of a job that is there may be the one that made it, which takes no room.
        """
        if self.draining:
            raise ServerBusy("the server is shutting down")
        self.limits.check_bytes(size)
        _check_id(id)
        if await self._call(JobStore.has, owner, id=id, idempotency_key=idempotency_key):
            return
        if self.backend.failure is not None:
            raise self.backend.failure
        load = await self._call(JobStore.load)
        self.limits.check_queue(load)
        self.limits.check_key(await self._call(JobStore.load, owner))
        self.limits.check_disk(load, self._folders.free_bytes(), spool=self.limits.spool_bytes(size))

    def upload(self) -> AbstractContextManager[Path]:
        """Lend a file for a request's body; what is not submitted is removed."""
        return self._folders.upload()

    async def check_incoming(self) -> None:
        """Raise SpoolFull where bodies leave accepted jobs no room; to be asked again while one comes in.

        How large a body is need not be said before, and many may have been let in at once.
        """
        load, incoming = await self._call(JobStore.load), await asyncio.to_thread(self._folders.incoming_bytes)
        self.limits.check_incoming(load, self._folders.free_bytes(), incoming=incoming)

    async def submit(self, source: Path, request: JobRequest) -> tuple[JobRecord, bool]:
        """Commit one job, or find the one that the same request made; return it and whether it is new.

        One that may run again is made anew, under its id. Raises ServerBusy, SpoolFull, QuotaExceeded, TooManyBytes,
        MalformedFile of an empty file, UnknownFormat, IdConflict, IdempotencyConflict.
        """
        size = source.stat().st_size
        self.limits.check_bytes(size)
        # Raises before anything waits. "PLY" is "ply": what is kept is one spelling, by which a repeat is known, too.
        format = None if request.format is None else format_named(request.format).name
        _check_id(request.id)
        name = request.name or "the cloud"
        content, weight = await asyncio.to_thread(lambda: (digest_of(source), estimate_points(source, name=name)))
        said = [request.endpoint, asdict(request.options), request.name, format, content]
        new = NewJob(
            id=request.id or uuid.uuid4().hex,
            owner=request.owner,
            folder=uuid.uuid4().hex,
            name=request.name,
            format=format,
            options=request.options,
            bytes=size,
            weight=weight,
            spool=self.limits.spool_bytes(
                size, weight=weight, iterations=request.options.iterations, converted=format is not None
            ),
            digest=hashlib.sha256(json.dumps(said).encode()).hexdigest(),
            idempotency_key=request.idempotency_key,
            traceparent=request.traceparent and request.traceparent[:_TRACE],
        )
        record, created = await self._call(self._admit, new, source)
        if created:
            self._notify(record.id)
            self._runner.wake()
        return record, created

    def _admit(self, store: JobStore, new: NewJob, source: Path) -> tuple[JobRecord, bool]:
        known = store.match(new)
        if known is not None and not known.may_run_again:
            return known, False
        if self.backend.failure is not None:
            raise self.backend.failure
        load = store.load()  # not whether it drains: what was let in before may finish
        self.limits.check_queue(load, weight=new.weight)
        self.limits.check_key(store.load(new.owner))
        self.limits.check_disk(load, self._folders.free_bytes(), spool=new.spool, written=new.bytes)
        try:
            self._folders.adopt(source, new.folder)
            record, created = store.create(new)
        except BaseException:  # of a full disk all this is tried again where there was room to be made
            self._folders.give_back(new.folder, source)
            raise
        if not created:  # another server was quicker
            self._folders.remove(new.folder)
        elif known is not None:
            self._folders.remove(known.folder)
        return record, created

    # --- telling about jobs

    async def usage(self) -> Usage:
        """Sum up every job as it is now."""
        load, counts = await self._call(JobStore.load), await self._call(JobStore.counts)
        return Usage(counts=counts, points=load.points, bytes=await asyncio.to_thread(self._folders.used_bytes))

    async def get(self, id: str, *, owner: str = "") -> JobRecord:
        """Return a job as it is."""
        return await self._call(JobStore.get, id, owner)

    async def list(
        self, *, owner: str = "", states: Collection[JobState] = (), limit: int = 50, cursor: str | None = None
    ) -> tuple[list[JobRecord], str | None]:
        """Return a page of jobs, newest first, and the cursor of the next."""
        return await self._call(JobStore.page, owner=owner, states=states, limit=limit, cursor=cursor)

    async def wait(self, id: str, *, owner: str = "", seconds: float | None = None) -> JobRecord:
        """Return a job once it is finished, or as it is after `seconds`; raises ServerBusy if the server ends first."""
        loop = asyncio.get_running_loop()
        until = None if seconds is None else loop.time() + seconds
        while True:
            news = self._news_of(id)
            left = POLL_SECONDS if until is None else min(POLL_SECONDS, until - loop.time())
            record = await (self._call(JobStore.look, id, owner) if left > 0 else self.get(id, owner=owner))
            if record.finished or left <= 0:
                return record
            await self._further(news, left)

    async def events(self, id: str, *, owner: str = "", after: int = 0) -> AsyncGenerator[JobEvent, None]:
        """Yield what happened behind event `after`, and then what happens, until `completed`, which has the job.

        Raises ServerBusy where this server ends first, NotFound where the job is deleted, also if its id is used again.
        """
        folder: str | None = None
        while True:
            news = self._news_of(id)
            record = await self._same(id, owner, folder)
            folder = record.folder
            events = await self._call(JobStore.events, folder, after)
            if events and events[-1].kind == "completed":
                ended = record if record.finished else await self._same(id, owner, folder)
                events[-1] = replace(events[-1], job=ended)
            for event in events:
                after = event.seq
                yield event
            if record.finished:
                if not events:  # deleted between the two looks, it would seem to have told its end
                    await self._same(id, owner, folder)
                return
            await self._further(news)

    async def result(self, id: str, *, owner: str = "") -> tuple[Path, JobRecord]:
        """Return the result file; raises JobNotFinished, JobExpired, or what the job failed with."""
        record = await self.get(id, owner=owner)
        if record.error is not None:
            raise record.error
        if record.state == "expired":
            raise JobExpired(f"the result of job {id} has been removed")
        if record.state != "succeeded":
            raise JobNotFinished(f"job {id} is {record.state}, {100 * record.progress:.0f} % done")
        return self._folders.path(record.folder) / await self._call(JobStore.result_file, id, record.folder), record

    async def patches(self, id: str, *, owner: str = "") -> AsyncIterator[bytes]:
        """Yield the patch stream (docs/api.md) as it grows; a second attempt goes on where the first one ended.

        That is sound because the same input, options and weights give the same bytes. Raises what the job failed with,
        ServerBusy where this server ends first, and NotFound where the job is deleted, also if its id is used again.
        """
        sent, folder = 0, None
        while True:
            news = self._news_of(id)
            record = await self._same(id, owner, folder)
            folder = record.folder
            path = self._folders.path(record.folder) / f"patches-{record.attempts}"
            while chunk := await asyncio.to_thread(_read_from, path, sent):
                sent += len(chunk)
                yield chunk
            if record.finished:
                break
            await self._further(news)
        if record.error is not None:
            raise record.error
        record = await self._same(id, owner, folder)  # removed while it was read, it may have ended early
        if sent == 0 or record.state == "expired":
            raise JobExpired(f"the patches of job {id} have been removed")

    async def cancel(self, id: str, *, owner: str = "") -> JobRecord:
        """Cancel a job; returns when nothing of this server works on it. A finished job stays as it is."""
        record = await self.get(id, owner=owner)
        await self._call(JobStore.request_cancel, id, record.folder, expires_in=self.limits.result_ttl_seconds)
        await self._runner.cancel(record.folder)
        self._notify(id)
        return await self._same(id, owner, record.folder)

    async def delete(self, id: str, *, owner: str = "") -> None:
        """Cancel a job if it is not finished, and remove its files and all that is known of it."""
        record = await self.cancel(id, owner=owner)
        await self._call(JobStore.delete, id, record.folder)
        await asyncio.to_thread(self._folders.remove, record.folder)
        await asyncio.to_thread(keep_reserve, self._data_dir)
        self._notify(id)

    def lend(self, id: str, *, owner: str = "") -> None:
        """Let a job, which need not be there yet, live no longer than this server, unless `forget` is called before."""
        self._lent[id] = owner

    async def forget(self, id: str, *, owner: str = "") -> None:
        """Delete a job that nobody knows but its call, if it is there."""
        try:
            await self.delete(id, owner=owner)
        except NotFound:  # it was not committed, or someone found it in the list, and was quicker
            pass
        except DISK_TROUBLES as fault:
            logger.warning("job %s: its call is over, but it is kept until it expires: %r", id, fault)
        finally:
            self._lent.pop(id, None)

    # --- inside

    async def _same(self, id: str, owner: str, folder: str | None) -> JobRecord:
        """Look at a job; raises NotFound where it is not the one of that folder any more, if one is given."""
        record = await self._call(JobStore.look, id, owner)
        if folder is not None and record.folder != folder:
            raise NotFound(f"job {id} was deleted, and its id is another's now")
        return record

    async def _further(self, news: asyncio.Event, seconds: float = POLL_SECONDS) -> None:
        """Return when there may be something new; raises ServerBusy when this server is about to end."""
        if self.ending:
            raise ServerBusy("the server is shutting down; a job goes on when it is back, unless it ends with its call")
        await _first(news, seconds)

    def _news_of(self, id: str) -> asyncio.Event:
        """Return an event that is set at the next change; take it before looking, so that no change is missed."""
        news = self._news.get(id)
        if news is None:
            self._news[id] = news = asyncio.Event()
        return news

    def _notify(self, id: str) -> None:
        if (news := self._news.pop(id, None)) is not None:
            news.set()


def _check_id(id: str | None) -> None:
    if id is not None and not JOB_ID.fullmatch(id):
        raise InvalidRequest(f"job id is {id[:80]!r}; it must be {JOB_ID_RULE}")


async def _first(news: asyncio.Event, seconds: float) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await news.wait()


def _read_from(path: Path, offset: int) -> bytes:
    try:
        with path.open("rb") as file:
            file.seek(offset)
            return file.read(CHUNK_BYTES)
    except FileNotFoundError:
        return b""
