"""The gRPC face of the engine: parse a call, hand it over, serialise what comes back."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import uuid
from collections.abc import AsyncIterator
from pathlib import Path
from typing import IO, Any, TypeVar

import grpc
from google.protobuf.empty_pb2 import Empty
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from straightpcf.points.errors import InvalidOptions, InvalidRequest, RangeNotSatisfiable
from straightpcf.points.formats import format_named
from straightpcf.points.options import DenoiseOptions
from straightpcf.points.wire import straightpcf_pb2 as pb
from straightpcf.points.wire import straightpcf_pb2_grpc as stubs
from straightpcf.points.wire.jobs import MAX_EVENT_ID, MAX_PAGE_SIZE
from straightpcf.points.wire.messages import (
    event_message,
    message_of,
    name_of,
    patch_messages,
    plain_of,
)
from straightpcf.points.wire.patches import PatchReader
from straightpcf.service.api.auth import Gate
from straightpcf.service.api.body import WRITE_BYTES, SpoolFile, in_time, next_part
from straightpcf.service.api.download import open_result
from straightpcf.service.api.grpc_call import Caller, Context, LateParsing, answering
from straightpcf.service.api.intake import Coming, file_name
from straightpcf.service.api.schemas import MAX_WAIT_SECONDS, Info, Job, rfc3339
from straightpcf.service.engine import Engine, JobRequest
from straightpcf.service.jobs.record import JobEvent, JobRecord
from straightpcf.service.telemetry import Telemetry

__all__ = ["GrpcServer"]

SERVICE = pb.DESCRIPTOR.services_by_name["DenoiseService"].full_name
CHUNK_BYTES = 2**18
HEALTH_SECONDS = 0.25
FORGETTING_SECONDS = 1.0
_OPTIONS = (
    # Above what `LateParsing` takes, so that this service itself says what is too large: gRPC says it without
    # ErrorInfo. 4 MiB, and what is around them, is what its servers take otherwise.
    ("grpc.max_receive_message_length", 2**22 + 4096),
    ("grpc.http2.min_recv_ping_interval_without_data_ms", 10_000),
    # gRPC cancels a call that a busy event loop has not taken after 30 s; how long it waits is its caller's to say.
    ("grpc.server_max_unrequested_time_in_server", 3600),
    ("grpc.so_reuseport", 0),  # two servers on one port would share its calls
)

_Part = TypeVar("_Part", pb.DenoiseRequest, pb.CreateJobRequest)

logger = logging.getLogger("uvicorn.error")


class GrpcServer:
    """Listen on a port of its own, with health checking (grpc.health.v1) and reflection; lives on the event loop."""

    def __init__(
        self, engine: Engine, *, coming: Coming, gate: Gate, telemetry: Telemetry, weights: str, host: str, port: int
    ) -> None:
        self._engine = engine
        self._service = DenoiseService(engine, coming=coming, gate=gate, telemetry=telemetry, weights=weights)
        self._host, self._wanted = f"[{host}]" if ":" in host else host, port
        self._health = health.aio.HealthServicer()
        self._watch: asyncio.Task[None] | None = None
        self._server: Any = None  # it belongs to the loop that starts it

    async def start(self) -> None:
        """Begin to listen; raises InvalidOptions if the port is taken."""
        server = grpc.aio.server(options=_OPTIONS, interceptors=[LateParsing()])
        stubs.add_DenoiseServiceServicer_to_server(self._service, server)  # type: ignore[no-untyped-call]
        health_pb2_grpc.add_HealthServicer_to_server(self._health, server)
        reflection.enable_server_reflection((SERVICE, health.SERVICE_NAME, reflection.SERVICE_NAME), server)
        try:
            port = server.add_insecure_port(f"{self._host}:{self._wanted}")
        except RuntimeError as exc:
            raise InvalidOptions(f"grpc_port is {self._wanted}; {self._host}:{self._wanted} cannot be had") from exc
        await server.start()
        self._server = server
        self._watch = asyncio.create_task(self._keep_health())
        logger.info("gRPC on %s:%d", self._host, port)

    async def stop(self, *, patience_seconds: float) -> None:
        """Take no more calls, and cancel those that are not over in a while."""
        if self._server is None or self._watch is None:
            return
        self._watch.cancel()
        await self._health.enter_graceful_shutdown()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(patience_seconds):
                await self._service.wait_idle()
        # Its own grace period waits for calls whose connection broke in the middle of a message, too.
        await self._server.stop(0)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FORGETTING_SECONDS):  # of cancelled calls, which remove their jobs
                await self._service.wait_idle()

    async def _keep_health(self) -> None:
        states = health_pb2.HealthCheckResponse
        while True:
            status = states.SERVING if self._engine.ready else states.NOT_SERVING
            for name in ("", SERVICE):
                await self._health.set(name, status)
            await asyncio.sleep(HEALTH_SECONDS)


class DenoiseService(stubs.DenoiseServiceServicer):
    """Answer the calls of straightpcf.v1.DenoiseService (points/wire/straightpcf.proto)."""

    def __init__(self, engine: Engine, *, coming: Coming, gate: Gate, telemetry: Telemetry, weights: str) -> None:
        self._engine, self._coming = engine, coming
        self._gate, self._telemetry, self._weights = gate, telemetry, weights
        self._active = 0
        self._idle = asyncio.Event()
        self._idle.set()

    async def wait_idle(self) -> None:
        """Return as soon as no call is being answered."""
        await self._idle.wait()

    @contextlib.asynccontextmanager
    async def _answering(self, context: Context, method: str) -> AsyncIterator[Caller]:
        self._active += 1
        self._idle.clear()
        try:
            async with answering(context, method, gate=self._gate, telemetry=self._telemetry) as caller:
                yield caller
        finally:
            self._active -= 1
            if self._active == 0:
                self._idle.set()

    # Responses are written, not yielded: a cancelled call then ends inside of these methods, and so does its job.

    async def Denoise(self, requests: AsyncIterator[pb.DenoiseRequest], context: Context) -> None:  # noqa: N802
        """Work on one file while its caller listens."""
        async with self._answering(context, "Denoise") as caller:
            config = (await in_time(self._engine, _first(requests, self._engine))).config
            # Nobody else knows such a job: it lives as long as its call. Its id is known before it is there, for a call
            # may be cancelled while its job is being committed.
            named = config.job.id or caller.idempotency_key is not None
            private = None if named else uuid.uuid4().hex
            if private is not None:
                self._engine.lend(private, owner=caller.owner)
            try:
                id = private or config.job.id or None
                record = await self._take(config.job, requests, caller, endpoint="denoise", id=id)
                await context.write(pb.DenoiseResponse(accepted=_job(record)))
                if config.patches:
                    async for patch in self._patches(record):
                        await context.write(pb.DenoiseResponse(patch=patch))
                else:
                    async for progress in self._progress(record):
                        await context.write(pb.DenoiseResponse(progress=progress))
                file, record = await open_result(self._engine, record.id, owner=record.owner)
                with file:
                    if config.return_file:
                        async for chunk in _chunks(file):
                            await context.write(pb.DenoiseResponse(chunk=chunk))
                await context.write(pb.DenoiseResponse(summary=_job(record)))
            finally:
                if private is not None:
                    await asyncio.shield(self._engine.forget(private, owner=caller.owner))

    async def CreateJob(  # noqa: N802
        self, requests: AsyncIterator[pb.CreateJobRequest], context: Context
    ) -> pb.Job:
        """Commit a job."""
        async with self._answering(context, "CreateJob") as caller:
            config = (await in_time(self._engine, _first(requests, self._engine))).config
            return _job(await self._take(config, requests, caller, endpoint="jobs", id=config.id or None))

    async def GetJob(self, request: pb.GetJobRequest, context: Context) -> pb.Job:  # noqa: N802
        """Show a job, now or at its end."""
        async with self._answering(context, "GetJob") as caller:
            if not 0 <= request.wait_seconds <= MAX_WAIT_SECONDS:
                raise InvalidRequest(f"wait_seconds is {request.wait_seconds}; it must be in 0..{MAX_WAIT_SECONDS}")
            return _job(await self._engine.wait(request.id, owner=caller.owner, seconds=request.wait_seconds))

    async def ListJobs(  # noqa: N802
        self, request: pb.ListJobsRequest, context: Context
    ) -> pb.ListJobsResponse:
        """Show a page of jobs."""
        async with self._answering(context, "ListJobs") as caller:
            if request.limit > MAX_PAGE_SIZE:
                raise InvalidRequest(f"limit is {request.limit}; it must be in 1..{MAX_PAGE_SIZE}")
            records, cursor = await self._engine.list(
                owner=caller.owner,
                states=[_state(state) for state in request.states],
                limit=request.limit or 50,
                cursor=request.cursor or None,
            )
            return pb.ListJobsResponse(jobs=[_job(record) for record in records], next_cursor=cursor or "")

    async def WatchJob(self, request: pb.WatchJobRequest, context: Context) -> None:  # noqa: N802
        """Send events until the job is finished."""
        async with self._answering(context, "WatchJob") as caller:
            if request.after > MAX_EVENT_ID:
                raise InvalidRequest(f"after is {request.after}; it must be the id of an event")
            async for event in self._engine.events(request.id, owner=caller.owner, after=request.after):
                await context.write(_event(event))

    async def CancelJob(self, request: pb.CancelJobRequest, context: Context) -> pb.Job:  # noqa: N802
        """End a job."""
        async with self._answering(context, "CancelJob") as caller:
            return _job(await self._engine.cancel(request.id, owner=caller.owner))

    async def DeleteJob(self, request: pb.DeleteJobRequest, context: Context) -> Empty:  # noqa: N802
        """Forget a job."""
        async with self._answering(context, "DeleteJob") as caller:
            await self._coming.delete(caller.owner, request.id)
            return Empty()

    async def StreamPatches(self, request: pb.StreamPatchesRequest, context: Context) -> None:  # noqa: N802
        """Send patches as they are finished."""
        async with self._answering(context, "StreamPatches") as caller:
            async for patch in self._patches(await self._engine.get(request.id, owner=caller.owner)):
                await context.write(patch)

    async def DownloadResult(self, request: pb.DownloadResultRequest, context: Context) -> None:  # noqa: N802
        """Send a result from an offset on."""
        async with self._answering(context, "DownloadResult") as caller:
            file, record = await open_result(self._engine, request.id, owner=caller.owner)
            with file:
                result = Job.of(record).plain()["result"]
                if request.offset > result["bytes"]:
                    raise RangeNotSatisfiable(f"offset {request.offset} is outside the {result['bytes']} bytes")
                await context.write(pb.DownloadResultResponse(result=message_of(pb.ResultInfo, result)))
                async for chunk in _chunks(file, request.offset):
                    await context.write(pb.DownloadResultResponse(chunk=chunk))

    async def GetServerInfo(self, request: Empty, context: Context) -> pb.ServerInfo:  # noqa: N802
        """Say what this server is and takes."""
        async with self._answering(context, "GetServerInfo"):
            request.ByteSize()  # it says nothing, but one that is none of the schema is told so here (LateParsing)
            return message_of(pb.ServerInfo, Info.of(self._engine, weights=self._weights).model_dump())

    # --- stages

    async def _take(
        self, config: pb.JobConfig, requests: AsyncIterator[Any], caller: Caller, *, endpoint: str, id: str | None
    ) -> JobRecord:
        """Spool the file and commit the job; raises NotFound where it is deleted meanwhile."""
        taking = self._receive(config, requests, caller, endpoint, id)
        return (await self._coming.take(caller.owner, id, taking))[0]

    async def _receive(
        self, config: pb.JobConfig, requests: AsyncIterator[Any], caller: Caller, endpoint: str, id: str | None
    ) -> tuple[JobRecord, bool]:
        engine = self._engine
        options = DenoiseOptions(**plain_of(config.options))
        if config.format:
            format_named(config.format)
        size = config.bytes if config.HasField("bytes") else None
        await engine.check_room(size=size or 0, owner=caller.owner, id=id, idempotency_key=caller.idempotency_key)
        with engine.upload() as source:
            await in_time(engine, _receive(requests, source, engine, size))
            wanted = JobRequest(
                options=options,
                name=file_name(config.filename or None),
                format=config.format or None,
                owner=caller.owner,
                id=id,
                idempotency_key=caller.idempotency_key,
                endpoint=endpoint,
                traceparent=caller.traceparent,
            )
            return await engine.submit(source, wanted)

    async def _progress(self, record: JobRecord) -> AsyncIterator[pb.Progress]:
        async for event in self._engine.events(record.id, owner=record.owner):
            if event.kind == "progress":
                yield message_of(pb.Progress, event.data)

    async def _patches(self, record: JobRecord) -> AsyncIterator[pb.Patch]:
        reader = PatchReader()
        async for chunk in self._engine.patches(record.id, owner=record.owner):
            for frame in reader.feed(chunk):
                for patch in patch_messages(frame, points=reader.points or 0):
                    yield patch


async def _first(requests: AsyncIterator[_Part], engine: Engine) -> _Part:
    message = await next_part(requests, engine.limits)
    if message is None or message.WhichOneof("part") != "config":
        raise InvalidRequest("the first message of a call must be its config")
    return message


async def _receive(requests: AsyncIterator[Any], target: Path, engine: Engine, size: int | None) -> None:
    """Write the chunks of a call to a file; raises InvalidRequest where they are not of the size that was said."""
    received = 0
    with await asyncio.to_thread(target.open, "wb") as file:
        spool = SpoolFile(file, engine)
        while (message := await next_part(requests, engine.limits)) is not None:
            if message.WhichOneof("part") != "chunk":
                raise InvalidRequest("a config comes once, before the first chunk")
            engine.limits.check_bytes(received := received + len(message.chunk))
            spool.buffer += message.chunk
            await spool.flush(above=WRITE_BYTES)
        if size is not None and received != size:  # a call that is cancelled ends like one that is whole
            raise InvalidRequest(f"the file has {received} bytes; its config says {size}")
        await spool.flush()


async def _chunks(file: IO[bytes], offset: int = 0) -> AsyncIterator[bytes]:
    file.seek(offset)
    while chunk := await asyncio.to_thread(file.read, CHUNK_BYTES):
        yield chunk


def _job(record: JobRecord) -> pb.Job:
    return message_of(pb.Job, Job.of(record).plain())


def _event(event: JobEvent) -> pb.JobEvent:
    data = event.data if event.job is None else Job.of(event.job).plain()
    return event_message(event.kind, event.seq, rfc3339(event.at), data)


def _state(number: int) -> Any:
    try:
        return name_of(pb.JobState.DESCRIPTOR, number)
    except KeyError:
        raise InvalidRequest(f"state {number} is unknown; the states are 1..7") from None
