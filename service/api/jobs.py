"""The job routes: create, look, follow, cancel, fetch, delete."""

from __future__ import annotations

from contextlib import aclosing
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import JSONResponse, Response

from straightpcf.points.errors import InvalidRequest, PreconditionFailed
from straightpcf.points.wire.jobs import MAX_PAGE_SIZE
from straightpcf.points.wire.patches import PATCHES_MEDIA_TYPE
from straightpcf.service.api.auth import owner_of, owner_who_gives_back
from straightpcf.service.api.download import open_result, result_response
from straightpcf.service.api.events import NDJSON_MEDIA_TYPE, event_stream, last_event_id, patch_stream
from straightpcf.service.api.intake import Coming, take_job
from straightpcf.service.api.negotiate import asks_for
from straightpcf.service.api.openapi import (
    EVENTS_PARAMETERS,
    EVENTS_RESPONSES,
    HEAD_RESULT_RESPONSES,
    JOB_BODY,
    JOB_PARAMETERS,
    JOB_RESPONSES,
    PUT_JOB_RESPONSES,
    RESULT_PARAMETERS,
    RESULT_RESPONSES,
    STREAM_RESPONSES,
    problems,
)
from straightpcf.service.api.schemas import MAX_WAIT_SECONDS, Decimal, Job, JobPage, Report
from straightpcf.service.engine import Engine
from straightpcf.service.jobs.record import JobRecord, JobState

__all__ = ["job_response", "router", "shown"]

router = APIRouter(tags=["jobs"])
Owner = Annotated[str, Depends(owner_of)]
OwnerWhoGivesBack = Annotated[str, Depends(owner_who_gives_back)]


def shown(request: Request, record: JobRecord) -> Job:
    """Render a job, its links as who asks finds them."""
    return Job.of(record, root=request.scope["root_path"])


def job_response(
    request: Request, record: JobRecord, status: int, headers: dict[str, str] | None = None
) -> JSONResponse:
    """Show a job, with the place where it is."""
    job = shown(request, record)
    return JSONResponse(job.plain(), status_code=status, headers={"Location": job.links.self, **(headers or {})})


@router.post("/jobs/", include_in_schema=False, response_class=Response)  # curl takes a redirect for an answer
@router.post(
    "/jobs", status_code=202, response_model=Job, responses=JOB_RESPONSES, summary="Make a job",
    openapi_extra={"requestBody": JOB_BODY, "parameters": JOB_PARAMETERS},
)  # fmt: skip
async def create_job(request: Request, owner: Owner) -> Response:
    """Take a cloud and answer at once; the job is on the disk by then."""
    record, created, _ = await take_job(request, owner, endpoint="jobs")
    return job_response(request, record, 202 if created else 200)


@router.put(
    "/jobs/{id}", status_code=202, response_model=Job, responses=PUT_JOB_RESPONSES,
    summary="Make a job with a chosen id", openapi_extra={"requestBody": JOB_BODY, "parameters": JOB_PARAMETERS},
)  # fmt: skip
async def put_job(id: str, request: Request, owner: Owner) -> Response:
    """Make a job once, however often the same request comes."""
    record, created, _ = await take_job(request, owner, endpoint="jobs", id=id)
    return job_response(request, record, 202 if created else 200)


@router.head("/jobs", include_in_schema=False)
@router.head("/jobs/", include_in_schema=False)
@router.get("/jobs/", include_in_schema=False)
@router.get("/jobs", response_model=JobPage, responses=problems(400, 401), summary="List jobs")
async def list_jobs(
    request: Request,
    owner: Owner,
    state: Annotated[list[JobState] | None, Query(description="Only these; may be repeated.")] = None,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE), Decimal] = 50,
    cursor: Annotated[str | None, Query(description="The next_cursor of the page before.")] = None,
) -> JobPage:
    """Show this key's jobs, newest first."""
    engine: Engine = request.app.state.engine
    records, next_cursor = await engine.list(owner=owner, states=state or (), limit=limit, cursor=cursor)
    return JobPage(jobs=[shown(request, record) for record in records], next_cursor=next_cursor)


@router.head("/jobs/{id}", include_in_schema=False)
@router.get("/jobs/{id}", response_model=Job, responses=problems(401, 404), summary="Look at a job")
async def get_job(
    id: str,
    request: Request,
    owner: Owner,
    wait: Annotated[float, Query(ge=0, le=MAX_WAIT_SECONDS, description="Seconds to wait for its end."), Decimal] = 0,
) -> Job:
    """Show a job, as soon as it is finished or the wait is over."""
    engine: Engine = request.app.state.engine
    return shown(request, await engine.wait(id, owner=owner, seconds=wait))


