"""POST /denoise and what tells about the server: parse a request, hand it to the engine, send the file."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Depends, Request
from fastapi.responses import JSONResponse, Response
from starlette.background import BackgroundTask
from starlette.requests import ClientDisconnect

from straightpcf.points.errors import ServerBusy
from straightpcf.service.api.auth import owner_of
from straightpcf.service.api.download import open_result, report_and_file, result_response
from straightpcf.service.api.events import SSE_MEDIA_TYPE, event_stream
from straightpcf.service.api.intake import flag, take_job
from straightpcf.service.api.jobs import job_response, shown
from straightpcf.service.api.negotiate import asks_for
from straightpcf.service.api.openapi import (
    DENOISE_BODY,
    DENOISE_FORM_BODY,
    DENOISE_PARAMETERS,
    DENOISE_RESPONSES,
    MISDIRECTED,
    PATH_PARAMETER,
    problems,
)
from straightpcf.service.api.prefer import parse_prefer
from straightpcf.service.api.schemas import Health, Info
from straightpcf.service.engine import Engine
from straightpcf.service.jobs.record import JobRecord

__all__ = ["router"]

router = APIRouter()
Owner = Annotated[str, Depends(owner_of)]


@router.post(
    "/denoise",
    summary="Denoise one point cloud",
    response_class=Response,
    responses=DENOISE_RESPONSES,
    openapi_extra={"requestBody": DENOISE_FORM_BODY, "parameters": DENOISE_PARAMETERS},
)
@router.post("/denoise/{filename}", include_in_schema=False, response_class=Response)
@router.put("/denoise", include_in_schema=False, response_class=Response)
# `curl -T - URL/denoise/` appends no name, and curl takes a redirect for an answer.
@router.post("/denoise/", include_in_schema=False, response_class=Response)
@router.put("/denoise/", include_in_schema=False, response_class=Response)
@router.put(
    "/denoise/{filename}",
    summary="Denoise one point cloud (what `curl -T scan.ply URL/denoise/` sends)",
    response_class=Response,
    responses=DENOISE_RESPONSES,
    openapi_extra={"requestBody": DENOISE_BODY, "parameters": [PATH_PARAMETER, *DENOISE_PARAMETERS]},
    operation_id="denoise_put",
)
async def denoise(request: Request, owner: Owner) -> Response:
    """Take a noisy cloud and give back the same points, in the same order, on the surface.

    Send a form with the cloud in the field `file`, or the cloud itself as the body and the options in the query
    string. Every field of the file but the positions comes back unchanged. The request waits for the result; with
    `Prefer: respond-async` or after `Prefer: wait=N` (or both: then the wait comes first) it answers 202 and the job,
    and with `Accept: text/event-stream` the events of the job.
    """
    engine: Engine = request.app.state.engine
    prefer = parse_prefer(request.headers.getlist("prefer"))
    record, _, fields = await take_job(request, owner, endpoint="denoise", more_fields=frozenset({"report"}))
    if asks_for(",".join(request.headers.getlist("accept")), SSE_MEDIA_TYPE):
        at = {"Location": shown(request, record).links.self}
        return event_stream(engine, record.id, owner, root=request.scope["root_path"], headers=at)
    if prefer.respond_async and prefer.wait is None:
        return job_response(request, record, 202, prefer.applied(finished=False))
    # Nobody else knows the id of such a job: it lives as long as its request.
    private = not prefer.stated and "idempotency-key" not in request.headers
    longest = engine.limits.max_sync_seconds
    seconds = longest if prefer.wait is None else min(prefer.wait, longest)
    try:
        record = await _wait_while_connected(engine, request, record, seconds)
    except ServerBusy:  # it shuts down: the job is done at its next start
        record = await engine.get(record.id, owner=owner)
    except Exception:  # nobody listens any more, or the data directory cannot be used
        if private:
            await engine.forget(record.id, owner=owner)
        raise
    applied = prefer.applied(finished=record.finished, longest=longest)
    if not record.finished:
        return job_response(request, record, 202, applied)
    cleanup = None
    if private:
        engine.lend(record.id, owner=owner)
        cleanup = BackgroundTask(engine.forget, record.id, owner=owner)
    try:
        file, record = await open_result(engine, record.id, owner=owner)
        if flag(fields, "report"):
            answer: Response = report_and_file(file, record, after=cleanup)
        else:
            answer = result_response(request, file, record, after=cleanup)
        answer.headers.update(applied)
        return answer
    except Exception:
        if private:
            await engine.forget(record.id, owner=owner)
        raise


# Load balancers ask with HEAD.
@router.head("/healthz", include_in_schema=False)
@router.head("/livez", include_in_schema=False)
@router.get("/healthz", summary="Is the server there", responses=MISDIRECTED)
@router.get("/livez", summary="Is the server there", operation_id="livez", responses=MISDIRECTED)
async def health(request: Request) -> Health:
    """Answer as long as the process lives, however busy the workers are."""
    return Health(status="ok", ready=request.app.state.engine.ready)


@router.head("/readyz", include_in_schema=False)
@router.get(
    "/readyz", summary="Is a worker warm", response_model=Health, responses={503: {"model": Health}, **MISDIRECTED}
)
async def ready(request: Request) -> JSONResponse:
    """Answer 200 once the weights are loaded and a first cloud went through them; 503 before, once it drains, and while
    its database is gone.
    """
    engine: Engine = request.app.state.engine
    lost = "starting" if engine.in_place else "no_database"
    status = "ok" if engine.ready else "draining" if engine.draining else lost
    health = Health(status=status, ready=engine.ready)
    return JSONResponse(health.model_dump(), status_code=200 if engine.ready else 503)


@router.head("/v1/info", include_in_schema=False)
@router.get("/v1/info", summary="Version, limits, formats, devices", responses=problems(401))
async def info(request: Request, owner: Owner) -> Info:
    """Say what this server is and takes."""
    return Info.of(request.app.state.engine, weights=request.app.state.weights)


async def _wait_while_connected(engine: Engine, request: Request, record: JobRecord, seconds: float) -> JobRecord:
    """Wait for the job's end; raises ClientDisconnect when there is nobody left to send it to."""
    result = asyncio.ensure_future(engine.wait(record.id, owner=record.owner, seconds=seconds))
    gone = asyncio.ensure_future(_disconnected(request))
    try:
        await asyncio.wait([result, gone], return_when=asyncio.FIRST_COMPLETED)
        if not result.done():
            raise ClientDisconnect
        return result.result()
    finally:
        gone.cancel()
        result.cancel()


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
