"""A file on its way here: where it stands, how to go on with it, and whether it arrived whole."""

from __future__ import annotations

import base64
import binascii
import hashlib
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import IO

from straightpcf.clients.atomic import replaced_when_complete
from straightpcf.clients.sdk.retry import Failure
from straightpcf.points.errors import ConnectionFailed

__all__ = ["Download"]

MAX_DAMAGED = 2  # how often a file may arrive with a wrong digest before we give up
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")
_SHA256 = re.compile(r"sha-256=:([A-Za-z0-9+/=]+):")


class Download:
    """Take a file in pieces, over as many connections as it needs; `furthest` only grows."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._etag: str | None = None
        self._digest: bytes | None = None
        self._size: int | None = None
        self._offset = 0
        self._wanted = False
        self._damaged = 0
        self.furthest = 0
        self.value: None = None
        self._restart()

    @classmethod
    @contextmanager
    def into(cls, path: Path | None) -> Iterator[tuple[Download, IO[bytes]]]:
        """Begin a download into memory, or into a file that is there only if the block ends well."""
        if path is None:
            buffer = BytesIO()
            yield cls(buffer), buffer
            return
        with replaced_when_complete(path) as unfinished, unfinished.open("wb") as file:
            yield cls(file), file

    def headers(self) -> dict[str, str]:
        """Return what asks for the rest of the file that was begun."""
        if self._offset == 0 or self._etag is None:
            return {}
        return {"Range": f"bytes={self._offset}-", "If-Range": self._etag}

    def begin(self, status: int, headers: Mapping[str, str]) -> None:
        """Take the head of a 200 or 206 response; an answer that is not the rest of the file starts it anew."""
        found = _CONTENT_RANGE.fullmatch(headers.get("Content-Range", "")) if status == 206 else None
        if status == 206 and found is not None and int(found[1]) == self._offset:
            if found[2] != "*":
                self._size = int(found[2])
            return
        self._restart()
        if status == 206:
            return  # the wrong part: write() drops it, and finish() asks again
        self._wanted = True
        self._etag = headers.get("ETag")
        if "Content-Encoding" not in headers and (length := headers.get("Content-Length", "")).isdigit():
            self._size = int(length)
        digest = _SHA256.search(headers.get("Repr-Digest", ""))
        self._digest = None if digest is None else _decoded(digest[1])

    def write(self, chunk: bytes) -> None:
        """Take the next bytes."""
        if self._wanted:
            self._file.write(chunk)
            self._sha256.update(chunk)
            self._offset += len(chunk)
            self.furthest = max(self.furthest, self._offset)

    def finish(self) -> Failure | None:
        """Say what is wrong when a connection has ended, None if the file is whole."""
        if not self._wanted:
            return Failure(error=ConnectionFailed("the server sent another part of the file"), retryable=True)
        if self._size is not None and self._offset < self._size:
            missing = f"{self._offset} of {self._size} bytes arrived"
            return Failure(error=ConnectionFailed(f"the connection broke off: {missing}"), retryable=True)
        if self._digest is not None and self._sha256.digest() != self._digest:
            self._damaged += 1
            error = ConnectionFailed(f"{self._offset} bytes arrived, and their sha256 is not the one that was promised")
            self._restart()
            return Failure(error=error, retryable=self._damaged < MAX_DAMAGED)
        self._file.flush()
        return None

    def _restart(self) -> None:
        self._file.seek(0)
        self._file.truncate()
        self._sha256 = hashlib.sha256()
        self._digest = self._size = None
        self._offset = 0
        self._wanted = False


def _decoded(text: str) -> bytes | None:
    try:
        return base64.b64decode(text, validate=True)
    except binascii.Error:
        return None
