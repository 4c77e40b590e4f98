"""One request body, from the socket to a file: never whole in memory, never a byte over the limit."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, TypeVar

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import Request

from straightpcf.points.errors import InvalidOptions, InvalidRequest, RequestTimeout, ServerBusy, UnknownFormat
from straightpcf.service.admission import Limits
from straightpcf.service.api.disposition import disposition_name
from straightpcf.service.engine import Engine

__all__ = ["WRITE_BYTES", "SpoolFile", "Upload", "declared_size", "in_time", "next_part", "receive_upload"]

FILE_FIELD = "file"
MAX_FIELDS = 20
MAX_FIELD_BYTES = 1024
MAX_PREAMBLE_BYTES = 2**16
WRITE_BYTES = 2**20  # gathered before they are written
LOOK_SECONDS = 0.25

_CUT_BY_CURL = (b"\n", b"\r", b"\0")  # one of them is in every file of more than one point
_AS_IT_IS = (b"binary", b"8bit", b"7bit")  # of a part of a form: RFC 7578, 4.7

_T = TypeVar("_T")


@dataclass
class Upload:
    """Hold what came with one file: its name, if it has one, and the form's other fields."""

    name: str | None = None
    fields: dict[str, str] = field(default_factory=dict)


def declared_size(request: Request) -> int:
    """Return a body's Content-Length, by which it can be refused before a byte of it is read; 0 if unknown."""
    declared = request.headers.get("content-length", "")
    return int(declared) if declared.isascii() and declared.isdigit() else 0


async def receive_upload(request: Request, target: Path) -> Upload:
    """Write the request's file to `target`: a form's part named "file", or any other body as it is.

    Raises TooManyBytes, SpoolFull, UnknownFormat, InvalidRequest, RequestTimeout, ServerBusy; ClientDisconnect if
    the client goes away.
    """
    coding = ",".join(request.headers.getlist("content-encoding"))
    if any(each.strip().lower() not in ("", "identity") for each in coding.split(",")):
        raise UnknownFormat(f"the body is encoded as {coding[:40]!r}; send it as it is")
    if (part := request.headers.get("content-range")) is not None:  # RFC 9110, 14.5
        raise InvalidRequest(f"the body is {part[:60]!r} of a file (Content-Range); send the whole of it")
    engine: Engine = request.app.state.engine
    return await in_time(engine, _receive(request, target, engine))


async def in_time(engine: Engine, receiving: Coroutine[Any, Any, _T]) -> _T:
    """Return what a body that comes in is; raises ServerBusy a moment before this server ends, and reads no further."""
    task = asyncio.ensure_future(receiving)
    try:
        while not task.done():
            if engine.ending:
                raise ServerBusy("the server is shutting down, and the body has not come to its end")
            await asyncio.wait([task], timeout=LOOK_SECONDS)
        return task.result()
    finally:
        task.cancel()
        await asyncio.wait([task])  # it writes to a file that is about to be removed


async def next_part(parts: AsyncIterator[_T], limits: Limits) -> _T | None:
    """Return what comes in next, None at the end; raises RequestTimeout where nothing does: it would hold its room."""
    try:
        async with asyncio.timeout(limits.upload_idle_seconds):
            return await anext(parts, None)
    except TimeoutError:
        raise RequestTimeout(
            f"nothing of the body came for {limits.upload_idle_seconds:g} s, and it has not come to its end"
        ) from None


async def _receive(request: Request, target: Path, engine: Engine) -> Upload:
    kind, parameters = parse_options_header(request.headers.get("content-type"))
    with await asyncio.to_thread(target.open, "wb") as file:
        spool = SpoolFile(file, engine)
        if kind == b"multipart/form-data":
            upload = await _receive_form(request, parameters.get(b"boundary", b""), spool, engine.limits)
        else:
            is_form = kind == b"application/x-www-form-urlencoded"
            upload = await _receive_raw(request, spool, engine.limits, may_be_cut=is_form)
        await spool.flush()
    return upload


async def _receive_raw(request: Request, spool: SpoolFile, limits: Limits, *, may_be_cut: bool) -> Upload:
    """Receive a body as it is; may_be_cut: refuse one that seems to have lost its line ends, as in `curl -d @file`."""
    received, chunks = 0, request.stream()
    while (chunk := await next_part(chunks, limits)) is not None:
        limits.check_bytes(received := received + len(chunk))
        may_be_cut = may_be_cut and not any(mark in chunk for mark in _CUT_BY_CURL)
        spool.buffer += chunk
        await spool.flush(above=WRITE_BYTES)
    if may_be_cut and received:
        raise InvalidRequest(
            f"the body is application/x-www-form-urlencoded, and none of its {received} bytes is a line end or 0: no "
            f"cloud is so. `curl -d` leaves them out: send the file with -T, --data-binary or -F {FILE_FIELD}=@..."
        )
    return Upload(name=disposition_name(request.headers.get("content-disposition", "")))


