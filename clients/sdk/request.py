"""Turn what a user asks for into one request, as HTTP and as gRPC have it; touches no network."""

from __future__ import annotations

import asyncio
import io
import math
import os
import time
import uuid
from collections.abc import AsyncGenerator, Collection, Generator, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from straightpcf.clients.atomic import check_target
from straightpcf.clients.sdk.arguments import check_count, check_path, check_text
from straightpcf.points.cloud import as_positions
from straightpcf.points.errors import InvalidRequest, NotFound
from straightpcf.points.formats import format_by_suffix, format_named, format_wanted, recognised
from straightpcf.points.formats.base import HEAD_BYTES
from straightpcf.points.options import DenoiseOptions
from straightpcf.points.wire.jobs import JOB_ID, JOB_ID_RULE, MAX_PAGE_SIZE, STATES
from straightpcf.points.wire.patches import PATCHES_MEDIA_TYPE

__all__ = [
    "CHUNK_BYTES",
    "Call",
    "Iterations",
    "Normals",
    "Source",
    "cancel_call",
    "check_suffix",
    "delete_call",
    "events_call",
    "get_call",
    "job_call",
    "list_call",
    "patches_call",
    "result_call",
    "upload_call",
]

CHUNK_BYTES = 2**18
_LEAST_SECONDS = 0.1  # to answer, however late it is
STREAM_SECONDS = 60.0  # a stream is silent while its job waits; of events something comes every 15

# An open3d cloud is recognised by its `points`, so that open3d need not be here.
Source: TypeAlias = str | Path | bytes | npt.NDArray[Any] | Any
Iterations: TypeAlias = int | Literal["auto"]
Normals: TypeAlias = Literal["keep", "recompute"]


@dataclass(frozen=True, kw_only=True)
class Call:
    """Describe one request; the body can be opened again for every attempt.

    rpc, fields: the same as a call of the gRPC service, in the JSON form of its message.
    request_id: names the request in the server's log, the same for every attempt.
    timeout: seconds of silence to bear, None for the client's own. silence: those to bear at least.
    events: the answer is a stream of events. may_wait: one that is held open with nothing to say is none that failed.
    once: it is the last word of a flow: do not try again, but say it also where the client was closed meanwhile.
    until: give up then, on the monotonic clock. written: when the body, a file, was written last (ns).
    """

    method: Literal["GET", "POST", "PUT", "DELETE"]
    path: str
    rpc: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    params: Mapping[str, str | list[str]] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: bytes | Path | None = None
    timeout: float | None = None
    silence: float = 0.0
    events: bool = False
    may_wait: bool = False
    once: bool = False
    until: float = math.inf
    written: int = 0
    request_id: str = field(default_factory=lambda: uuid.uuid4().hex)

    def all_headers(self) -> dict[str, str]:
        """Return the headers to send."""
        return {"X-Request-Id": self.request_id, **self.headers}

    def patience(self, usual: float | None) -> float | None:
        """Return the seconds of silence to bear from now on; usual: the client's own, None for any."""
        own = self.timeout
        if own is None and usual is not None:
            own = max(usual, self.silence)
        left = max(_LEAST_SECONDS, self.until - time.monotonic())
        return own if math.isinf(left) else left if own is None else min(own, left)

    def chunks(self) -> Generator[bytes]:
        """Read the body; raises InvalidRequest where a file is another than when the call was made, OSError."""
        if isinstance(self.body, Path):
            yield from _read_chunks(self.body, int(self.headers["Content-Length"]), self.written)
        elif self.body is not None:
            yield from (self.body[at : at + CHUNK_BYTES] for at in range(0, len(self.body), CHUNK_BYTES))

    async def async_chunks(self) -> AsyncGenerator[bytes]:
        """Read the body off the event loop; raises as `chunks` does."""
        chunks = self.chunks()
        try:
            while chunk := await asyncio.to_thread(next, chunks, b""):
                yield chunk
        finally:
            with suppress(ValueError):  # of a cancelled upload a thread may still read, and ends it
                chunks.close()


