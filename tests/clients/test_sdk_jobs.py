"""Jobs through the SDK, over both wires."""

from __future__ import annotations

import asyncio
import hashlib
import socket
import threading
import time
from collections.abc import AsyncGenerator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from straightpcf.clients.sdk import (
    AsyncClient,
    Client,
    Completed,
    Job,
    Output,
    Preview,
    Progress,
    Queued,
    Started,
    flows,
    retry,
)
from straightpcf.clients.sdk.job_info import JobInfo
from straightpcf.clients.sdk.receive import Body, Events
from straightpcf.clients.sdk.request import events_call, upload_call
from straightpcf.clients.sdk.transport import AsyncTransport
from straightpcf.points.errors import (
    ConnectionFailed,
    IdConflict,
    InvalidOptions,
    InvalidRequest,
    JobCanceled,
    JobNotFinished,
    NotFound,
    TooFewPoints,
    UnknownFormat,
)
from tests.clouds import noisy, sphere, torus
from tests.conftest import RunningServer

SMALL = noisy(torus(400), 0.01)
LARGE = noisy(sphere(12_000), 0.01)  # ten passes take the worker many seconds


@pytest.fixture(params=["http", "grpc"])
def url(request: pytest.FixtureRequest, server: RunningServer) -> str:
    return server.url if request.param == "http" else server.grpc_url


@pytest.fixture
def client(url: str) -> Iterator[Client]:
    with Client(url) as client:
        yield client


def test_a_name_may_be_a_path_and_need_not_be_utf_8(client: Client, tmp_path: Path) -> None:
    (path := tmp_path / "sc\udce4n.xyz").write_text("\n".join(f"{x} {y} {z}" for x, y, z in SMALL))
    job = client.jobs.create(path, iterations=1)
    assert job.info.name == "sc?n.xyz"
    named = client.denoise(path.read_bytes(), iterations=1, name=Path("s.xyz"))
    np.testing.assert_array_equal(client.denoise(path, iterations=1).xyz, named.xyz)
    job.delete()


def test_a_job_goes_from_create_to_result(client: Client, tmp_path: Path) -> None:
    job = client.jobs.create(SMALL, iterations=1)
    info = job.wait()
    assert (info.state, info.points, info.progress, info.options.iterations) == ("succeeded", 400, 1.0, 1)
    result = job.result(tmp_path / "clean.npy")
    assert result.content is None
    assert result.job.result is not None
    assert hashlib.sha256((tmp_path / "clean.npy").read_bytes()).hexdigest() == result.job.result.sha256
    assert result.xyz.shape == SMALL.shape
    np.testing.assert_array_equal(result.xyz, client.denoise(SMALL, iterations=1).xyz)
    assert client.jobs.get(job.id).info.report == result.report
    job.delete()
    with pytest.raises(NotFound):
        job.refresh()


def test_the_same_id_finds_the_same_job_and_another_request_a_conflict(client: Client) -> None:
    first = client.jobs.create(SMALL, iterations=1, id="mine-1")
    assert client.jobs.create(SMALL, iterations=1, id="mine-1").info.created_at == first.info.created_at
    with pytest.raises(IdConflict):
        client.jobs.create(SMALL, iterations=2, id="mine-1")
    one = client.jobs.create(SMALL, iterations=1, idempotency_key="k")
    assert client.jobs.create(SMALL, iterations=1, idempotency_key="k").id == one.id
    for job in (first, one):
        job.delete()


def test_the_list_goes_through_all_pages(client: Client) -> None:
    jobs = [client.jobs.create(SMALL, iterations=1) for _ in range(5)]
    for job in jobs:
        job.wait()
    listed = [job.id for job in client.jobs.list(states=["succeeded"], page_size=2)]
    assert listed[:5] == [job.id for job in reversed(jobs)]
    for job in jobs:
        job.delete()


