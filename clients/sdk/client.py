"""The client for ordinary code: methods with names and types around flows."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from straightpcf.clients.sdk import flows
from straightpcf.clients.sdk.arguments import path_of
from straightpcf.clients.sdk.events import Event
from straightpcf.clients.sdk.flows import OnProgress
from straightpcf.clients.sdk.job_info import JobInfo, JobState
from straightpcf.clients.sdk.receive import Events, Patches
from straightpcf.clients.sdk.request import Iterations, Normals, Source, events_call, patches_call
from straightpcf.clients.sdk.response import Health, ServerInfo
from straightpcf.clients.sdk.result import Denoised
from straightpcf.clients.sdk.retry import MAX_RETRIES
from straightpcf.clients.sdk.transport import Transport, connect
from straightpcf.points.wire.patches import PatchFrame

__all__ = ["DEFAULT_TIMEOUT_SECONDS", "Client", "Job", "Jobs"]

DEFAULT_TIMEOUT_SECONDS = 60.0  # of silence: a server that works says something every 20


class Client:
    """Call a server from ordinary code; use it as a context manager or close it.

    Threads may share one, over HTTP forked processes, too. gRPC itself can hang in a process that was forked after it
    was used: let multiprocessing `spawn` there.

    url: where the server is, "http://127.0.0.1:8000"; "grpc://127.0.0.1:50051" (or grpcs://) needs the extra `grpc`.
    api_key: sent as a bearer token. HTTP_PROXY, HTTPS_PROXY, ALL_PROXY, NO_PROXY, SSL_CERT_FILE and SSL_CERT_DIR are
    heeded over HTTP.
    timeout: seconds of silence that are borne in each attempt, None for any, over gRPC as over HTTP: a server that
    hangs is given up after (1 + max_retries) times as long and the waits between, five minutes by default. Of streams
    (events, patches, progress) at least 60, after which one whose job waits is asked for again, however often.
    max_retries: of a busy server and of a broken connection; every other error is raised at once. A server that has
    answered and is gone (it is restarted, and a proxy before it answers 502, 503 or 504) is asked on for `timeout`
    seconds, but by what uploads a file; 0: never.
    """

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout: float | None = DEFAULT_TIMEOUT_SECONDS,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        self._transport = connect(url, api_key=api_key, timeout=timeout, max_retries=max_retries)
        self.jobs = Jobs(self._transport)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections; a `denoise` of another thread, once it notices, ends its work on the server."""
        self._transport.close()

    def denoise(
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
        """Denoise one cloud: the same points in the same order, every other field unchanged.

        source: a path, the bytes of a file, an (N, 3) array, or an open3d cloud.
        name: of the file, where the source has none: bytes of text or KITTI are known by its suffix only.
        target: where to write the result, complete or not at all; by default it is held in memory.
        normals: "recompute" them at the new positions, where a PLY, PCD or E57 file has some.
        format: of the result; by default that of the target's name, else that of the source.
        timeout: seconds after which JobNotFinished is raised. on_progress: called with the share that is done, 0..1.
        Raises the StraightPCFError that the server met. Whatever ends this early ends the work on the server too.
        """
        flow = flows.denoise(
            source, path_of("target", target), on_progress, timeout, silence=self._transport.timeout,
            iterations=iterations, seed=seed, strength=strength, normals=normals, format=format, name=name,
        )  # fmt: skip
        return self._transport.run(flow)

    def health(self) -> Health:
        """Ask whether the server is there, and warm."""
        return self._transport.run(flows.health())

    def info(self) -> ServerInfo:
        """Ask what the server is and takes."""
        return self._transport.run(flows.info())


class Jobs:
    """Make and find jobs."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def create(
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
    ) -> Job:
        """Hand over a cloud and return at once; the job survives this process, and the server's.

        name: of the file, where the source has none. id: 1..64 of A-Z a-z 0-9 . _ -, chosen by the server if None; the
        same request with the same id, or with the same idempotency_key, finds the job that it made before.
        """
        flow = flows.create(
            source, iterations=iterations, seed=seed, strength=strength, normals=normals, format=format,
            name=name, id=id, key=idempotency_key,
        )  # fmt: skip
        return Job(self._transport, self._transport.run(flow))

    def get(self, id: str) -> Job:
        """Find a job; raises NotFound."""
        return Job(self._transport, self._transport.run(flows.get(id)))

    def list(self, *, states: Collection[JobState] = (), page_size: int = 50) -> Iterator[Job]:
        """Yield this key's jobs, newest first, asking for a page at a time."""
        cursor: str | None = None
        while True:
            jobs, cursor = self._transport.run(flows.page(states, page_size, cursor))
            yield from (Job(self._transport, info) for info in jobs)
            if cursor is None:
                return


class Job:
    """Stand for one job on the server; `info` is what was last heard of it."""

    def __init__(self, transport: Transport, info: JobInfo) -> None:
        self._transport = transport
        self.info = info

    def __repr__(self) -> str:
        return f"<Job {self.id} {self.info.state} {self.info.progress:.0%}>"

    @property
    def id(self) -> str:
        """The job's name on the server."""
        return self.info.id

    def refresh(self) -> JobInfo:
        """Ask how it stands."""
        self.info = self._transport.run(flows.get(self.id))
        return self.info

    def wait(self, *, timeout: float | None = None, on_progress: OnProgress | None = None) -> JobInfo:
        """Return when it is finished, well or not; raises JobNotFinished after timeout seconds."""
        flow = flows.wait(self.id, timeout, on_progress, silence=self._transport.timeout)
        self.info = self._transport.run(flow)
        return self.info

    def events(self, *, after: int = 0) -> Iterator[Event]:
        """Yield what happened behind event `after` and what happens next, until `Completed`; connects again itself."""
        receiver = Events(after=after)
        for _ in self._transport.stream((events_call(self.id), receiver)):
            yield from receiver.take()

    def patches(self) -> Iterator[PatchFrame]:
        """Yield finished patches as they come: the last position of a row is its result. Raises what the job met."""
        receiver = Patches()
        for _ in self._transport.stream((patches_call(self.id), receiver)):
            yield from receiver.take()

    def result(self, target: str | Path | None = None) -> Denoised:
        """Download the result, going on where a connection broke, checked against its sha256.

        Raises JobNotFinished, JobExpired, JobCanceled, or what the job failed with.
        """
        return self._transport.run(flows.result(self.info, path_of("target", target)))

    def cancel(self) -> JobInfo:
        """End it."""
        self.info = self._transport.run(flows.cancel(self.id))
        return self.info

    def delete(self) -> None:
        """End it, and remove its files and all that is known of it."""
        self._transport.run(flows.delete(self.id))
