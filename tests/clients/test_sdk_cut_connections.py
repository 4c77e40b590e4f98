"""Jobs through the SDK, over connections that are cut or damage what they carry."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import repeat
from pathlib import Path
from typing import Any

import pytest

from straightpcf.clients.sdk import Client, request, retry
from straightpcf.points.errors import ConnectionFailed, InvalidRequest
from tests.clouds import noisy, torus
from tests.conftest import RunningServer

SMALL = noisy(torus(400), 0.01)


@contextmanager
def cutting_proxy(to: str, *, limits: Iterator[int], damage: int = -1) -> Iterator[tuple[str, list[str]]]:
    """Pass connections on and cut each answer after so many bytes; a byte at `damage` is changed in the first one.

    Collects the Range headers that were sent.
    """
    scheme, _, address = to.partition("://")
    host, port = address.split(":")
    ranges: list[str] = []

    def pass_on(client: socket.socket, limit: int, damage: int) -> None:
        with client, socket.create_connection((host, int(port))) as upstream:

            def forward() -> None:
                try:
                    while data := client.recv(65536):
                        ranges.extend(
                            line.decode() for line in data.split(b"\r\n") if line.lower().startswith(b"range:")
                        )
                        upstream.sendall(data)
                except OSError:
                    pass

            threading.Thread(target=forward, daemon=True).start()
            sent = 0
            try:
                while sent < limit and (data := upstream.recv(min(65536, limit - sent))):
                    if sent <= damage < sent + len(data):
                        at = damage - sent
                        data = data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]
                    client.sendall(data)
                    sent += len(data)
            except OSError:
                pass
            for end in (client, upstream):
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    def listen(listener: socket.socket) -> None:
        first = damage
        for limit in limits:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=pass_on, args=(client, limit, first), daemon=True).start()
            first = -1

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=listen, args=(listener,), daemon=True).start()
        yield f"{scheme}://127.0.0.1:{listener.getsockname()[1]}", ranges


@pytest.fixture
def done(server: RunningServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    with Client(server.url) as client:
        job = client.jobs.create(noisy(torus(2500), 0.01), iterations=1)
        job.wait()
        yield job
        job.delete()


def test_a_download_that_breaks_goes_on_where_it_was(server: RunningServer, done: Any, tmp_path: Path) -> None:
    whole = done.result().content
    with cutting_proxy(server.url, limits=repeat(9000)) as (url, ranges), Client(url, max_retries=2) as client:
        job = client.jobs.get(done.id)
        job.result(tmp_path / "clean.npy")
    assert (tmp_path / "clean.npy").read_bytes() == whole
    starts = [int(line.split("=")[1].rstrip("-")) for line in ranges]
    assert len(starts) >= 4  # more than max_retries: an attempt that got on is no failure
    assert starts == sorted(set(starts))


@pytest.mark.parametrize("transport", ["http", "grpc"])
def test_events_and_patches_go_on_over_cut_connections(server: RunningServer, done: Any, transport: str) -> None:
    frames, events = list(done.patches()), list(done.events())
    to, step = (server.url, 2000) if transport == "http" else (server.grpc_url, 20_000)
    growing = (step * n for n in range(1, 1000))
    with cutting_proxy(to, limits=growing) as (url, _), Client(url, max_retries=9) as client:
        job = client.jobs.get(done.id)
        assert list(job.events()) == events
        again = list(job.patches())
        assert [frame.progress for frame in again] == [frame.progress for frame in frames]


def test_a_file_that_arrives_damaged_is_fetched_again(server: RunningServer, done: Any) -> None:
    whole = done.result().content
    with cutting_proxy(server.url, limits=repeat(10**9), damage=20_000) as (url, _), Client(url) as client:
        assert client.jobs.get(done.id).result().content == whole


@pytest.mark.parametrize("how", ["in place", "replaced"])
def test_a_file_that_becomes_another_of_its_size_while_it_is_sent_is_named(
    tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan, read = tmp_path / "scan.xyz", request._read_chunks
    scan.write_bytes(b"0 0 0\n" * 10)
    os.utime(scan, ns=(1, 1))
    monkeypatch.setattr(request, "CHUNK_BYTES", 6)

    def written_meanwhile(path: Path, size: int, written: int) -> Iterator[bytes]:
        if how == "replaced":  # as between two attempts
            (tmp_path / "other.xyz").write_bytes(b"1 1 1\n" * 10)
            (tmp_path / "other.xyz").replace(path)
        for number, chunk in enumerate(read(path, size, written)):
            if how == "in place" and number == 4:
                with path.open("r+b") as file:
                    file.write(b"1 1 1\n" * 10)
            yield chunk

    monkeypatch.setattr(request, "_read_chunks", written_meanwhile)
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        Client(f"http://127.0.0.1:{listener.getsockname()[1]}", timeout=5) as client,
        pytest.raises(InvalidRequest, match=r"scan\.xyz changed while it was read: somebody wrote into it"),
    ):
        client.jobs.create(scan)


def test_a_call_that_never_gets_on_is_given_up_and_leaves_no_file(
    server: RunningServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    with (
        cutting_proxy(server.url, limits=repeat(50)) as (url, _),
        Client(url, max_retries=2) as client,
        pytest.raises(ConnectionFailed),
    ):
        client.denoise(SMALL, tmp_path / "clean.npy", iterations=1)
    assert not list(tmp_path.iterdir())
    with Client(server.url) as client:
        assert not list(client.jobs.list(states=["queued", "starting", "processing"]))
