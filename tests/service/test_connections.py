"""Connections on which nothing is to be answered: closed after a while, whatever came before."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from email.utils import parsedate_to_datetime
from pathlib import Path

import pytest

from straightpcf.service.engine import Engine
from tests.service.engines import submit, until
from tests.service.fakes import CONTENT, Large, ObedientBackend
from tests.service.in_process import serving
from tests.service.test_races import CLOUD, POST, play, willing

REFUSED = b"PUT /nowhere HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\n"
GOOD = b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n"


@pytest.mark.parametrize("parts", [[b""], [b"GET /li"], [GOOD, b"GET /li"], [REFUSED, b"1 2 3\n"]])
def test_one_that_falls_silent_is_closed(tmp_path: Path, parts: list[bytes]) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing(), upload_idle_seconds=0.5) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            for part in parts:
                writer.write(part)
                await asyncio.sleep(0.2)
            answer = await asyncio.wait_for(reader.read(), timeout=4)  # to the end: the server closes
            assert answer.startswith(b"HTTP/1.1 ") == (len(parts) > 1)
            writer.close()

    play(scenario)


BROKEN = {
    b"GET /livez HTTP/1.1\r\n\r\n": "Missing mandatory Host: header",
    b"\x16\x03\x01\x02\x00 TLS, perhaps\r\n\r\n": "illegal request line",
    b"PUT /jobs/a HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n": "bad Content-Length",
    b"PUT /jobs/a HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n": "illegal chunk header",
}


@pytest.mark.parametrize("broken", BROKEN)
def test_what_is_no_http_is_told_so_by_a_problem(
    tmp_path: Path, broken: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing()) as (engine, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(broken)
            head, body = (await asyncio.wait_for(reader.read(), timeout=10)).split(b"\r\n\r\n")
            problem = json.loads(body)
            assert head.startswith(b"HTTP/1.1 400 ")
            assert b"application/problem+json" in head
            assert b"\r\ndate: " in head  # RFC 9110, 6.6.1
            assert (problem["code"], problem["status"]) == ("invalid_request", 400)
            assert problem["request_id"].encode() in head
            assert BROKEN[broken] in problem["detail"]
            assert not (await engine.list())[0]
            writer.close()

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize("other", [b"h2c", b"websocket"])
def test_one_that_would_rather_have_another_protocol_is_answered_and_fills_no_log(
    tmp_path: Path, other: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing()) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(GOOD[:-2] + b"Connection: Upgrade, HTTP2-Settings, close\r\nUpgrade: " + other + b"\r\n\r\n")
            assert (await asyncio.wait_for(reader.read(), timeout=10)).startswith(b"HTTP/1.1 200 ")
            writer.close()

    play(scenario)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]


@pytest.mark.parametrize("asked", [b"livez", b"jobs/a/events"])
def test_what_comes_behind_an_answer_and_is_no_http_is_no_fault(
    tmp_path: Path, asked: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, ObedientBackend()) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(b"PUT /jobs/a?filename=a.xyz HTTP/1.1\r\nHost: [::1]\r\nContent-Length: 6\r\n\r\n1 2 3\n")
            await reader.readuntil(b"}}")
            writer.write(b"GET /%b HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n" % asked)
            await reader.readuntil(b"\r\n\r\n")
            writer.write(b"zz\r\n")
            await asyncio.wait_for(reader.read(), timeout=10)
            writer.close()

    play(scenario)
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize("length", [3, 1000])
def test_one_with_two_lengths_is_closed_behind_its_answer(tmp_path: Path, length: int) -> None:
    """Where a proxy heeds the other length, what follows is no request that it let through (RFC 9112, 6.1)."""

    async def scenario() -> None:
        async with serving(tmp_path, willing()) as (engine, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            head = b"PUT /jobs/a?filename=a.xyz HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n"
            body = b"%x\r\n%b\r\n0\r\n\r\n" % (len(CLOUD), CLOUD)
            writer.write(head + b"Content-Length: %d\r\n\r\n" % length + body + GOOD)
            answer = await asyncio.wait_for(reader.read(), timeout=10)  # to the end: the server closes
            assert answer.startswith(b"HTTP/1.1 202 ")
            assert b"connection: close" in answer
            assert b"ready" not in answer
            assert (await engine.get("a")).bytes == len(CLOUD)
            writer.close()

    play(scenario)


def test_one_that_closes_behind_an_early_answer_still_takes_the_body_and_then_ends(tmp_path: Path) -> None:
    """urllib and proxies ask to close, and read the answer when all is sent: a reset would take it from them."""

    async def scenario() -> None:
        async with serving(tmp_path, willing(), upload_idle_seconds=0.1) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(REFUSED.replace(b"1000", b"100000000\r\nConnection: close"))
            answer = await asyncio.wait_for(reader.read(), timeout=10)  # to the end: the server says no more
            assert answer.startswith(b"HTTP/1.1 404 ")
            for _ in range(40):
                writer.write(bytes(2**16))
                await writer.drain()
            with pytest.raises(ConnectionError):
                await _send_now_and_then(writer, seconds=0.3)  # longer than the server waits

    play(scenario)


def test_one_whose_body_was_not_asked_for_is_closed_behind_its_answer(tmp_path: Path) -> None:
    """Apache's client sends the next request there, and no body: it was read as that, and what followed was 400."""

    async def scenario() -> None:
        async with serving(tmp_path, willing()) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(REFUSED)
            answer = await reader.readuntil(b"}")
            assert b"connection: close" not in answer  # this one sends its body
            writer.close()
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(REFUSED.replace(b"1000", b"1000\r\nExpect: 100-continue"))
            answer = await asyncio.wait_for(reader.readuntil(b"}"), timeout=10)
            assert answer.startswith(b"HTTP/1.1 404 ")
            assert b"connection: close" in answer
            writer.write(GOOD)
            assert await asyncio.wait_for(reader.read(), timeout=10) == b""  # to the end, without another answer
            writer.close()

    play(scenario)


