"""The async client where calls are cut off, and where there are many."""

from __future__ import annotations

import asyncio
import gc
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import httpx2
import pytest
from anyio import CancelScope

from straightpcf.clients.sdk import AsyncClient, AsyncJob, Client, flows, http_transport, request, retry
from straightpcf.points.errors import ConnectionFailed, InvalidRequest
from tests.service.engines import until
from tests.service.fakes import ObedientBackend
from tests.service.in_process import free_port, serving

HEALTHY = b'HTTP/1.1 200 OK\r\nContent-Length: 29\r\nConnection: close\r\n\r\n{"status":"ok","ready":true}\n'
STREAM = b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nConnection: close\r\n\r\n: here\n\n"


def test_calls_that_a_close_cuts_off_say_that_it_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)

    async def close_meanwhile(url: str) -> None:
        client = AsyncClient(url)
        call = asyncio.create_task(client.health())
        await asyncio.sleep(0.2)
        await client.aclose()
        with pytest.raises(InvalidRequest, match="closed"):
            await call

    with socket.create_server(("127.0.0.1", 0)) as silent:
        for scheme in ("http", "grpc"):
            asyncio.run(close_meanwhile(f"{scheme}://127.0.0.1:{silent.getsockname()[1]}"))


def test_a_close_ends_on_the_server_what_it_cuts_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flows, "POLL_SECONDS", 0.2)  # after which a thread notices
    (scan := tmp_path / "scan.xyz").write_text("0 0 0\n" * 50)

    async def in_a_task(url: str, closing: Callable[[], Awaitable[object]]) -> None:
        async with AsyncClient(url) as client:
            call = asyncio.create_task(client.denoise(scan))
            await closing()
        with pytest.raises(InvalidRequest, match="closed"):
            await call

    async def in_a_thread(url: str, closing: Callable[[], Awaitable[object]]) -> None:
        with Client(url) as client:
            call = asyncio.create_task(asyncio.to_thread(client.denoise, scan))
            await closing()
        with pytest.raises(InvalidRequest, match="closed"):
            await call

    async def scenario() -> None:
        backend = ObedientBackend()
        backend.go.set()
        async with serving(tmp_path / "data", backend, grpc_port=(grpc := free_port())) as (engine, host, http):
            for url in (f"http://{host}:{http}", f"grpc://{host}:{grpc}"):
                for use in (in_a_task, in_a_thread):
                    backend.runs.clear()
                    await use(url, lambda: until(lambda: backend.runs))
                    assert not (await engine.list())[0]
            assert len(backend.canceled) == 4

    asyncio.run(asyncio.wait_for(scenario(), timeout=20))


def test_a_client_in_another_event_loop_says_so() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for scheme in ("http", "grpc"):
            url = f"{scheme}://127.0.0.1:{silent.getsockname()[1]}"
            client = AsyncClient(url, timeout=0.2, max_retries=0)
            with pytest.raises(ConnectionFailed):
                asyncio.run(client.health())
            with pytest.raises(InvalidRequest, match="belongs to another event loop"):
                asyncio.run(client.health())


# The loop ended with a connection open, which Python says by itself.
@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
def test_a_client_whose_event_loop_is_over_is_closed_in_another() -> None:
    async def use(client: AsyncClient) -> None:
        async with client:
            await client.health()

    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            with connection:  # which stays open behind the answer
                connection.recv(1 << 16)
                connection.sendall(HEALTHY.replace(b"Connection: close\r\n", b""))
                over.wait(10)

        over = threading.Event()
        (answering := threading.Thread(target=answer)).start()
        client = AsyncClient(f"http://127.0.0.1:{server.getsockname()[1]}", max_retries=0)
        asyncio.run(client.health())
        with pytest.raises(InvalidRequest, match="belongs to another event loop"):
            asyncio.run(use(client))
        asyncio.run(client.aclose())
        over.set()
        answering.join()
        del client
        gc.collect()


def test_an_upload_that_is_cancelled_while_its_file_is_read_is_cancelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scan.xyz").write_text("0 0 0\n" * 50)
    reading, may_go_on = threading.Event(), threading.Event()

    def slowly(path: Path, size: int, written: int) -> Iterator[bytes]:
        reading.set()
        may_go_on.wait(10)
        yield path.read_bytes()

    monkeypatch.setattr(request, "_read_chunks", slowly)

    async def use(url: str) -> None:
        async with AsyncClient(url, max_retries=0) as client:
            task = asyncio.create_task(client.jobs.create(tmp_path / "scan.xyz"))
            await asyncio.to_thread(reading.wait, 10)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            may_go_on.set()

    with socket.create_server(("127.0.0.1", 0)) as silent:
        asyncio.run(use(f"http://127.0.0.1:{silent.getsockname()[1]}"))


def test_a_scope_of_anyio_that_cancels_a_call_ends_its_work_on_the_server(tmp_path: Path) -> None:
    (scan := tmp_path / "scan.xyz").write_text("0 0 0\n" * 50)

    async def canceled_in_a_scope(url: str, backend: ObedientBackend) -> None:
        backend.runs.clear()
        with CancelScope() as scope:

            async def cancel_once_it_runs() -> None:
                await until(lambda: backend.runs)
                scope.cancel()

            canceling = asyncio.create_task(cancel_once_it_runs())
            async with AsyncClient(url) as client:
                await client.denoise(scan)
        await canceling
        assert scope.cancelled_caught

    async def scenario() -> None:
        backend = ObedientBackend()
        backend.go.set()
        async with serving(tmp_path / "data", backend, grpc_port=(grpc := free_port())) as (engine, host, http):
            for url in (f"http://{host}:{http}", f"grpc://{host}:{grpc}"):
                await canceled_in_a_scope(url, backend)
                assert not (await engine.list())[0]
            assert len(backend.canceled) == 2

    asyncio.run(asyncio.wait_for(scenario(), timeout=20))


def test_more_streams_than_a_pool_holds_keep_no_other_call_waiting_in_vain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_transport, "_LIMITS", httpx2.Limits(max_connections=2))
    may_end = asyncio.Event()

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        if b"/events" in head:
            writer.write(STREAM)
            await may_end.wait()
        else:
            writer.write(HEALTHY)
        writer.close()

    async def follow(client: AsyncClient) -> None:
        async for _ in AsyncJob(client.jobs._transport, SimpleNamespace(id="a")).events():  # type: ignore[arg-type]
            pass

    async def use() -> None:
        server = await asyncio.start_server(answer, "127.0.0.1", 0)
        url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        async with server, AsyncClient(url, timeout=0.2, max_retries=0) as client:
            streams = [asyncio.create_task(follow(client)) for _ in range(2)]
            await asyncio.sleep(0.2)
            asyncio.get_running_loop().call_later(0.5, may_end.set)
            assert (await client.health()).ready
            await asyncio.gather(*streams, return_exceptions=True)

    asyncio.run(use())