def upload_call(
    source: Source,
    target: Path | None = None,
    *,
    iterations: Iterations | str,
    seed: int,
    strength: float,
    normals: Normals | str = "keep",
    format: str | None,
    name: str | Path | None = None,
    key: str | None = None,
    id: str | None = None,
    until: float = math.inf,
) -> Call:
    """Build the request that hands over one cloud, as job `id`.

    Raises InvalidOptions, InvalidRequest, InvalidCloud, UnknownFormat, OSError before anything is sent.
    """
    for argument, text in {"format": format, "idempotency_key": key, "id": id}.items():
        check_text(argument, "" if text is None else text)
    check_path("name", name)
    options = DenoiseOptions.parse(
        iterations=str(iterations), seed=str(seed), strength=str(strength), normals=str(normals)
    )
    if target is not None:
        check_target(target)
    own_name, body = _name_and_body(source)
    name = _sendable(name or own_name)
    if name is None and isinstance(body, bytes):
        recognised(body[:HEAD_BYTES], None)
    format = _format_of(target, format, name)
    params = {name: str(value) for name, value in asdict(options).items()}
    if name is not None:
        params["filename"] = name
    if format is not None:
        params["format"] = format
    size, written = _size_and_time(body)
    headers = {"Content-Type": "application/octet-stream", "Content-Length": str(size)}
    if key is not None:
        headers["Idempotency-Key"] = _sendable_key(key)
    id = id or uuid.uuid4().hex
    if not JOB_ID.fullmatch(id):
        raise InvalidRequest(f"job id is {id[:80]!r}; it must be {JOB_ID_RULE}")
    fields = {"options": asdict(options), "filename": name, "format": format, "id": id, "bytes": size}
    # PUT: whoever chose the id can cancel the job even if the answer never arrived.
    return Call(
        method="PUT", path=_job(id), rpc="CreateJob", fields=fields, params=params, headers=headers, body=body,
        until=until, written=written,
    )  # fmt: skip


def get_call(path: str, rpc: str) -> Call:
    """Build a plain GET."""
    return Call(method="GET", path=path, rpc=rpc)


def job_call(id: str, *, wait: float = 0.0, until: float = math.inf) -> Call:
    """Build the request that looks at a job, `wait` seconds long if it is not finished."""
    params = {"wait": f"{wait:g}"} if wait > 0 else {}
    fields = {"id": id, "wait_seconds": wait}
    return Call(method="GET", path=_job(id), rpc="GetJob", fields=fields, params=params, until=until)


def list_call(states: Collection[str], limit: int, cursor: str | None) -> Call:
    """Build the request for one page of jobs; raises InvalidRequest."""
    if not isinstance(states, Iterable):
        raise InvalidRequest(f"states is {states!r:.80}; it must be some of {', '.join(STATES)}")
    states = [states] if isinstance(states, str) else list(states)  # which may be an iterator
    if unknown := [state for state in states if state not in STATES]:
        raise InvalidRequest(f"state is {unknown[0]!r:.80}; it must be one of {', '.join(STATES)}")
    check_count("page_size", limit)
    if not 1 <= limit <= MAX_PAGE_SIZE:
        raise InvalidRequest(f"page_size is {limit}; it must be in 1..{MAX_PAGE_SIZE}")
    params: dict[str, str | list[str]] = {"limit": str(limit)}
    if states:
        params["state"] = states
    if cursor is not None:
        params["cursor"] = cursor
    fields = {"states": states, "limit": limit, "cursor": cursor}
    return Call(method="GET", path="/jobs", rpc="ListJobs", fields=fields, params=params)


def events_call(id: str) -> Call:
    """Build the request that follows a job."""
    headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
    path = _job(id, "events")
    return Call(
        method="GET", path=path, rpc="WatchJob", fields={"id": id}, headers=headers, events=True,
        silence=STREAM_SECONDS, may_wait=True,
    )  # fmt: skip


def patches_call(id: str) -> Call:
    """Build the request for the patch stream."""
    headers = {"Accept": PATCHES_MEDIA_TYPE}
    path = _job(id, "stream")
    return Call(
        method="GET", path=path, rpc="StreamPatches", fields={"id": id}, headers=headers, silence=STREAM_SECONDS,
        may_wait=True,
    )  # fmt: skip


def result_call(id: str) -> Call:
    """Build the request for a result."""
    headers = {"Accept-Encoding": "identity"}
    return Call(method="GET", path=_job(id, "result"), rpc="DownloadResult", fields={"id": id}, headers=headers)