def test_events_and_patches_tell_the_whole_story(client: Client) -> None:
    job = client.jobs.create(noisy(torus(2500), 0.01), iterations=1)
    xyz = np.full((2500, 3), np.nan)
    for frame in job.patches():
        xyz[frame.indices] = frame.xyz
    events = list(job.events())
    assert [type(event) for event in events[:2]] == [Queued, Started]
    assert {Progress, Preview, Output} <= {type(event) for event in events}
    assert isinstance(events[-1], Completed)
    assert [event.id for event in events] == list(range(1, len(events) + 1))
    assert list(job.events(after=np.int64(events[-2].id))) == events[-1:]  # type: ignore[arg-type]
    np.testing.assert_allclose(xyz, job.result().xyz)
    job.delete()


def test_progress_is_told_with_and_without_a_limit(client: Client) -> None:
    for timeout in (None, 60.0):
        told: list[float] = []
        client.denoise(SMALL, iterations=1, on_progress=told.append, timeout=timeout)
        assert told == sorted(told)
        assert told[-1] == 1.0


def test_a_wait_that_is_too_short_ends_and_a_denoise_takes_its_job_along(client: Client) -> None:
    job = client.jobs.create(LARGE, iterations=10)
    with pytest.raises(JobNotFinished):
        job.wait(timeout=0.2)
    with pytest.raises(JobNotFinished):
        job.result()
    assert job.cancel().state == "canceled"
    with pytest.raises(JobCanceled):
        job.result()
    with pytest.raises(JobCanceled):
        list(job.patches())
    job.delete()
    with pytest.raises(JobNotFinished):
        client.denoise(LARGE, iterations=10, timeout=0.3)
    assert not list(client.jobs.list(states=["queued", "starting", "processing"]))


def test_a_short_timeout_is_no_limit_to_a_job_that_waits_its_turn(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)

    async def there() -> int:
        async with AsyncClient(url, timeout=0.5) as client:
            return (await client.denoise(SMALL, iterations=1)).points

    with Client(url) as patient, Client(url, timeout=0.5) as hasty, ThreadPoolExecutor() as pool:
        first = patient.jobs.create(LARGE, iterations=10)
        threading.Timer(3.5, first.cancel).start()
        others = [
            pool.submit(lambda: hasty.denoise(SMALL, iterations=1).points),
            pool.submit(lambda: hasty.denoise(SMALL, iterations=1, on_progress=lambda _: None).points),
            pool.submit(lambda: sum(len(frame.indices) for frame in hasty.jobs.create(SMALL, iterations=1).patches())),
            pool.submit(asyncio.run, there()),
        ]
        assert [other.result(timeout=60) for other in others] == [400, 400, 400, 400]


def test_events_and_patches_of_a_job_that_waits_long_are_waited_for(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "FIRST_DELAY_SECONDS", 0.01)
    monkeypatch.setattr("straightpcf.clients.sdk.request.STREAM_SECONDS", 0.3)

    async def there(id: str) -> int:
        async with AsyncClient(url, timeout=0.3, max_retries=1) as client:
            return sum([len(frame.indices) async for frame in (await client.jobs.get(id)).patches()])

    with Client(url) as patient, Client(url, timeout=0.3, max_retries=1) as hasty:
        first = patient.jobs.create(LARGE, iterations=10)
        job = hasty.jobs.create(SMALL, iterations=1)
        with ThreadPoolExecutor() as pool:
            also = pool.submit(asyncio.run, there(job.id))
            told = pool.submit(lambda: list(job.events()))
            pool.submit(lambda: (time.sleep(2.5), first.cancel()))
            assert sum(len(frame.indices) for frame in job.patches()) == also.result() == 400
            assert [event.id for event in told.result()] == list(range(1, 1 + len(told.result())))
        first.delete()


@pytest.mark.parametrize(("suffix", "first"), [("csv", b","), ("pts", b"400\n")])
def test_text_of_every_kind_comes_from_a_server_as_its_suffix_says(
    client: Client, tmp_path: Path, suffix: str, first: bytes
) -> None:
    np.savetxt(source := tmp_path / "in.txt", SMALL, delimiter=";")
    target = tmp_path / f"clean.{suffix}"
    for cloud in (SMALL, source):
        result = client.denoise(cloud, target, iterations=1)
        assert first in target.read_bytes().partition(b"\n")[0] + b"\n"
        assert b";" not in target.read_bytes()
        assert result.xyz.shape == SMALL.shape
        assert result.filename.endswith(suffix)


