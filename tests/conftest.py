"""Fixtures that more than one package of tests needs: servers that run as processes of their own."""

from __future__ import annotations

import functools
import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import httpcore2
import pytest

from tests.warm import SERVER, run_warm

START_SECONDS = 60.0


def pytest_configure() -> None:
    # Two processes share the cores (pyproject.toml): threads that torch adds to the filter's own would wait for them.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Every client reads the machine's certificates, whether it needs them or not: of many hundreds, once is enough.
    make = httpcore2.default_ssl_context
    read = functools.cache(lambda _, **options: make(**options))
    files = "SSL_CERT_FILE", "SSL_CERT_DIR"
    httpcore2.default_ssl_context = lambda **options: read(tuple(map(os.environ.get, files)), **options)


@dataclass(frozen=True)
class RunningServer:
    """A `straightpcf serve` process on a free port of its own."""

    url: str
    process: subprocess.Popen[bytes]
    log: Path
    data_dir: Path

    def worker_pid(self) -> int:
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        workers = [pid for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
        assert len(workers) == 1, workers
        return int(workers[0])

    def wait_until_ready(self) -> None:
        deadline = time.monotonic() + START_SECONDS
        while time.monotonic() < deadline:
            assert self.process.poll() is None, self.log.read_text()
            if self._status("/readyz") == 200:
                return
            time.sleep(0.1)
        raise AssertionError(f"not ready within {START_SECONDS} s:\n{self.log.read_text()}")

    @property
    def grpc_url(self) -> str:
        found = re.search(r"gRPC on (\S+)", self.log.read_text())
        assert found, "start it with --grpc-port 0"
        return f"grpc://{found[1]}"

    def spooled_files(self) -> list[Path]:
        folders = (self.data_dir / "jobs", self.data_dir / "incoming")
        # os.walk, unlike Path.rglob, passes over a folder that a finished job takes away meanwhile.
        return [Path(at, name) for folder in folders for at, _, names in os.walk(folder) for name in names]

    def delete_jobs(self) -> None:
        """Delete every job, running or not; its files are gone when the answer comes."""
        while jobs := json.loads(self._ask("GET", "/jobs"))["jobs"]:
            for job in jobs:
                with suppress(urllib.error.HTTPError):  # a POST /denoise that was just answered deletes its own
                    self._ask("DELETE", f"/jobs/{job['id']}")

    def _ask(self, method: str, path: str) -> bytes:
        with urllib.request.urlopen(urllib.request.Request(self.url + path, method=method), timeout=20) as response:
            return bytes(response.read())

    def _status(self, path: str) -> int:
        try:
            with urllib.request.urlopen(self.url + path, timeout=5) as response:
                return int(response.status)
        except urllib.error.HTTPError as error:
            error.close()
            return error.code


@contextmanager
def run_server(
    folder: Path, *arguments: str, environment: Mapping[str, str] | None = None, within: Sequence[str] = ()
) -> Iterator[RunningServer]:
    """Start a server, wait until it listens, and end it politely; within: a command that runs the rest of its line."""
    log = folder / "server.log"
    command = [*within, sys.executable, "-m", "straightpcf.clients.cli", "serve", "--port", "0", "--device", "cpu"]
    command += ["--data-dir", str(folder / "data"), *arguments]
    with log.open("wb") as sink:
        settings = clean_environment() | dict(environment or {})
        process = subprocess.Popen(command, stdout=sink, stderr=subprocess.STDOUT, env=settings)
    try:
        yield RunningServer(url=_url_in(log, process), process=process, log=log, data_dir=folder / "data")
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise


def serve(*arguments: object, environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run a server that ends by itself, since it cannot start."""
    settings, command = clean_environment() | dict(environment or {}), ("serve", "--port", "0", *arguments)
    done = run_warm("straightpcf.clients.cli", *command, environment=settings, loaded=SERVER)
    return subprocess.CompletedProcess(done.args, done.returncode, done.stdout.decode(), done.stderr.decode())


def clean_environment() -> dict[str, str]:
    """Return the environment without settings that a developer may have."""
    return {name: value for name, value in os.environ.items() if not name.startswith("STRAIGHTPCF_")}


def _url_in(log: Path, process: subprocess.Popen[bytes]) -> str:
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        if found := re.search(r"running on (http://\S+)", log.read_text()):
            return found[1]
        assert process.poll() is None, log.read_text()
        time.sleep(0.05)
    raise AssertionError(f"no address within {START_SECONDS} s:\n{log.read_text()}")


@pytest.fixture(scope="session")
def shared_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    with run_server(tmp_path_factory.mktemp("server"), "--grpc-port", "0") as server:
        server.wait_until_ready()
        yield server


@pytest.fixture
def server(shared_server: RunningServer) -> RunningServer:
    """A server that is ready and holds no job, whatever the test before did to it."""
    shared_server.wait_until_ready()
    shared_server.delete_jobs()
    return shared_server


@pytest.fixture(scope="session")
def strict_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A server with small limits: 100,000 bytes, 4,000 points, one request at a time."""
    limits = ("--max-bytes", "100000", "--max-points", "4000", "--max-jobs", "1")
    with run_server(tmp_path_factory.mktemp("strict"), *limits) as server:
        server.wait_until_ready()
        yield server
