"""REST at its limits: what is too much for a server, and what it does while it works."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from pathlib import Path

import httpx2
import numpy as np
import pytest

from tests.clouds import noisy, sphere
from tests.conftest import RunningServer
from tests.service.rest import POINTS, Answer, curl, load, npy, raw
from tests.waiting import wait_for


@pytest.fixture(scope="module")
def large_cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cloud that takes a worker many seconds."""
    path = tmp_path_factory.mktemp("clouds") / "large.npy"
    np.save(path, noisy(sphere(40_000), 0.01))
    return path


def test_a_body_that_declares_too_many_bytes_is_refused_unread(strict_server: RunningServer) -> None:
    request = b"POST /denoise HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100001\r\nExpect: 100-continue\r\n\r\n"
    problem = raw(strict_server, request).problem()
    assert (problem["status"], problem["code"]) == (413, "too_many_bytes")
    assert "100000" in problem["detail"]


def test_a_chunked_body_is_stopped_as_soon_as_it_passes_the_limit(strict_server: RunningServer) -> None:
    chunk = b"%x\r\n" % 60_000 + bytes(60_000) + b"\r\n"
    head = b"POST /denoise HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
    assert raw(strict_server, head + chunk + chunk).problem()["code"] == "too_many_bytes"  # the body never ends
    assert not strict_server.spooled_files()


def test_clients_that_send_on_still_read_the_refusal(strict_server: RunningServer, tmp_path: Path) -> None:
    (path := tmp_path / "large").write_bytes(bytes(5_000_000))
    for arguments in (("-F", f"file=@{path}"), ("-T", str(path)), ("-H", "Expect:", "--data-binary", f"@{path}")):
        assert curl(*arguments, f"{strict_server.url}/denoise").problem()["code"] == "too_many_bytes"


def test_a_cloud_with_too_many_points_is_refused(strict_server: RunningServer) -> None:
    body = npy(sphere(4001).astype(np.float32))
    problem = curl("--data-binary", "@-", f"{strict_server.url}/denoise", stdin=body).problem()
    assert problem["code"] == "too_many_points"
    assert "4000" in problem["detail"]


def test_a_full_server_says_when_to_come_back(strict_server: RunningServer) -> None:
    body = npy(sphere(4000).astype(np.float32))
    url = f"{strict_server.url}/denoise?iterations=2"
    first: list[Answer] = []
    thread = threading.Thread(target=lambda: first.append(curl("--data-binary", "@-", url, stdin=body)))
    thread.start()
    second = _until_busy(url, body)
    thread.join()
    problem = second.problem()
    assert (problem["code"], problem["retryable"], problem["status"]) == ("server_busy", True, 503)
    assert int(second.headers["retry-after"]) > 0
    assert first[0].status == 200


def _until_busy(url: str, body: bytes) -> Answer:
    for _ in range(20):
        answer = curl("--data-binary", "@-", f"{url}&strength=7", stdin=body)  # refused either way
        if answer.status == 503:
            return answer
        time.sleep(0.05)
    raise AssertionError("never busy")


def test_the_worker_that_is_killed_is_replaced_and_the_request_still_answered(
    server: RunningServer, cloud: Path
) -> None:
    worker = server.worker_pid()
    os.kill(worker, signal.SIGSTOP)  # so that the job is certain to be in its hands
    answers: list[Answer] = []
    thread = threading.Thread(
        target=lambda: answers.append(curl("-F", f"file=@{cloud}", "-F", "iterations=1", f"{server.url}/denoise"))
    )
    thread.start()
    wait_for(lambda: bool(server.spooled_files()))
    time.sleep(0.3)
    os.kill(worker, signal.SIGKILL)
    thread.join()
    assert load(answers[0]).shape == (POINTS, 3)
    assert server.worker_pid() != worker
    assert curl("-F", f"file=@{cloud}", "-F", "iterations=1", f"{server.url}/denoise").body == answers[0].body


def test_a_client_that_goes_away_frees_the_worker_and_leaves_no_file(
    server: RunningServer, cloud: Path, large_cloud: Path
) -> None:
    with pytest.raises(httpx2.ReadTimeout), large_cloud.open("rb") as body:
        httpx2.post(f"{server.url}/denoise?iterations=10", content=body, timeout=httpx2.Timeout(30, read=1.5))
    began = time.monotonic()
    assert curl("-F", f"file=@{cloud}", "-F", "iterations=1", f"{server.url}/denoise").status == 200
    assert time.monotonic() - began < 15, "the canceled job was computed to its end"
    wait_for(lambda: not server.spooled_files())


def test_health_answers_fast_while_a_job_runs(server: RunningServer, large_cloud: Path) -> None:
    process = subprocess.Popen(
        ["curl", "-s", "--data-binary", f"@{large_cloud}", f"{server.url}/denoise?iterations=1"],
        stdout=subprocess.DEVNULL,
    )
    try:
        wait_for(lambda: bool(server.spooled_files()))
        with httpx2.Client(base_url=server.url) as client:
            seconds = []
            for _ in range(40):
                began = time.perf_counter()
                assert client.get("/healthz").status_code == 200
                seconds.append(time.perf_counter() - began)
                time.sleep(0.02)
        assert process.poll() is None, "the job was over too early to tell"
        assert np.median(seconds) < 0.05
        assert max(seconds) < 1.0
    finally:
        process.kill()
        process.wait()