def test_the_bytes_of_a_text_file_need_a_name(client: Client, tmp_path: Path) -> None:
    np.savetxt(path := tmp_path / "scan.xyz", SMALL)
    raw = path.read_bytes()
    by_path = client.denoise(path, iterations=1)
    assert client.denoise(raw, name="scan.xyz", iterations=1).content == by_path.content
    frame = np.hstack([SMALL, np.ones((400, 1))]).astype("<f4").tobytes()
    assert client.denoise(frame, name="frame.bin", iterations=1).points == 400
    with pytest.raises(UnknownFormat, match="needs a name"):
        client.jobs.create(raw)
    assert not list(client.jobs.list())


def test_what_no_header_can_carry_is_refused_by_its_class(url: str) -> None:
    for key in ("ключ", "a\nb", "naïve"):
        with pytest.raises(InvalidOptions, match="ASCII"):
            Client(url, api_key=key)
        with pytest.raises(InvalidOptions, match="ASCII"):
            AsyncClient(url, api_key=key)
        with Client(url) as client, pytest.raises(InvalidRequest, match="ASCII"):
            client.jobs.create(SMALL, idempotency_key=key)


def test_a_failed_job_raises_the_class_of_its_code(client: Client) -> None:
    job = client.jobs.create(sphere(5))
    assert job.wait().state == "failed"
    for ask in (job.result, lambda: list(job.patches())):
        with pytest.raises(TooFewPoints):
            ask()
    job.delete()


def test_the_async_client_does_the_same_and_a_cancelled_coroutine_ends_its_job(url: str) -> None:
    async def use() -> None:
        async with AsyncClient(url) as client:
            job = await client.jobs.create(SMALL, iterations=1)
            frames = [frame async for frame in job.patches()]
            assert sum(len(frame.indices) for frame in frames) >= 400
            assert isinstance([event async for event in job.events()][-1], Completed)
            assert (await job.wait()).finished
            assert (await job.result()).points == 400
            assert [found.id async for found in client.jobs.list()].index(job.id) == 0
            await job.delete()
            told: list[float] = []
            task = asyncio.create_task(client.denoise(LARGE, iterations=10, on_progress=told.append))
            while not told:
                await asyncio.sleep(0.05)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert [job async for job in client.jobs.list(states=["queued", "starting", "processing"])] == []

    asyncio.run(use())


@pytest.mark.parametrize("change", ["grown", "shrunk", "removed"])
@pytest.mark.parametrize("is_async", [False, True])
def test_a_file_that_changes_while_it_is_sent_is_named(
    url: str, tmp_path: Path, change: str, *, is_async: bool
) -> None:
    path = tmp_path / "growing.xyz"
    path.write_text("0 0 0\n" * 100_000)

    def hand_over() -> flows.Flow[JobInfo]:
        call = upload_call(path, iterations=1, seed=0, strength=1.0, format=None)
        text = path.read_text()
        path.unlink()
        if change != "removed":
            path.write_text(text + "0 0 0\n" if change == "grown" else text[:-6])
        return (yield call, Body(JobInfo.parse))  # type: ignore[no-any-return]

    async def run() -> None:
        async with AsyncClient(url) as client:
            await client._transport.run(hand_over())

    kind = FileNotFoundError if change == "removed" else InvalidRequest
    with Client(url) as client:
        before = [job.id for job in client.jobs.list()]
        with pytest.raises(kind, match=r"growing\.xyz"):
            asyncio.run(run()) if is_async else client._transport.run(hand_over())
        assert [job.id for job in client.jobs.list()] == before


class _Endless(AsyncTransport):
    """A server that goes on and on."""

    timeout, max_retries = None, 0
    ended = False

    async def close(self) -> None:
        """Close nothing."""

    async def attempt(self, *_: object) -> AsyncGenerator[None]:
        """Let something come, again and again."""
        try:
            while True:
                yield
        finally:
            self.ended = True


def test_closing_what_follows_a_job_ends_its_request_at_once() -> None:
    async def follow() -> None:
        transport = _Endless()
        coming = transport.stream((events_call("a"), Events(after=0)))
        await anext(coming)
        await coming.aclose()
        assert transport.ended

    asyncio.run(follow())


