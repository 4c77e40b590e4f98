"""The SDK's connections: addresses and keys that cannot be, and what is tried again."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from straightpcf.clients.sdk import AsyncClient, Client, retry, transport
from straightpcf.clients.sdk.receive import Body
from straightpcf.clients.sdk.request import Call, patches_call
from straightpcf.clients.sdk.transport import Attempts
from straightpcf.points.errors import (
    ConnectionFailed,
    InternalError,
    InvalidOptions,
    InvalidRequest,
    MissingDependency,
    NotFound,
    ServerBusy,
    TooManyBytes,
    Unauthorized,
)
from tests.clouds import noisy, torus
from tests.conftest import RunningServer


@contextmanager
def answering(*answers: bytes) -> Iterator[tuple[str, list[bytes]]]:
    """Serve one canned answer a connection; b"" hangs up without one. Collects the requests' heads."""
    heads: list[bytes] = []

    def run(listener: socket.socket) -> None:
        for answer in answers:
            connection, _ = listener.accept()
            with connection:
                heads.append(connection.recv(65536))
                connection.sendall(answer)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=run, args=(listener,), daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", heads
        thread.join(timeout=5)


def canned(status: str, body: str, *headers: str) -> bytes:
    head = [f"HTTP/1.1 {status}", f"Content-Length: {len(body)}", "Connection: close", *headers]
    return ("\r\n".join(head) + "\r\n\r\n" + body).encode()


HEALTHY = canned("200 OK", '{"status":"ok","ready":true,"new":1}')
BUSY = canned("503 Service Unavailable", '{"code":"server_busy","detail":"full","retryable":true}', "Retry-After: 0.2")


def test_a_busy_server_is_asked_again_after_the_time_it_names() -> None:
    with answering(BUSY, HEALTHY) as (url, heads), Client(url, api_key="secret") as client:
        began = time.monotonic()
        assert client.health().ready
        assert time.monotonic() - began >= 0.2
        assert len(heads) == 2
        assert b"authorization: bearer secret" in heads[0].lower()


def test_who_is_not_to_be_tried_again_hears_the_time_too() -> None:
    with answering(BUSY) as (url, _), Client(url, max_retries=0) as client, pytest.raises(ServerBusy) as found:
        client.health()
    assert found.value.retry_after == 1  # whole seconds, none too few


def test_a_connection_that_breaks_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    with answering(b"", HEALTHY) as (url, heads), Client(url) as client:
        assert client.health().ready
        assert len(heads) == 2


def test_a_server_that_answered_and_is_gone_is_asked_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    broken = [b""] * 5
    with answering(HEALTHY, *broken, HEALTHY) as (url, heads), Client(url, max_retries=1) as client:
        assert client.health().ready
        assert client.health().ready
        assert len(heads) == 7
    with answering(HEALTHY, b"") as (url, heads), Client(url, max_retries=0) as client:
        assert client.health().ready
        with pytest.raises(ConnectionFailed):
            client.health()
        assert len(heads) == 2


