"""What a call of the SDK does, request by request, for the sync and the async client alike; touches no network.

A flow yields a request with what takes its answer, and is sent the value of that, or thrown its error.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Generator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from straightpcf.clients.sdk import request
from straightpcf.clients.sdk.download import Download
from straightpcf.clients.sdk.events import Progress
from straightpcf.clients.sdk.job_info import JobInfo
from straightpcf.clients.sdk.receive import Body, Events, Receiver
from straightpcf.clients.sdk.request import Call, Source
from straightpcf.clients.sdk.response import Health, ServerInfo, parse_health, parse_info
from straightpcf.clients.sdk.result import Denoised
from straightpcf.points.errors import JobNotFinished, StraightPCFError

__all__ = [
    "Flow",
    "OnProgress",
    "Step",
    "cancel",
    "create",
    "delete",
    "denoise",
    "fetch",
    "get",
    "health",
    "info",
    "page",
    "result",
    "wait",
]

POLL_SECONDS = 20.0  # at most: a server is asked this long for a job's end before it is asked again
FAREWELL_SECONDS = 5.0  # to give up a job that nobody waits for any more

_T = TypeVar("_T")
Step: TypeAlias = tuple[Call, Receiver]
Flow: TypeAlias = Generator[Step, Any, _T]
OnProgress: TypeAlias = Callable[[float], object]


def health() -> Flow[Health]:
    """Ask how the server is."""
    return (yield request.get_call("/healthz", "GetHealth"), Body(parse_health))  # type: ignore[no-any-return]


def info() -> Flow[ServerInfo]:
    """Ask what the server is."""
    return (yield request.get_call("/v1/info", "GetServerInfo"), Body(parse_info))  # type: ignore[no-any-return]


def get(id: str) -> Flow[JobInfo]:
    """Look at a job."""
    return (yield request.job_call(id), Body(JobInfo.parse))  # type: ignore[no-any-return]


def page(states: Collection[str], limit: int, cursor: str | None) -> Flow[tuple[list[JobInfo], str | None]]:
    """Return a page of jobs and the cursor of the next one."""
    body = yield request.list_call(states, limit, cursor), Body()
    return [JobInfo.parse(job) for job in body["jobs"]], body["next_cursor"] or None


def create(source: Source, **wanted: Any) -> Flow[JobInfo]:
    """Hand over a cloud; the job is safe on the server's disk when this returns."""
    return (yield request.upload_call(source, **wanted), Body(JobInfo.parse))  # type: ignore[no-any-return]


def cancel(id: str) -> Flow[JobInfo]:
    """End a job."""
    return (yield request.cancel_call(id), Body(JobInfo.parse))  # type: ignore[no-any-return]


def delete(id: str) -> Flow[None]:
    """End and forget a job."""
    yield request.delete_call(id), Body()


def wait(
    id: str, timeout: float | None, on_progress: OnProgress | None, *, silence: float | None = None
) -> Flow[JobInfo]:
    """Return the job when it is finished; raises JobNotFinished after timeout seconds.

    silence: seconds that the client bears, None for any; a healthy server answers within half of them.
    """
    if on_progress is not None and timeout is None:
        return (yield request.events_call(id), _Watched(on_progress))  # type: ignore[no-any-return]
    poll = POLL_SECONDS if silence is None else min(POLL_SECONDS, silence / 2)
    deadline = None if timeout is None else time.monotonic() + timeout
    while True:
        left = poll if deadline is None else max(0.0, min(poll, deadline - time.monotonic()))
        seconds = left if on_progress is None else min(left, 0.5)
        job: JobInfo = yield request.job_call(id, wait=seconds), Body(JobInfo.parse)
        if on_progress is not None:
            on_progress(job.progress)
        if job.finished:
            return job
        if deadline is not None and time.monotonic() >= deadline:
            raise JobNotFinished(f"job {id} is {job.state} after {timeout:g} s, {100 * job.progress:.0f} % done")


def fetch(job: JobInfo, target: Path | None, *, source: Source = None, request_id: str = "") -> Flow[Denoised]:
    """Download a result, whole and checked against its digest; raises what the job failed with, JobNotFinished."""
    if not job.finished:
        job = yield from get(job.id)
    if job.failure is not None:
        job.failure.request_id = job.failure.request_id or request_id
        raise job.failure
    if job.result is None or job.report is None:
        raise JobNotFinished(f"job {job.id} is {job.state}, {100 * job.progress:.0f} % done")
    with Download.into(target) as (download, file):
        yield request.result_call(job.id), download
        content = None if target is not None else file.getvalue()  # type: ignore[attr-defined]
    return Denoised(job=job, request_id=request_id, content=content, path=target, source=source)


def result(job: JobInfo, target: Path | None) -> Flow[Denoised]:
    """Download a result as `fetch` does; raises InvalidRequest where the target's suffix is another format's."""
    if not job.finished:
        job = yield from get(job.id)
    if target is not None and job.report is not None:
        request.check_suffix(target, job.report.format)
    return (yield from fetch(job, target))


def denoise(
    source: Source,
    target: Path | None,
    on_progress: OnProgress | None,
    timeout: float | None,
    *,
    silence: float | None,
    **wanted: Any,
) -> Flow[Denoised]:
    """Make a job, wait for it, fetch its result and remove it; whatever ends this early ends the job too."""
    call = request.upload_call(source, target, **wanted)
    id = call.path.rpartition("/")[2]
    try:
        yield call, Body(JobInfo.parse)
        job = yield from wait(id, timeout, on_progress, silence=silence)
        cloud = source if type(source).__module__.startswith("open3d") else None
        return (yield from fetch(job, target, source=cloud, request_id=call.request_id))
    finally:
        with suppress(StraightPCFError):  # it was never made, or its time runs out
            yield request.delete_call(id, timeout=FAREWELL_SECONDS), Body()


class _Watched(Events):
    """Tell the progress as it comes."""

    def __init__(self, on_progress: OnProgress) -> None:
        super().__init__()
        self._on_progress = on_progress

    def write(self, item: Any) -> None:
        super().write(item)
        for event in self.take():
            if isinstance(event, Progress):
                self._on_progress(event.progress)
            elif self.value is not None and self.value.state == "succeeded":
                self._on_progress(1.0)