def test_one_whose_body_was_asked_for_is_kept(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing()) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            head, body = POST.split(b"\r\n\r\n", 1)
            writer.write(head + b"\r\nExpect: 100-continue\r\n\r\n")
            assert await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), timeout=10) == b"HTTP/1.1 100 Continue\r\n\r\n"
            writer.write(body)
            assert b"connection: close" not in await asyncio.wait_for(reader.readuntil(b"the result"), timeout=10)
            writer.write(GOOD)
            assert b"ready" in await asyncio.wait_for(reader.readuntil(b"}"), timeout=10)
            writer.close()

    play(scenario)


@pytest.mark.parametrize("together", [True, False])
def test_one_that_waits_for_an_answer_is_not(tmp_path: Path, together: bool) -> None:
    async def scenario() -> None:
        backend = willing()
        backend.finish.clear()
        async with serving(tmp_path, backend, upload_idle_seconds=0.3, shutdown_seconds=0.1) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            made = b"PUT /jobs/a?filename=a.xyz HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n" % len(CLOUD)
            asked = b"GET /jobs/a?wait=1 HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
            writer.write(made + CLOUD)
            first = b"" if together else await reader.readuntil(b"}}")
            writer.write(asked)
            answer = await asyncio.wait_for(reader.read(), timeout=20)
            assert (first + answer).count(b"HTTP/1.1 20") == 2
            writer.close()

    play(scenario)


