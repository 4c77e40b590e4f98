"""REST as curl sees it."""

from __future__ import annotations

import io
import json
import socket
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from straightpcf.points.errors import ERRORS_BY_CODE
from tests.conftest import RunningServer

POINTS = 400


class Answer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes

    def problem(self) -> dict[str, Any]:
        assert self.headers["content-type"] == "application/problem+json"
        problem: dict[str, Any] = json.loads(self.body)
        assert set(problem) == {"type", "title", "status", "detail", "code", "retryable", "request_id"}
        assert problem["status"] == self.status
        assert problem["request_id"] == self.headers["x-request-id"]
        assert problem["code"] in ERRORS_BY_CODE
        return problem


def curl(*arguments: str | Path, stdin: bytes = b"") -> Answer:
    command = ["curl", "-s", "-i", "--max-time", "60", *map(str, arguments)]
    output = subprocess.run(command, input=stdin, capture_output=True, check=True).stdout
    head, body = output.split(b"\r\n\r\n", 1)
    while b" 100 " in head.split(b"\r\n", 1)[0]:
        head, body = body.split(b"\r\n\r\n", 1)
    return _answer(head, body)


def load(answer: Answer) -> np.ndarray[Any, Any]:
    assert answer.status == 200, answer.body
    return np.asarray(np.load(io.BytesIO(answer.body)))


def npy(xyz: np.ndarray[Any, Any]) -> bytes:
    np.save(buffer := io.BytesIO(), xyz)
    return buffer.getvalue()


def raw(server: RunningServer, request: bytes) -> Answer:
    """Send these bytes and nothing more; read until the server is done."""
    host, port = server.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=20) as connection:
        connection.sendall(request)
        data = b""
        while b"\r\n\r\n" not in data or len(data.split(b"\r\n\r\n", 1)[1]) < _content_length(data):
            received = connection.recv(65536)
            if not received:
                break
            data += received
    head, body = data.split(b"\r\n\r\n", 1)
    return _answer(head, body)


def _answer(head: bytes, body: bytes) -> Answer:
    status, *lines = head.decode("latin-1").split("\r\n")
    return Answer(int(status.split()[1]), {k.lower(): v for k, v in (line.split(": ", 1) for line in lines)}, body)


def _content_length(data: bytes) -> int:
    head = data.split(b"\r\n\r\n", 1)[0].lower()
    return int(head.split(b"content-length: ")[1].split(b"\r\n")[0])
