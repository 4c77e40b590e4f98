"""What a call of the SDK does, request by request, for the sync and the async client alike; touches no network.

A flow yields a request with what takes its answer, and is sent the value of that, or thrown its error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from straightpcf.clients.sdk import request
from straightpcf.clients.sdk.arguments import check_function, seconds_of
from straightpcf.clients.sdk.download import Download
from straightpcf.clients.sdk.events import Progress
from straightpcf.clients.sdk.job_info import JobInfo
from straightpcf.clients.sdk.receive import Body, Events, Receiver
from straightpcf.clients.sdk.request import Call, Source
from straightpcf.clients.sdk.response import Health, ServerInfo, parse_health, parse_info
from straightpcf.clients.sdk.result import Denoised
from straightpcf.points.errors import ConnectionFailed, JobNotFinished, StraightPCFError

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
_LATE_SECONDS = 2.0  # after a deadline, for an answer that says how the job stands
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
    return (yield request.list_call(states, limit, cursor), Body(_page))  # type: ignore[no-any-return]


def _page(body: Mapping[str, Any]) -> tuple[list[JobInfo], str | None]:
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
    id: str,
    timeout: float | None,
    on_progress: OnProgress | None,
    *,
    silence: float | None = None,
    deadline: float | None = None,
) -> Flow[JobInfo]:
    """Return the job when it is finished; raises JobNotFinished after timeout seconds, also of a server that hangs.

    silence: seconds that the client bears, None for any; a healthy server answers within half of them. deadline: when
    the timeout is over, where it began before; on the monotonic clock.
    """
    check_function("on_progress", on_progress)
    if on_progress is not None and timeout is None:
        told: JobInfo | None = yield request.events_call(id), _Watched(on_progress)
        if told is not None:
            return told  # else it was deleted and made anew meanwhile, and has had no more events than that one
    poll = POLL_SECONDS if silence is None else min(POLL_SECONDS, silence / 2)
    deadline = deadline or _after(timeout)
    while True:
        left = max(0.0, min(poll, deadline - time.monotonic()))
        seconds = left if on_progress is None else min(left, 0.5)
        with _timely(id, timeout, deadline):
            job: JobInfo = yield (
                request.job_call(id, wait=seconds, until=deadline + _LATE_SECONDS), Body(JobInfo.parse)
            )  # fmt: skip
        if on_progress is not None:
            on_progress(job.progress)
        if job.finished:
            return job
        if time.monotonic() >= deadline:
            raise JobNotFinished(f"job {id} is {job.state} after {timeout:g} s, {100 * job.progress:.0f} % done")


def _after(timeout: float | None) -> float:
    seconds = seconds_of("timeout", timeout)
    return math.inf if seconds is None else time.monotonic() + seconds


@contextmanager
def _timely(id: str, timeout: float | None, deadline: float) -> Iterator[None]:
    """Take a server that is not to be had when the time is over for a job that is not finished."""
    try:
        yield
    except ConnectionFailed as error:
        if time.monotonic() < deadline:
            raise
        raise JobNotFinished(f"job {id} is not known to be finished after {timeout:g} s: {error.message}") from error


def fetch(job: JobInfo, target: Path | None, *, source: Source = None, request_id: str = "") -> Flow[Denoised]:
    """Download a result, whole and checked against its digest; raises what the job failed with, JobNotFinished."""
    if not job.finished:
        job = yield from get(job.id)
    if job.failure is not None:
        job.failure.request_id = job.failure.request_id or request_id
        raise job.failure
    if job.result is None or job.report is None:
        raise JobNotFinished(f"job {job.id} is {job.state}, {100 * job.progress:.0f} % done")
    with Download.into(target, job.result) as (download, file):
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
    check_function("on_progress", on_progress)
    deadline = _after(timeout)
    call = request.upload_call(source, target, until=deadline + _LATE_SECONDS, **wanted)
    id = call.path.rpartition("/")[2]
    try:
        with _timely(id, timeout, deadline):
            yield call, Body(JobInfo.parse)
        job = yield from wait(id, timeout, on_progress, silence=silence, deadline=deadline)
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