async def _receive_form(request: Request, boundary: bytes, spool: SpoolFile, limits: Limits) -> Upload:
    if not boundary:  # of a client that was given the header and made another one itself
        raise InvalidRequest("Content-Type is multipart/form-data and names no boundary: let your HTTP client set it")
    form = _Form(spool.buffer)
    received, chunks = 0, request.stream()
    try:
        parser = MultipartParser(boundary, {"on_part_end": lambda: parser.callbacks.update(form.callbacks())})
        # Text before the first boundary is to be ignored (RFC 2046, 5.1.1): a part, to the parser, that nobody hears.
        parser.write(b"--" + boundary + b"\r\n\r\n\r\n")
        while (chunk := await next_part(chunks, limits)) is not None:
            limits.check_bytes(received := received + len(chunk))
            parser.write(chunk)
            if not form.begun and received > MAX_PREAMBLE_BYTES:
                raise InvalidRequest(
                    f"the boundary that Content-Type names is not in the form's first {received} bytes"
                )
            await spool.flush(above=WRITE_BYTES)
    except FormParserError as exc:
        raise InvalidRequest(f"the form breaks the multipart format: {exc}") from exc
    if not form.ended:
        raise InvalidRequest(
            f"the form ends after {received} bytes without the closing boundary that its Content-Type names"
        )
    if not form.has_file:
        raise InvalidRequest(f'the form has no file in a field named "{FILE_FIELD}"')
    return form.upload


class SpoolFile:
    """Gather small pieces and write them in large ones, off the event loop."""

    def __init__(self, file: IO[bytes], engine: Engine) -> None:
        self._file, self._engine = file, engine
        self.buffer = bytearray()

    async def flush(self, *, above: int = 0) -> None:
        """Write what was gathered, if it is more than `above` bytes; raises SpoolFull before jobs have no room left."""
        if len(self.buffer) > above:
            if above:  # what is small is looked at with its job
                await self._engine.check_incoming()
            await asyncio.to_thread(self._file.write, self.buffer)
            self.buffer.clear()


class _Form:
    """Follow the parser through the parts of one form; the bytes of the file part go to `sink`."""

    def __init__(self, sink: bytearray) -> None:
        self.upload = Upload()
        self.has_file = False
        self.begun = self.ended = False
        self._file = sink
        self._header = (bytearray(), bytearray())
        self._disposition = b""
        self._name = ""
        self._sink = bytearray()

    def callbacks(self) -> Any:
        return {
            "on_part_begin": self._on_part_begin,
            "on_header_field": lambda data, start, end: self._header[0].extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._header[1].extend(data[start:end]),
            "on_header_end": self._on_header_end,
            "on_headers_finished": self._on_headers_finished,
            "on_part_data": self._on_part_data,
            "on_part_end": self._on_part_end,
            "on_end": self._on_end,
        }

    def _on_part_begin(self) -> None:
        self.begun = True
        self._disposition = b""

    def _on_header_end(self) -> None:
        name, value = self._header
        if name.lower() == b"content-disposition":
            self._disposition = bytes(value)
        if name.lower() == b"content-transfer-encoding" and value.strip().lower() not in _AS_IT_IS:
            raise UnknownFormat(f"a part of the form is encoded as {_text(value)[:40]!r}; send it as it is")
        self._header = (bytearray(), bytearray())

    def _on_headers_finished(self) -> None:
        _, options = parse_options_header(self._disposition)
        self._name = _text(options.get(b"name", b""))
        if self._name == FILE_FIELD:
            if self.has_file:
                raise InvalidRequest(f'the form has more than one file in "{FILE_FIELD}"; send one cloud a request')
            self.has_file = True
            self.upload.name = disposition_name(self._disposition.decode("latin-1"))
            self._sink = self._file
        else:
            self._sink = bytearray()

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        self._sink += data[start:end]
        if self._sink is not self._file and len(self._sink) > MAX_FIELD_BYTES:
            raise InvalidRequest(
                f"form field {self._name[:40]!r} has more than {MAX_FIELD_BYTES} bytes; "
                f'the cloud belongs in the field "{FILE_FIELD}"'
            )

    def _on_part_end(self) -> None:
        if self._sink is not self._file:
            if self._name in self.upload.fields:
                raise InvalidOptions(f"{self._name[:40]!r} is said 2 times; which one is meant?")
            self.upload.fields[self._name] = _text(self._sink)
            if len(self.upload.fields) > MAX_FIELDS:
                raise InvalidRequest(f"the form has more than {MAX_FIELDS} fields")

    def _on_end(self) -> None:
        self.ended = True


def _text(data: bytes | bytearray) -> str:
    return bytes(data).decode("utf-8", errors="replace")