def test_an_answer_has_the_date_at_which_it_begins_and_not_that_of_its_request(tmp_path: Path) -> None:
    """RFC 9110, 6.6.1: by it clients set their clocks, and no Last-Modified may be later."""

    async def scenario() -> None:
        backend = willing()
        backend.finish.clear()
        async with serving(tmp_path, backend, shutdown_seconds=0.1) as (_, host, port):
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(POST.replace(b"\r\n", b"\r\nPrefer: wait=3\r\n", 1))
            head = await reader.readuntil(b"\r\n\r\n")
            (date,) = (line for line in head.split(b"\r\n") if line.startswith(b"date: "))
            assert time.time() - parsedate_to_datetime(date[6:].decode()).timestamp() < 3
            writer.close()

    play(scenario)


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="of Linux alone")
def test_one_that_takes_nothing_of_its_answer_is_closed_and_one_that_takes_it_slowly_is_not(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with serving(tmp_path, willing(Large()), download_idle_seconds=1) as (engine, host, port):
            await submit(engine, id="a")
            await engine.wait("a", seconds=20)
            asked = b"GET /jobs/a/result HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
            with socket.create_connection((host, port)) as idle, socket.create_connection((host, port)) as slow:
                for each in (idle, slow):
                    each.sendall(asked)
                taken = 0
                while part := await asyncio.to_thread(slow.recv, 2**21, socket.MSG_WAITALL):
                    taken += len(part)
                    await asyncio.sleep(0.2)
                assert taken > 30 << 20  # to its end
                with idle.makefile("rb") as answer, pytest.raises(ConnectionError):
                    await asyncio.to_thread(answer.read)

    play(scenario)


def test_one_whose_peer_closes_half_of_it_is_taken_for_gone_and_frees_the_worker(tmp_path: Path) -> None:
    """A peer that closed all of it sends no other sign; docs/api.md says so."""

    async def scenario() -> None:
        async with _worked_on(tmp_path, POST) as (engine, _, reader, writer):
            writer.write_eof()
            assert await asyncio.wait_for(reader.read(), timeout=10) == b""
            while (await engine.list())[0]:
                await asyncio.sleep(0.01)

    play(scenario)


@pytest.mark.parametrize("behind", [b"\r\n", GOOD, b"no HTTP"])
@pytest.mark.parametrize("last", [b"HTTP/1.0\r\n", b"HTTP/1.1\r\nConnection: close\r\n"])
def test_what_comes_behind_the_last_request_of_one_takes_its_answer_from_nobody(
    tmp_path: Path, last: bytes, behind: bytes
) -> None:
    async def scenario() -> None:
        asked = POST.replace(b"HTTP/1.1\r\n", last)
        async with _worked_on(tmp_path, asked) as (_, backend, reader, writer):
            writer.write(behind)
            await asyncio.sleep(0.1)
            backend.finish.set()
            answer = await asyncio.wait_for(reader.read(), timeout=10)
            assert answer.startswith(b"HTTP/1.1 200 ")
            assert answer.endswith(b"\r\n\r\n" + CONTENT)

    play(scenario)


@pytest.mark.parametrize("behind", [b"\r\n", GOOD])
def test_one_that_is_closed_behind_a_further_request_frees_the_worker(tmp_path: Path, behind: bytes) -> None:
    async def scenario() -> None:
        async with _worked_on(tmp_path, POST) as (engine, backend, _, writer):
            for _ in range(3):
                writer.write(behind)
                await asyncio.sleep(0.05)
            writer.close()
            while (await engine.list())[0]:
                await asyncio.sleep(0.01)
            assert len(backend.canceled) == 1

    play(scenario)


@asynccontextmanager
async def _worked_on(
    tmp_path: Path, request: bytes
) -> AsyncIterator[tuple[Engine, ObedientBackend, asyncio.StreamReader, asyncio.StreamWriter]]:
    """Serve one request that is being worked on until its backend is told to finish; give its connection, too."""
    backend = willing()
    backend.finish.clear()
    async with serving(tmp_path, backend) as (engine, host, port):
        reader, writer = await asyncio.open_connection(host, port)
        writer.write(request)
        await until(lambda: backend.runs)
        yield engine, backend, reader, writer
        writer.close()


async def _send_now_and_then(writer: asyncio.StreamWriter, *, seconds: float) -> None:
    while True:
        await asyncio.sleep(seconds)
        writer.write(b"0")
        await writer.drain()
