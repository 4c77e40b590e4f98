"""Run commands of ours in processes of their own that need not load torch: forked by a process that has loaded it."""

from __future__ import annotations

import atexit
import functools
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

__all__ = ["MODEL", "SDK", "SERVER", "run_warm"]

ROOT = Path(__file__).parent.parent
SECONDS = 120
# What commands import, but no command itself: it runs as __main__, as by `python -m`.
SDK = ("rich.progress", "straightpcf.clients.sdk", "straightpcf.points.formats", "typer")
MODEL = (*SDK, "scipy.spatial", "straightpcf.model.train.loop")
SERVER = (*SDK, "straightpcf.service.app", "uvicorn")  # and no torch, which a server leaves to its workers


def run_warm(
    module: str,
    *arguments: object,
    environment: Mapping[str, str],
    stdin: bytes = b"",
    stdout: int | None = None,
    stderr: int | None = None,
    loaded: tuple[str, ...] = MODEL,
) -> subprocess.CompletedProcess[bytes]:
    """Do as `python -m module` does from the root of the repository, with pipes; after SECONDS it is killed.

    stdout, stderr: the numbers of open files to write to instead of pipes that are read. loaded: what is there already;
    a process that has loaded torch takes longer to begin and to end.
    """
    words = [str(argument) for argument in arguments]
    asked = json.dumps([module, words, dict(environment)]).encode()
    pipes, forker = [os.pipe() for _ in range(3)], _forker(loaded)
    theirs, ours = [pipes[0][0], pipes[1][1], pipes[2][1]], [pipes[0][1], pipes[1][0], pipes[2][0]]
    for pipe, other in zip(theirs[1:], (stdout, stderr), strict=True):
        if other is not None:
            os.dup2(other, pipe)
    socket.send_fds(forker, [len(asked).to_bytes(4, "big")], theirs)
    forker.sendall(asked)
    for pipe in theirs:
        os.close(pipe)
    with ThreadPoolExecutor(3) as pool:
        pool.submit(_feed, ours[0], stdin)
        out, errors = (pool.submit(_read, pipe) for pipe in ours[1:])
        code = int.from_bytes(_received(forker, 4), "big", signed=True)
    return subprocess.CompletedProcess([module, *words], code, out.result(), errors.result())


def _feed(pipe: int, data: bytes) -> None:
    with suppress(BrokenPipeError), os.fdopen(pipe, "wb") as file:  # as subprocess does
        file.write(data)


def _read(pipe: int) -> bytes:
    with os.fdopen(pipe, "rb") as file:
        return file.read()


@functools.cache
def _forker(loaded: tuple[str, ...]) -> socket.socket:
    """Start the process that forks the others: it ends with this one."""
    ours, theirs = socket.socketpair()
    with theirs:
        number = theirs.fileno()
        command, pipe = [sys.executable, "-m", "tests.warm", str(number), *loaded], subprocess.PIPE
        # Of its streams the kind counts alone: what Python opened on a pipe goes on on another.
        process = subprocess.Popen(command, pass_fds=[number], cwd=ROOT, stdin=pipe, stdout=pipe, stderr=pipe)

    def end() -> None:
        ours.close()
        process.communicate()

    atexit.register(end)
    return ours


def _received(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        if not (more := connection.recv(count - len(data))):
            raise EOFError("the other end is gone")
        data += more
    return data


def _become_what_is_asked_for(connection: socket.socket) -> str:
    """Fork a process for each request, one after the other; return in that process, with the module that it runs."""
    while True:
        head, streams, *_ = socket.recv_fds(connection, 4, 3)
        if not head:
            sys.exit()
        head += _received(connection, 4 - len(head))
        module, arguments, environment = json.loads(_received(connection, int.from_bytes(head, "big")))
        if (pid := os.fork()) == 0:
            break
        for stream in streams:
            os.close(stream)
        _, status = os.waitpid(pid, 0)
        connection.sendall(os.waitstatus_to_exitcode(status).to_bytes(4, "big", signed=True))
    signal.alarm(SECONDS)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv[1:] = arguments
    return str(module)


if __name__ == "__main__":
    for name in sys.argv[2:]:
        importlib.import_module(name)
    gc.freeze()
    with socket.socket(fileno=int(sys.argv[1])) as connection:
        module = _become_what_is_asked_for(connection)
    runpy._run_module_as_main(module)  # what `python -m` calls: multiprocessing finds this module by two names
