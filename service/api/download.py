"""The result file over HTTP: ranges, validators and digests (RFC 9110, RFC 9530)."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import secrets
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse

from straightpcf.points.errors import RangeNotSatisfiable
from straightpcf.service.jobs.record import JobRecord

__all__ = ["report_and_file", "result_response"]

_RANGES = re.compile(r"bytes=\s*(\d+-\d*|-\d+)(\s*,\s*(\d+-\d*|-\d+))*\s*")
_CHUNK_BYTES = 2**18


def result_response(
    request: Request, path: Path, record: JobRecord, *, after: BackgroundTask | None = None
) -> Response:
    """Send a job's result, or the part of it that was asked for; `after` runs when it is sent.

    Raises RangeNotSatisfiable.
    """
    assert record.result is not None
    headers = {**result_headers(record), "Accept-Ranges": "bytes"}
    if _matches(request.headers.get("if-none-match"), headers["ETag"]):
        return Response(status_code=304, headers={"ETag": headers["ETag"]}, background=after)
    _check_range(request, record.result.bytes)
    return FileResponse(
        path, filename=record.result.filename, media_type=record.result.media_type, headers=headers, background=after
    )


def result_headers(record: JobRecord) -> dict[str, str]:
    """Return the headers that describe a result."""
    assert record.result is not None
    report: dict[str, Any] = record.report or {}
    digest = base64.b64encode(bytes.fromhex(record.result.sha256)).decode()
    return {
        "ETag": f'"{record.result.sha256}"',
        "Repr-Digest": f"sha-256=:{digest}:",
        "X-Job-Id": record.id,
        "X-Points": str(report["points"]),
        "X-Iterations": str(report["iterations"]),
        "X-Noise-Before": _number(report["noise_before"]),
        "X-Noise-After": _number(report["noise_after"]),
        "X-Untouched": str(report["untouched"]),
    }


def report_and_file(path: Path, record: JobRecord, *, after: BackgroundTask | None = None) -> StreamingResponse:
    """Send the report as JSON and then the file, as multipart/mixed (RFC 2046)."""
    assert record.result is not None
    result, boundary = record.result, f"straightpcf-{secrets.token_hex(12)}"
    head = (
        f"--{boundary}\r\nContent-Type: application/json\r\n\r\n{json.dumps(record.report)}\r\n"
        f"--{boundary}\r\nContent-Type: {result.media_type}\r\nContent-Length: {result.bytes}\r\n\r\n"
    ).encode()
    tail = f"\r\n--{boundary}--\r\n".encode()

    async def body() -> AsyncIterator[bytes]:
        yield head
        with await asyncio.to_thread(path.open, "rb") as file:
            while chunk := await asyncio.to_thread(file.read, _CHUNK_BYTES):
                yield chunk
        yield tail

    headers = {**result_headers(record), "Content-Length": str(len(head) + result.bytes + len(tail))}
    return StreamingResponse(
        body(), media_type=f"multipart/mixed; boundary={boundary}", headers=headers, background=after
    )


def _matches(if_none_match: str | None, etag: str) -> bool:
    if if_none_match is None:
        return False
    tags = [tag.strip().removeprefix("W/") for tag in if_none_match.split(",")]
    return "*" in tags or etag in tags


def _check_range(request: Request, size: int) -> None:
    """Raise RangeNotSatisfiable where no byte is in reach; a malformed Range is ignored (RFC 9110, 14.2)."""
    wanted = request.headers.get("range")
    if wanted is None:
        return
    if not _RANGES.fullmatch(wanted):
        request.scope["headers"] = [pair for pair in request.scope["headers"] if pair[0] != b"range"]
        return
    if request.headers.get("if-range") is not None:
        return
    starts = [part.strip().split("-") for part in wanted.removeprefix("bytes=").split(",")]
    if not any((int(first) < size if first else int(last) > 0) for first, last in starts):
        raise RangeNotSatisfiable(f"range {wanted[:60]!r} is outside the {size} bytes of the result")


def _number(value: float | None) -> str:
    return "nan" if value is None else repr(value)