@router.get(
    "/jobs/{id}/events", response_class=Response, responses=EVENTS_RESPONSES, summary="Follow a job",
    openapi_extra={"parameters": EVENTS_PARAMETERS},
)  # fmt: skip
async def job_events(
    id: str,
    request: Request,
    owner: Owner,
    after: Annotated[str | None, Query(description="As Last-Event-ID, for those who cannot set headers.")] = None,
) -> Response:
    """Send what happened so far and what happens next as server-sent events; `Last-Event-ID` goes on behind one."""
    engine: Engine = request.app.state.engine
    record = await engine.get(id, owner=owner)
    from_id = last_event_id(request.headers.get("last-event-id"), after)
    if record.finished:
        async with aclosing(engine.events(id, owner=owner, after=from_id)) as events:
            if await anext(events, None) is None:
                return Response(status_code=204)  # which ends an EventSource; it connects again after anything else
    return event_stream(engine, id, owner, root=request.scope["root_path"], after=from_id)


@router.post(
    "/jobs/{id}/cancel", status_code=202, response_model=Job, summary="Cancel a job",
    responses={200: {"model": Job, "description": "It was finished before."}, **problems(401, 403, 404, 507)},
)  # fmt: skip
async def cancel_job(id: str, request: Request, owner: OwnerWhoGivesBack) -> Response:
    """Cancel a job that waits or runs; its worker is free within a second."""
    engine: Engine = request.app.state.engine
    before = await engine.get(id, owner=owner)
    after = await engine.cancel(id, owner=owner)
    return job_response(request, after, 200 if before.finished else 202)


@router.delete("/jobs/{id}", status_code=204, responses=problems(401, 403, 404, 412, 507), summary="Delete a job")
async def delete_job(id: str, request: Request, owner: OwnerWhoGivesBack) -> None:
    """Remove a job, its files and its events, whatever its state; also one whose file is still on its way."""
    wanted = ",".join(request.headers.getlist("if-match") or ["*"])
    if "*" not in [tag.strip() for tag in wanted.split(",")]:  # RFC 9110, 13.1.1: then it must not be done
        raise PreconditionFailed(f"a job has no ETag, so that If-Match cannot name it by {wanted[:80]!r}; it is kept")
    coming: Coming = request.app.state.coming
    await coming.delete(owner, id)


async def _result(id: str, request: Request, owner: Owner) -> Response:
    """Send the result; `Range`, `If-Range`, `If-Match` and `If-None-Match` are understood."""
    engine: Engine = request.app.state.engine
    file, record = await open_result(engine, id, owner=owner)
    return result_response(request, file, record)


_RESULT: dict[str, Any] = {
    "response_class": Response, "openapi_extra": {"parameters": RESULT_PARAMETERS},
}  # fmt: skip
router.get(
    "/jobs/{id}/result", summary="Fetch the result", operation_id="get_result", responses=RESULT_RESPONSES, **_RESULT
)(_result)
router.head(
    "/jobs/{id}/result", summary="Ask about the result", operation_id="head_result", responses=HEAD_RESULT_RESPONSES,
    **_RESULT,
)(_result)  # fmt: skip


@router.head("/jobs/{id}/report", include_in_schema=False)
@router.get(
    "/jobs/{id}/report", response_model=Report, summary="The report",
    responses=problems(401, 404, 409, 410, 413, 415, 507),
)  # fmt: skip
async def job_report(id: str, request: Request, owner: Owner) -> Report:
    """Show displacement, noise before and after, passes, timings and warnings."""
    engine: Engine = request.app.state.engine
    _, record = await engine.result(id, owner=owner)
    return Report.model_validate(record.report)


@router.get("/jobs/{id}/stream", response_class=Response, responses=STREAM_RESPONSES, summary="Patches as they finish")
async def job_stream(id: str, request: Request, owner: Owner) -> Response:
    """Send finished patches: framed bytes, or lines of JSON with `Accept: application/x-ndjson` (docs/api.md)."""
    engine: Engine = request.app.state.engine
    record = await engine.get(id, owner=owner)
    if record.state == "expired":
        await engine.result(id, owner=owner)  # raises what is to be said
    if record.error is not None:
        raise record.error
    accept = ",".join(request.headers.getlist("accept"))
    if len(accept) > 1000:
        raise InvalidRequest(f"Accept has {len(accept)} characters")
    as_json = asks_for(accept, NDJSON_MEDIA_TYPE, over=PATCHES_MEDIA_TYPE)
    return patch_stream(engine, id, owner, as_json=as_json)