@pytest.mark.parametrize("status", ["502 Bad Gateway", "503 Service Unavailable", "504 Gateway Timeout"])
def test_a_proxy_whose_server_is_gone_is_asked_on(status: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    gone = canned(status, "<html>proxy</html>")
    with answering(HEALTHY, *[gone] * 3, HEALTHY) as (url, heads), Client(url, max_retries=1) as client:
        assert client.health().ready
        assert client.health().ready
        assert len(heads) == 5
    with answering(gone, gone) as (url, heads), Client(url, max_retries=1) as client:
        with pytest.raises(ConnectionFailed, match=status):
            client.health()
        assert len(heads) == 2


def test_it_is_asked_for_no_longer_than_silence_is_borne_and_uploads_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = iter(range(0, 1000, 4))
    monkeypatch.setattr(transport, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    for body, most in ((None, 14), (b"cloud", 1)):
        call = Call(method="PUT", path="/", rpc="", body=body)
        attempts = Attempts(call, Body(), max_retries=1, patience=60.0)
        attempts.failure = retry.Failure(error=ConnectionFailed("refused"), retryable=True)
        for _ in range(most):
            assert attempts.delay() > 0
        with pytest.raises(ConnectionFailed):
            attempts.delay()


def test_an_answer_that_was_held_open_is_no_attempt_that_failed_unless_it_ends_in_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 0.0
    monkeypatch.setattr(transport, "time", SimpleNamespace(monotonic=lambda: now))
    attempts = Attempts(patches_call("a"), Body(), max_retries=1)
    for held in (60.0, 11.0, 60.0):
        attempts.failure = retry.Failure(error=ConnectionFailed("silent"), retryable=True)
        attempts.answered()
        now += held
        assert attempts.delay() == retry.FIRST_DELAY_SECONDS
    attempts.answered()  # it breaks off at once, again and again
    assert attempts.delay() > 0
    attempts.answered()
    with pytest.raises(ConnectionFailed):
        attempts.delay()
    attempts.answered()
    now += 60.0
    attempts.failure = retry.Failure(error=InvalidRequest("canceled"), retryable=False)
    with pytest.raises(InvalidRequest):
        attempts.delay()


def test_retries_end(monkeypatch: pytest.MonkeyPatch) -> None:
    with answering(BUSY, BUSY) as (url, _), Client(url, max_retries=1) as client, pytest.raises(ServerBusy):
        client.health()
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    with Client("http://127.0.0.1:1") as client, pytest.raises(ConnectionFailed, match=r"127\.0\.0\.1:1"):
        client.health()


def test_an_error_that_would_only_come_again_is_not_retried() -> None:
    missing = canned("503 Service Unavailable", '{"code":"device_unavailable","retryable":false}')
    for answer, kind in ((missing, Exception), (canned("500 Oh No", "<html>proxy</html>"), InternalError)):
        with answering(answer) as (url, heads), Client(url) as client:
            with pytest.raises(kind):
                client.health()
            assert len(heads) == 1


@pytest.mark.parametrize(
    "url",
    [
        "http://127.0.0.1:80a0", "http://256.1.1.1", "http://127.0.0.1:99999", "grpc://127.0.0.1:99999", "http://[::1",
        "http://", "ftp://host", "host:8000", "http://host/?x=1", "grpc://host", "grpc://host:1/path", "grpc://u@host:1",
    ],
)  # fmt: skip
def test_a_url_that_cannot_be_is_refused_at_once(url: str) -> None:
    with pytest.raises(InvalidOptions, match="is no address"):
        Client(url)
    with pytest.raises(InvalidOptions, match="is no address"):
        AsyncClient(url)


def test_a_url_may_have_a_large_scheme_and_slashes_at_its_end() -> None:
    with answering(HEALTHY) as (url, heads), Client(url.replace("http", "HTTP") + "//") as client:
        assert client.health().ready
    assert heads[0].startswith(b"GET /healthz ")


def test_a_password_in_a_url_is_never_shown() -> None:
    for url in ("http://user:secret@127.0.0.1:1", "http://user:secret@127.0.0.1:1?x=1"):
        with pytest.raises((ConnectionFailed, InvalidOptions), match=r"//127\.0\.0\.1:1") as found:
            Client(url, max_retries=0).health()
        assert "secret" not in str(found.value)


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [
        ("ALL_PROXY", "socks5://127.0.0.1:1", MissingDependency),
        ("HTTP_PROXY", "ftp://127.0.0.1:1", InvalidOptions),
        ("SSL_CERT_FILE", "/nowhere/certificates.pem", InvalidOptions),
    ],
)
def test_an_environment_that_cannot_be_used_is_named(
    name: str, value: str, kind: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    for make in (Client, AsyncClient):
        with pytest.raises(kind, match=name):
            make("http://127.0.0.1:1")


def test_a_client_that_is_closed_says_so() -> None:
    async def ask_closed(url: str) -> None:
        client = AsyncClient(url)
        await client.aclose()
        await client.health()

    for url in ("http://127.0.0.1:1", "grpc://127.0.0.1:1"):
        client = Client(url)
        client.close()
        client.close()
        with pytest.raises(InvalidRequest, match="closed"):
            client.health()
        with pytest.raises(InvalidRequest, match="closed"):
            asyncio.run(ask_closed(url))


@pytest.mark.parametrize("key", ["", " secret", "secret "])
def test_a_key_that_no_header_keeps_is_refused_at_once(key: str) -> None:
    with pytest.raises(InvalidOptions, match="API key"):
        Client("http://127.0.0.1:8000", api_key=key)


def test_a_key_beside_a_password_in_the_url_is_refused_as_it_would_not_be_sent() -> None:
    for make in (Client, AsyncClient):
        with pytest.raises(InvalidOptions, match=r"'http://127\.0\.0\.1:1/x' names a user.*API key") as found:
            make("http://user:secret@127.0.0.1:1/x", api_key="key")
        assert "secret" not in str(found.value)


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        ("413 Request Entity Too Large", TooManyBytes),
        ("502 Bad Gateway", ConnectionFailed),
        ("404 Not Found", ConnectionFailed),  # a server is not there: of a job of ours it says nothing
        ("405 Method Not Allowed", ConnectionFailed),
        ("401 Unauthorized", Unauthorized),
    ],
)
@pytest.mark.parametrize("page", ["<html>nginx</html>", '{"detail":"Not Found"}'])
def test_an_error_of_a_proxy_is_not_taken_for_the_servers(status: str, kind: type[Exception], page: str) -> None:
    with answering(canned(status, page)) as (url, _), Client(url, max_retries=0) as client:
        with pytest.raises(kind, match=f"{url}: HTTP {status}, of a proxy") as found:
            client.health()
        assert type(found.value) is kind


