"""A file on its way here: where it stands, how to go on with it, and whether it arrived whole."""

from __future__ import annotations

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
from straightpcf.points.wire.jobs import ResultInfo

__all__ = ["Download"]

MAX_DAMAGED = 2  # how often a file may arrive with a wrong digest before we give up
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(?:\d+|\*)")


class Download:
    """Take a file in pieces, over as many connections as it needs; `furthest` only grows.

    What the job says of its result is what must arrive: headers may be lost on the way, or be of another's answer.
    """

    def __init__(self, file: IO[bytes], result: ResultInfo) -> None:
        self._file, self._result = file, result
        self._etag: str | None = None
        self._offset = 0
        self._wanted = False
        self._damaged = 0
        self.furthest = 0
        self.value: None = None
        self._restart()

    @classmethod
    @contextmanager
    def into(cls, path: Path | None, result: ResultInfo) -> Iterator[tuple[Download, IO[bytes]]]:
        """Begin a download into memory, or into a file that is there only if the block ends well."""
        if path is None:
            buffer = BytesIO()
            yield cls(buffer, result), buffer
            return
        with replaced_when_complete(path) as unfinished, unfinished.open("wb") as file:
            yield cls(file, result), file

    def headers(self) -> dict[str, str]:
        """Return what asks for the rest of the file that was begun."""
        if self._offset == 0 or self._etag is None:
            return {}
        return {"Range": f"bytes={self._offset}-", "If-Range": self._etag}

    def begin(self, status: int, headers: Mapping[str, str]) -> None:
        """Take the head of a 200 or 206 response; an answer that is not the rest of the file starts it anew."""
        found = _CONTENT_RANGE.fullmatch(headers.get("Content-Range", "")) if status == 206 else None
        if found is not None and int(found[1]) == self._offset:
            return
        self._restart()
        if status == 206:
            return  # the wrong part: write() drops it, and finish() asks again
        self._wanted = True
        self._etag = headers.get("ETag")

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
        if self._offset < self._result.bytes:
            missing = f"{self._offset} of {self._result.bytes} bytes arrived"
            return Failure(error=ConnectionFailed(f"the connection broke off: {missing}"), retryable=True)
        if self._sha256.hexdigest() != self._result.sha256:
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
        self._offset = 0
        self._wanted = False
