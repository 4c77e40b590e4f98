"""A job's events as server-sent events (WHATWG HTML, section 9.2), and its patches as lines of JSON."""

from __future__ import annotations

import asyncio
import json
import sqlite3
from collections.abc import AsyncIterator, Mapping

from starlette.responses import StreamingResponse

from straightpcf.points.errors import InvalidRequest, NotFound, ServerBusy, StraightPCFError
from straightpcf.points.wire.patches import PATCHES_MEDIA_TYPE, PatchReader
from straightpcf.service.api.errors import busy
from straightpcf.service.api.schemas import Job
from straightpcf.service.engine import Engine

__all__ = ["NDJSON_MEDIA_TYPE", "SSE_MEDIA_TYPE", "event_stream", "last_event_id", "patch_stream"]

SSE_MEDIA_TYPE = "text/event-stream"
NDJSON_MEDIA_TYPE = "application/x-ndjson"
KEEP_ALIVE_SECONDS = 15.0
_LIVE = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}  # proxies hold nothing back


def last_event_id(header: str | None, query: str | None) -> int:
    """Read where a client wants to go on; raises InvalidRequest."""
    text = header or query or "0"
    if not text.isascii() or not text.isdigit() or len(text) > 9:
        raise InvalidRequest(f"Last-Event-ID is {text[:40]!r}; it must be the id of an event")
    return int(text)


def event_stream(
    engine: Engine, id: str, owner: str, *, root: str, after: int = 0, headers: Mapping[str, str] | None = None
) -> StreamingResponse:
    """Answer with the events of a job that is known to be there, until it is finished."""
    body = _kept_alive(_events(engine, id, owner, root, after))
    return StreamingResponse(body, media_type=SSE_MEDIA_TYPE, headers={**_LIVE, **(headers or {})})


async def _events(engine: Engine, id: str, owner: str, root: str, after: int) -> AsyncIterator[bytes]:
    try:
        async for event in engine.events(id, owner=owner, after=after):
            data = event.data if event.job is None else Job.of(event.job, root=root).plain()
            yield f"id: {event.seq}\nevent: {event.kind}\ndata: {json.dumps(data)}\n\n".encode()
    except (NotFound, ServerBusy):
        return  # deleted while we looked, or the server ends: without `completed`, so that a client comes again
    except (OSError, sqlite3.Error) as fault:
        _passing(fault)


async def _kept_alive(events: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """Put a comment wherever nothing happened for a while, so that no proxy takes the connection for dead."""
    yield b": straightpcf\n\n"
    upcoming: asyncio.Future[bytes] | None = None
    try:
        while True:
            upcoming = upcoming or asyncio.ensure_future(anext(events))
            await asyncio.wait([upcoming], timeout=KEEP_ALIVE_SECONDS)
            if not upcoming.done():
                yield b": still here\n\n"
                continue
            done, upcoming = upcoming, None
            try:
                yield done.result()
            except StopAsyncIteration:
                return
    finally:
        if upcoming is not None:
            upcoming.cancel()


def patch_stream(engine: Engine, id: str, owner: str, *, as_json: bool) -> StreamingResponse:
    """Answer with a job's patches as they are finished (docs/api.md)."""
    patches = engine.patches(id, owner=owner)
    return StreamingResponse(
        _as_lines(patches) if as_json else _while_it_works(patches),
        media_type=NDJSON_MEDIA_TYPE if as_json else PATCHES_MEDIA_TYPE,
        headers=_LIVE,
    )


async def _while_it_works(patches: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    try:
        async for chunk in patches:
            yield chunk
    except StraightPCFError:
        return  # without the end frame, by which a reader knows
    except (OSError, sqlite3.Error) as fault:
        _passing(fault)


async def _as_lines(patches: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    reader, said = PatchReader(), False
    try:
        async for chunk in patches:
            for frame in reader.feed(chunk):
                if not said:
                    yield _line(points=reader.points)
                    said = True
                if frame.end:
                    yield _line(end=True)
                else:
                    yield _line(
                        iteration=frame.iteration, final=frame.final, progress=round(frame.progress, 6),
                        indices=frame.indices.tolist(), xyz=frame.xyz.tolist(),
                    )  # fmt: skip
    except StraightPCFError as error:
        yield _line(error={"code": error.code, "detail": error.message})
    except (OSError, sqlite3.Error) as fault:
        passing = _passing(fault)
        yield _line(error={"code": passing.code, "detail": passing.message})


def _passing(fault: OSError | sqlite3.Error) -> ServerBusy:
    """Return what to say where the data directory cannot be used for a while; raises what is no such trouble."""
    if (passing := busy(fault)) is None:
        raise fault
    return passing


def _line(**values: object) -> bytes:
    return json.dumps(values).encode() + b"\n"