def cancel_call(id: str) -> Call:
    """Build the request that ends a job."""
    return Call(method="POST", path=_job(id, "cancel"), rpc="CancelJob", fields={"id": id})


def delete_call(id: str, *, timeout: float | None = None) -> Call:
    """Build the request that removes a job; with a timeout it is tried once."""
    once = timeout is not None
    return Call(method="DELETE", path=_job(id), rpc="DeleteJob", fields={"id": id}, timeout=timeout, once=once)


def _job(id: str, part: str = "") -> str:
    # Any other text would name another path: "" the list of jobs, ".." the page.
    if not isinstance(id, str) or not JOB_ID.fullmatch(id):
        raise NotFound(f"there is no job {str(id)[:64]!r}; an id is {JOB_ID_RULE}")
    return f"/jobs/{id}" + (f"/{part}" if part else "")


def check_suffix(target: Path, format: str) -> None:
    """Raise InvalidRequest where a file of that format would be called another's; one text table is like another."""
    of_result = format_named(format)
    named = format_by_suffix(target.name) or of_result
    if named is not of_result and {named.media_type[:5], of_result.media_type[:5]} != {"text/"}:
        raise InvalidRequest(
            f"the result is {format}, and {target.name} is a name for {named.name}: "
            f"call it *{of_result.suffixes[0]}, or hand the cloud over with format {named.name!r}"
        )


def _format_of(target: Path | None, format: str | None, name: str | None) -> str | None:
    """Return the name of the result's format; None for that of the source, which is called `name`."""
    if target is not None and format is None:
        format = format_wanted(target.name, name)
    elif target is not None and format is not None:
        check_suffix(target, format)
    return None if format is None else format_named(format).name


def _name_and_body(source: Source) -> tuple[str | None, bytes | Path]:
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        if not path.is_file():  # a pipe has no size to declare, and cannot be sent again
            hint = ": of a pipe, give its bytes" if path.exists() and not path.is_dir() else ""
            raise FileNotFoundError(f"{path} is no file{hint}")
        return path.name, path
    if isinstance(source, bytes | bytearray | memoryview):
        return None, bytes(source)
    if hasattr(source, "read"):
        raise InvalidRequest("a source is a path, bytes, an array or an open3d cloud; of an open file, give its bytes")
    buffer = io.BytesIO()
    np.save(buffer, as_positions(getattr(source, "points", source)), allow_pickle=False)
    return "cloud.npy", buffer.getvalue()


def _size_and_time(body: bytes | Path) -> tuple[int, int]:
    """Return how many bytes a body has, and when, if it is a file, it was written last (ns)."""
    if isinstance(body, bytes):
        return len(body), 0
    status = body.stat()
    return status.st_size, status.st_mtime_ns


def _sendable_key(key: str) -> str:
    """Return an idempotency key; raises InvalidRequest where no header carries it as it is."""
    if not (key.isascii() and key.isprintable()):
        raise InvalidRequest(f"the idempotency key holds more than printable ASCII: {key[:40]!r}")
    if key != key.strip():
        raise InvalidRequest(f"the idempotency key begins or ends with a space: {key[:40]!r}")
    return key


def _sendable(name: str | Path | None) -> str | None:
    """Return a file's name as text that every transport carries; bytes of it that are no UTF-8 become `?`."""
    return None if name is None else os.fspath(name).encode("utf-8", "replace").decode()


def _read_chunks(path: Path, size: int, written: int) -> Generator[bytes]:
    changed = f"{path} changed while it was read"
    with path.open("rb") as file:
        left = size
        while left > 0 and (chunk := file.read(min(CHUNK_BYTES, left))):
            left -= len(chunk)
            if left == 0:  # before the server has what would look whole, and may be the halves of two clouds
                if file.read(1):
                    raise InvalidRequest(f"{changed}: it had {size} bytes before")
                if os.fstat(file.fileno()).st_mtime_ns != written:
                    raise InvalidRequest(f"{changed}: somebody wrote into it, or replaced it")
            yield chunk
        if left > 0:
            raise InvalidRequest(f"{changed}: it had {size} bytes before")
