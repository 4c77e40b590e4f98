"""The client for coroutines: the same methods as in client.py, on the same flows."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Collection
from contextlib import aclosing
from pathlib import Path
from types import TracebackType
from typing import Self

from straightpcf.clients.sdk import flows
from straightpcf.clients.sdk.arguments import path_of
from straightpcf.clients.sdk.client import DEFAULT_TIMEOUT_SECONDS
from straightpcf.clients.sdk.events import Event
from straightpcf.clients.sdk.flows import OnProgress
from straightpcf.clients.sdk.job_info import JobInfo, JobState
from straightpcf.clients.sdk.receive import Events, Patches
from straightpcf.clients.sdk.request import Iterations, Normals, Source, events_call, patches_call
from straightpcf.clients.sdk.response import Health, ServerInfo
from straightpcf.clients.sdk.result import Denoised
from straightpcf.clients.sdk.retry import MAX_RETRIES
from straightpcf.clients.sdk.transport import AsyncTransport, connect_async
from straightpcf.points.wire.patches import PatchFrame

__all__ = ["AsyncClient", "AsyncJob", "AsyncJobs"]


class AsyncClient:
    """Call a server from a coroutine; see `Client`. Cancelling a coroutine cancels its work on the server.

    A client belongs to the event loop of its first call: in another one, as of a second `asyncio.run`, its calls raise
    InvalidRequest.
    """

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout: float | None = DEFAULT_TIMEOUT_SECONDS,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        self._transport = connect_async(url, api_key=api_key, timeout=timeout, max_retries=max_retries)
        self.jobs = AsyncJobs(self._transport)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close the connections; a `denoise` of another task ends, and its work on the server."""
        await self._transport.close()

    async def denoise(
        self,
        source: Source,
        target: str | Path | None = None,
        *,
        iterations: Iterations = "auto",
        seed: int = 0,
        strength: float = 1.0,
        normals: Normals = "keep",
        format: str | None = None,
        name: str | Path | None = None,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> Denoised:
        """Do as `Client.denoise`; on_progress is an ordinary function."""
        flow = flows.denoise(
            source, path_of("target", target), on_progress, timeout, silence=self._transport.timeout,
            iterations=iterations, seed=seed, strength=strength, normals=normals, format=format, name=name,
        )  # fmt: skip
        return await self._transport.run(flow)

    async def health(self) -> Health:
        """Do as `Client.health`."""
        return await self._transport.run(flows.health())

    async def info(self) -> ServerInfo:
        """Do as `Client.info`."""
        return await self._transport.run(flows.info())


class AsyncJobs:
    """Make and find jobs; see `Jobs`."""

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    async def create(
        self,
        source: Source,
        *,
        iterations: Iterations = "auto",
        seed: int = 0,
        strength: float = 1.0,
        normals: Normals = "keep",
        format: str | None = None,
        name: str | Path | None = None,
        id: str | None = None,
        idempotency_key: str | None = None,
    ) -> AsyncJob:
        """Do as `Jobs.create`."""
        flow = flows.create(
            source, iterations=iterations, seed=seed, strength=strength, normals=normals, format=format,
            name=name, id=id, key=idempotency_key,
        )  # fmt: skip
        return AsyncJob(self._transport, await self._transport.run(flow))

    async def get(self, id: str) -> AsyncJob:
        """Do as `Jobs.get`."""
        return AsyncJob(self._transport, await self._transport.run(flows.get(id)))

    async def list(self, *, states: Collection[JobState] = (), page_size: int = 50) -> AsyncGenerator[AsyncJob]:
        """Do as `Jobs.list`."""
        cursor: str | None = None
        while True:
            jobs, cursor = await self._transport.run(flows.page(states, page_size, cursor))
            for info in jobs:
                yield AsyncJob(self._transport, info)
            if cursor is None:
                return


class AsyncJob:
    """Stand for one job on the server; see `Job`."""

    def __init__(self, transport: AsyncTransport, info: JobInfo) -> None:
        self._transport = transport
        self.info = info

    def __repr__(self) -> str:
        return f"<AsyncJob {self.id} {self.info.state} {self.info.progress:.0%}>"

    @property
    def id(self) -> str:
        """The job's name on the server."""
        return self.info.id

    async def refresh(self) -> JobInfo:
        """Do as `Job.refresh`."""
        self.info = await self._transport.run(flows.get(self.id))
        return self.info

    async def wait(self, *, timeout: float | None = None, on_progress: OnProgress | None = None) -> JobInfo:
        """Do as `Job.wait`."""
        flow = flows.wait(self.id, timeout, on_progress, silence=self._transport.timeout)
        self.info = await self._transport.run(flow)
        return self.info

    async def events(self, *, after: int = 0) -> AsyncGenerator[Event]:
        """Do as `Job.events`."""
        receiver = Events(after=after)
        async with aclosing(self._transport.stream((events_call(self.id), receiver))) as coming:
            async for _ in coming:
                for event in receiver.take():
                    yield event

    async def patches(self) -> AsyncGenerator[PatchFrame]:
        """Do as `Job.patches`."""
        receiver = Patches()
        async with aclosing(self._transport.stream((patches_call(self.id), receiver))) as coming:
            async for _ in coming:
                for frame in receiver.take():
                    yield frame

    async def result(self, target: str | Path | None = None) -> Denoised:
        """Do as `Job.result`."""
        return await self._transport.run(flows.result(self.info, path_of("target", target)))

    async def cancel(self) -> JobInfo:
        """Do as `Job.cancel`."""
        self.info = await self._transport.run(flows.cancel(self.id))
        return self.info

    async def delete(self) -> None:
        """Do as `Job.delete`."""
        await self._transport.run(flows.delete(self.id))