@pytest.mark.parametrize("body", [b"hola", b"", b"null", b"[]", b'{"jobs": [1]}'])
@pytest.mark.parametrize(
    "ask", [Client.info, lambda client: client.jobs.get("a"), lambda client: [*client.jobs.list()]]
)
def test_a_server_of_another_kind_is_called_so(body: bytes, ask: Callable[[Client], object]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(65536)
                head = b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\nConnection: close\r\n\r\n" % len(body)
                connection.sendall(head + body)

        threading.Thread(target=answer, daemon=True).start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with Client(url) as client, pytest.raises(ConnectionFailed, match="no StraightPCF server"):
            ask(client)


def test_a_timeout_ends_a_call_whatever_the_server_does(
    client: Client, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flows, "FAREWELL_SECONDS", 0.5)
    monkeypatch.setattr(flows, "_LATE_SECONDS", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as listener:  # which accepts, and never answers
        silent = Client(f"{url.partition(':')[0]}://127.0.0.1:{listener.getsockname()[1]}")
        job = client.jobs.create(SMALL, iterations=1)
        there = Job(silent._transport, job.info)
        for ask in (partial(silent.denoise, SMALL), there.wait):
            began = time.monotonic()
            with pytest.raises(JobNotFinished, match=r"after 0\.5 s"):
                ask(timeout=0.5)
            assert time.monotonic() - began < 20
        job.delete()


def test_a_bad_id_and_a_missing_folder_are_refused(client: Client, tmp_path: Path) -> None:
    with pytest.raises(InvalidRequest):
        client.jobs.create(SMALL, id=".hidden")
    with pytest.raises(FileNotFoundError):
        client.denoise(SMALL, tmp_path / "nowhere" / "clean.npy")


def test_events_behind_the_last_one_are_none(client: Client) -> None:
    job = client.jobs.create(SMALL, iterations=1)
    last = list(job.events())[-1]
    assert isinstance(last, Completed)
    assert list(job.events(after=last.id)) == []


def test_a_job_that_was_made_anew_with_fewer_events_than_were_heard_is_waited_for(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    class OfLonger(flows._Watched):
        def __init__(self, on_progress: flows.OnProgress) -> None:
            super().__init__(on_progress)
            self.furthest = 1000  # of the job that had this id before

    monkeypatch.setattr(flows, "_Watched", OfLonger)
    told: list[float] = []
    job = client.jobs.create(SMALL, iterations=1)
    assert job.wait().state == job.wait(on_progress=told.append).state == "succeeded"
    assert told[-1] == 1.0


def test_the_async_client_hears_of_nothing_behind_the_last_event_too(url: str) -> None:
    async def count() -> int:
        async with AsyncClient(url) as client:
            job = await client.jobs.create(SMALL, iterations=1)
            last = [event async for event in job.events()][-1]
            return len([event async for event in job.events(after=last.id)])

    assert asyncio.run(count()) == 0


def test_what_is_no_id_state_or_page_is_refused_alike_over_both_wires(client: Client, tmp_path: Path) -> None:
    for id in ("", "..", "a/b", "a b"):  # "/jobs/" is the list and "/jobs/.." the page
        with pytest.raises(NotFound, match="there is no job"):
            client.jobs.get(id)
    states: Any = ["done"]
    with pytest.raises(InvalidRequest, match="state is 'done'"):
        list(client.jobs.list(states=states))
    for size in (0, 201):
        with pytest.raises(InvalidRequest, match=f"page_size is {size}"):
            list(client.jobs.list(page_size=size))
    job = client.jobs.create(SMALL, iterations=1)
    with pytest.raises(InvalidRequest, match="after is -3"):
        next(job.events(after=-3))
    with pytest.raises(FileNotFoundError, match="is no file"):
        client.jobs.create(tmp_path)


def test_jobs_may_be_kept_in_sets(client: Client) -> None:
    job = client.jobs.create(SMALL, iterations=1)
    finished = job.wait()
    assert len({finished, job.refresh()}) == 1
