"""kill -9 of the server or of its worker at random instants: no accepted job is lost, no result is half."""

from __future__ import annotations

import io
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import numpy as np
import pytest

from tests.clouds import noisy, sphere, torus
from tests.conftest import RunningServer, run_server

WORKER_KILLS = 2  # between two quiet moments: a cloud that has killed three workers is given up


def _clouds() -> list[bytes]:
    clouds = []
    for xyz in (noisy(torus(2500), 0.01), noisy(sphere(3000), 0.02), noisy(torus(400), 0.01)):
        np.save(buffer := io.BytesIO(), xyz)
        clouds.append(buffer.getvalue())
    return clouds


class _Client:
    """Submit jobs to whatever server there is, remember what was accepted, and look at results all the time."""

    def __init__(self, clouds: list[bytes], expected: list[bytes]) -> None:
        self.url = ""
        self.clouds, self.expected = clouds, expected
        self.accepted: dict[str, int] = {}
        self.faults: list[str] = []
        self._stop = threading.Event()
        self._reader = threading.Thread(target=self._read_results)

    def submit(self, id: str, which: int) -> None:
        """Try once; what was answered with 202 is accepted, what was not may be there or not."""
        try:
            answer = httpx2.put(f"{self.url}/jobs/{id}?iterations=1", content=self.clouds[which], timeout=10)
        except httpx2.TransportError:
            return
        if answer.status_code == 202:
            self.accepted[id] = which
        elif answer.status_code < 500:
            self.faults.append(f"{id}: {answer.status_code} {answer.text}")

    def check(self, id: str, *, at_end: bool = False) -> bool:
        """Fetch a result; tell whether it was there, and note it if it is another than it must be."""
        try:
            answer = httpx2.get(f"{self.url}/jobs/{id}/result", timeout=10)
        except httpx2.TransportError:
            return False  # broken off, which the client sees
        if answer.status_code == 200:
            if answer.content != self.expected[self.accepted[id]]:
                self.faults.append(f"{id}: {len(answer.content)} bytes of another result")
            return True
        if at_end or answer.status_code not in (409, 503):
            self.faults.append(f"{id}: {answer.status_code} {answer.text}")
        return False

    def wait_for_all(self) -> None:
        """Return when every accepted job has succeeded."""
        deadline = time.monotonic() + 120
        for id in self.accepted:
            while (state := httpx2.get(f"{self.url}/jobs/{id}?wait=10", timeout=30).json()["state"]) != "succeeded":
                assert state in ("queued", "starting", "processing"), f"{id} is {state}"
                assert time.monotonic() < deadline, f"{id} is {state} after two minutes"
            self.check(id, at_end=True)

    @contextmanager
    def reading(self) -> Iterator[None]:
        self._reader.start()
        try:
            yield
        finally:
            self._stop.set()
            self._reader.join()

    def _read_results(self) -> None:
        while not self._stop.is_set():
            for id in list(self.accepted)[-4:]:
                self.check(id)
            time.sleep(0.02)


@pytest.mark.parametrize("kills", [3, pytest.param(50, marks=pytest.mark.slow)])
def test_random_kills_lose_no_job_and_give_no_half_result(server: RunningServer, tmp_path: Path, kills: int) -> None:
    random = np.random.default_rng(kills)
    clouds = _clouds()
    # Of a server that nobody kills.
    asked = [httpx2.post(f"{server.url}/denoise?iterations=1", content=cloud, timeout=120) for cloud in clouds]
    expected = [answer.raise_for_status().content for answer in asked]
    client = _Client(clouds, expected)
    # A quiet moment after so many kills; the fast test has a server kill, a worker kill and a server kill.
    victims = ["server", "worker", "server"] if kills == 3 else list(random.choice(["server", "worker"], kills))
    done = 0
    with client.reading():
        while done < kills:
            with run_server(tmp_path) as mortal:
                client.url = mortal.url
                mortal.wait_until_ready()
                client.wait_for_all()
                assert not client.faults
                workers = 0
                while done < kills:
                    for n in range(int(random.integers(1, 4))):
                        client.submit(f"kill-{done}-{n}", int(random.integers(len(clouds))))
                    time.sleep(float(random.uniform(0, 1.2)))
                    victim, done = victims[done], done + 1
                    if victim == "server" or workers == WORKER_KILLS:
                        mortal.process.kill()
                        mortal.process.wait()
                        break
                    workers += 1
                    os.kill(_worker(mortal), signal.SIGKILL)
        with run_server(tmp_path) as mortal:
            client.url = mortal.url
            client.wait_for_all()
            left = {path.name for path in (mortal.data_dir / "incoming").rglob("*") if path.is_file()}
            assert not left, "an upload that was never accepted lies about"
    assert not client.faults
    assert len(client.accepted) >= kills


def _worker(server: RunningServer) -> int:
    """Return the worker, waiting for it if it is just being replaced."""
    deadline = time.monotonic() + 20
    while True:
        try:
            return server.worker_pid()
        except (AssertionError, OSError):
            assert time.monotonic() < deadline
            time.sleep(0.05)
