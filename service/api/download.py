"""The result file over HTTP: ranges, validators and digests (RFC 9110, RFC 9530)."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import re
import secrets
from collections.abc import AsyncIterator
from typing import IO, Any

from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from straightpcf.points.errors import JobExpired, PreconditionFailed, RangeNotSatisfiable
from straightpcf.service.api.disposition import disposition
from straightpcf.service.api.errors import problem_response
from straightpcf.service.engine import Engine
from straightpcf.service.jobs.record import JobRecord

__all__ = ["open_result", "report_and_file", "result_response"]

_RANGE = re.compile(r"(\d{1,18})-(\d{0,18})|()-(\d{1,18})")  # no file needs more digits
_CONDITIONAL = frozenset({"GET", "HEAD"})  # what another method made or did is sent whole
_CHUNK_BYTES = 2**18


async def open_result(engine: Engine, id: str, *, owner: str) -> tuple[IO[bytes], JobRecord]:
    """Open a job's result: what is open is sent whole, whoever deletes it meanwhile. Raises as `Engine.result` does."""
    path, record = await engine.result(id, owner=owner)
    try:
        file = await asyncio.to_thread(path.open, "rb")
    except FileNotFoundError as exc:
        await engine.result(id, owner=owner)  # raises what has become of the job
        raise JobExpired(f"the result of job {id} has been removed") from exc
    return file, record


def result_response(
    request: Request, file: IO[bytes], record: JobRecord, *, after: BackgroundTask | None = None
) -> Response:
    """Send a job's result, or the part of it that a GET asks for, and close it; `after` runs when it is sent."""
    assert record.result is not None
    headers, size = {**result_headers(record), "Accept-Ranges": "bytes"}, record.result.bytes
    headers["Content-Disposition"] = disposition(record.result.filename)
    parts: list[str] = []
    if request.method in _CONDITIONAL:
        if not _names(_listed(request, "if-match", absent="*"), headers["ETag"], weakly=False):
            file.close()
            raise PreconditionFailed(f"the result is {headers['ETag']}, which If-Match does not name")
        if _names(_listed(request, "if-none-match"), headers["ETag"], weakly=True):
            file.close()
            same = {name: headers[name] for name in ("ETag", "Cache-Control")}  # RFC 9110, 15.4.5
            return Response(status_code=304, headers=same, background=after)
        asked = _ranges(request, headers["ETag"]) if request.method == "GET" else []  # RFC 9110, 14.2
        parts = [f"{first}-{last}" for first, last in asked if (int(first) < size if first else int(last) > 0)]
        if asked and not parts:
            file.close()
            error = RangeNotSatisfiable(f"{request.headers['range'][:60]!r} is outside the {size} bytes of the result")
            return problem_response(request, error, 416, headers={"Content-Range": f"bytes */{size}"})
    _leave_ranges(request, parts)
    return _OpenFileResponse(file, media_type=record.result.media_type, headers=headers, background=after)


class _OpenFileResponse(FileResponse):
    """Send a file that is open already, whatever becomes of its name; close it at the end."""

    def __init__(self, file: IO[bytes], **about: Any) -> None:
        super().__init__(f"/dev/fd/{file.fileno()}", stat_result=os.fstat(file.fileno()), **about)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        with self._file:
            await super().__call__(scope, receive, send)


def result_headers(record: JobRecord) -> dict[str, str]:
    """Return the headers that describe a result."""
    assert record.result is not None
    report: dict[str, Any] = record.report or {}
    digest = base64.b64encode(bytes.fromhex(record.result.sha256)).decode()
    return {
        "ETag": f'"{record.result.sha256}"',
        "Repr-Digest": f"sha-256=:{digest}:",
        "Cache-Control": "private, no-cache",  # an id may be used again once its job is deleted
        "X-Job-Id": record.id,
        "X-Points": str(report["points"]),
        "X-Iterations": str(report["iterations"]),
        "X-Noise-Before": _number(report["noise_before"]),
        "X-Noise-After": _number(report["noise_after"]),
        "X-Untouched": str(report["untouched"]),
    }


def report_and_file(file: IO[bytes], record: JobRecord, *, after: BackgroundTask | None = None) -> StreamingResponse:
    """Send the report as JSON and then the file, as multipart/mixed (RFC 2046)."""
    assert record.result is not None
    result, boundary = record.result, f"straightpcf-{secrets.token_hex(12)}"
    headers = result_headers(record)
    headers.pop("ETag")  # what tells the file from others does not tell this answer
    of_file = {
        "Content-Type": result.media_type,
        "Content-Length": str(result.bytes),
        "Content-Disposition": disposition(result.filename),
        "Repr-Digest": headers.pop("Repr-Digest"),
    }
    described = "".join(f"{name}: {value}\r\n" for name, value in of_file.items())
    head = (
        f"--{boundary}\r\nContent-Type: application/json\r\n\r\n{json.dumps(record.report)}\r\n"
        f"--{boundary}\r\n{described}\r\n"
    ).encode()
    tail = f"\r\n--{boundary}--\r\n".encode()

    async def body() -> AsyncIterator[bytes]:
        with file:
            yield head
            while chunk := await asyncio.to_thread(file.read, _CHUNK_BYTES):
                yield chunk
        yield tail

    headers["Content-Length"] = str(len(head) + result.bytes + len(tail))
    return StreamingResponse(
        body(), media_type=f"multipart/mixed; boundary={boundary}", headers=headers, background=after
    )


def _listed(request: Request, name: str, *, absent: str = "") -> str:
    """Return a header whose value is a list: of several lines, one (RFC 9110, 5.3)."""
    return ",".join(request.headers.getlist(name) or [absent])


def _names(header: str, etag: str, *, weakly: bool) -> bool:
    """Say whether If-Match or If-None-Match names a result; weakly: `W/` does not matter (RFC 9110, 8.8.3.2)."""
    tags = [tag.strip() for tag in header.split(",")]
    return "*" in tags or etag in tags or (weakly and f"W/{etag}" in tags)


def _ranges(request: Request, etag: str) -> list[tuple[str, str]]:
    """Return each first-last that is asked for, one of which may be empty; none where the whole result is due.

    It is where If-Range names another result, and where a Range is malformed (RFC 9110, 13.1.5 and 14.2).
    """
    unit, _, listed = request.headers.get("range", "").partition("=")
    if unit.lower() != "bytes" or request.headers.get("if-range", etag) != etag:
        return []
    found = [_RANGE.fullmatch(part.strip()) for part in listed.split(",")]
    ranges = [(match[1] or "", match[2] or match[4] or "") for match in found if match]
    backwards = any(first and last and int(first) > int(last) for first, last in ranges)
    return [] if backwards or len(ranges) < len(found) else ranges


def _leave_ranges(request: Request, parts: list[str]) -> None:
    """Let FileResponse, which reads the headers for itself and more strictly, see these ranges only."""
    headers = [pair for pair in request.scope["headers"] if pair[0] not in (b"range", b"if-range")]
    request.scope["headers"] = headers + ([(b"range", f"bytes={','.join(parts)}".encode())] if parts else [])


def _number(value: float | None) -> str:
    return "nan" if value is None else repr(value)