def test_a_page_that_a_proxy_sends_for_a_result_is_not_taken_for_one(server: RunningServer, tmp_path: Path) -> None:
    with Client(server.url) as client:
        job = client.jobs.create(noisy(torus(400), 0.01), iterations=1)
        job.wait()
        told = canned("200 OK", json.dumps(job.info.json))
    login = canned("200 OK", "<html>log in</html>", "Content-Type: text/html")
    cut = pytest.raises(ConnectionFailed, match="bytes arrived")
    with answering(told, login) as (url, _), Client(url, max_retries=0) as client:
        proxied = client.jobs.get(job.id)
        with cut:
            proxied.result(tmp_path / "clean.npy")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("status", ["200 OK", "500 Internal Server Error"])
def test_an_answer_that_was_damaged_on_its_way_is_asked_for_again(status: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    damaged = canned(status, "no gzip at all", "Content-Encoding: gzip")
    with answering(damaged, HEALTHY) as (url, heads), Client(url) as client:
        assert client.health().ready
        assert len(heads) == 2
    refused = pytest.raises(ConnectionFailed, match="DecodingError")
    with answering(damaged) as (url, _), Client(url, max_retries=0) as client, refused:
        client.health()


@pytest.mark.parametrize("said", ["id: x\ndata: {}", "id: 1\ndata: {}", "id: 1\ndata: {oops", "id: 1\ndata: null"])
def test_an_event_of_another_server_is_told_as_such(said: str, server: RunningServer) -> None:
    with Client(server.url) as client:
        job = client.jobs.create(noisy(torus(400), 0.01), iterations=1)
        told = canned("200 OK", json.dumps(job.info.json))
    event = canned("200 OK", f"event: queued\n{said}\n\n", "Content-Type: text/event-stream")
    with answering(told, event) as (url, _), Client(url, max_retries=0) as client:
        proxied = client.jobs.get(job.id)
        with pytest.raises(ConnectionFailed, match="no event of a StraightPCF server: 'queued'"):
            list(proxied.events())


def test_patches_of_another_server_are_told_as_such(server: RunningServer) -> None:
    with Client(server.url) as client:
        job = client.jobs.create(noisy(torus(400), 0.01), iterations=1)
        told = canned("200 OK", json.dumps(job.info.json))
    login = canned("200 OK", "<html>please log in</html>", "Content-Type: text/html")
    with answering(told, login) as (url, _), Client(url, max_retries=0) as client:
        proxied = client.jobs.get(job.id)
        with pytest.raises(ConnectionFailed, match="no patches of a StraightPCF server"):
            list(proxied.patches())


def test_a_job_is_deleted_though_the_answer_to_that_is_lost(
    server: RunningServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    with Client(server.url) as client:
        job = client.jobs.create(noisy(torus(400), 0.01), iterations=1)
    told = canned("200 OK", json.dumps(job.info.json))
    gone = canned("404 Not Found", '{"code":"not_found","detail":"there is no such job"}')
    with answering(told, b"", gone, BUSY, gone) as (url, _), Client(url) as client:
        lost = client.jobs.get(job.id)
        lost.delete()
        with pytest.raises(NotFound):
            lost.delete()


def test_a_redirect_is_told_with_the_place_that_it_names() -> None:
    moved = canned("301 Moved Permanently", "", "Location: https://clouds.example/healthz")
    refused = pytest.raises(InvalidRequest, match=r"https://clouds\.example/healthz")
    with answering(moved) as (url, _), Client(url) as client, refused:
        client.health()


def test_delays_grow_stay_bounded_and_follow_the_server() -> None:
    failure = retry.Failure(error=ServerBusy("full"), retryable=True)
    delays = [retry.next_delay(failure, attempt=n, max_retries=9) or 0.0 for n in range(9)]
    assert delays[0] < delays[2] < delays[4] <= retry.MAX_DELAY_SECONDS * 1.25
    assert retry.next_delay(failure, attempt=9, max_retries=9) is None
    told = retry.Failure(error=ServerBusy("full"), retryable=True, retry_after=10_000.0)
    assert retry.next_delay(told, attempt=0) == retry.MAX_RETRY_AFTER_SECONDS
    at_once = retry.Failure(error=ConnectionFailed("503"), retryable=True, retry_after=0.0)
    assert retry.next_delay(at_once, attempt=0) == 0.0
    assert retry.next_delay(at_once, attempt=1) == retry.FIRST_DELAY_SECONDS  # for a minute, it may be


FORKED = """
import os, sys
from straightpcf.clients.sdk import Client
client = Client(sys.argv[1], timeout=5, max_retries=0)
client.health()
child = os.fork()
if child == 0:
    os._exit(not client.health().ready)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) or not client.health().ready)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_shares_no_connection_with_its_parent() -> None:
    of_requests: list[int] = []

    def answer(connection: socket.socket, number: int) -> None:
        with connection:
            while connection.recv(65536):
                of_requests.append(number)
                connection.sendall(HEALTHY.replace(b"Connection: close", b"Connection: keep-alive"))

    def accept(listener: socket.socket) -> None:
        for number in range(2):
            threading.Thread(target=answer, args=(listener.accept()[0], number), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=accept, args=(listener,), daemon=True).start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        subprocess.run([sys.executable, "-c", FORKED, url], check=True, timeout=120)
    assert of_requests == [0, 1, 0]
