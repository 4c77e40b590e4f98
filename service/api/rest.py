"""The REST API: parse a request, hand it to the engine, send the file."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import FileResponse, JSONResponse
from starlette.requests import ClientDisconnect
from starlette.types import Receive, Scope, Send

import straightpcf
from straightpcf.points.errors import InvalidOptions
from straightpcf.points.formats import FORMATS, format_named
from straightpcf.points.options import MAX_ITERATIONS, DenoiseOptions
from straightpcf.service.api.body import check_declared_size, receive_upload
from straightpcf.service.api.openapi import (
    DENOISE_BODY,
    DENOISE_FORM_BODY,
    DENOISE_RESPONSES,
    PATH_PARAMETER,
    QUERY_PARAMETERS,
)
from straightpcf.service.api.schemas import FormatInfo, Health, Info
from straightpcf.service.backends.base import FileReport
from straightpcf.service.engine import Engine, Job

__all__ = ["router"]

OPTION_FIELDS = frozenset({"iterations", "seed", "strength"})
KNOWN_FIELDS = OPTION_FIELDS | {"format", "filename"}
MAX_NAME_LENGTH = 120

router = APIRouter()


@router.post(
    "/denoise",
    summary="Denoise one point cloud",
    response_class=FileResponse,
    responses=DENOISE_RESPONSES,
    openapi_extra={"requestBody": DENOISE_FORM_BODY, "parameters": QUERY_PARAMETERS},
)
@router.post("/denoise/{filename}", include_in_schema=False, response_class=FileResponse)
@router.put("/denoise", include_in_schema=False, response_class=FileResponse)
@router.put(
    "/denoise/{filename}",
    summary="Denoise one point cloud (what `curl -T scan.ply URL/denoise/` sends)",
    response_class=FileResponse,
    responses=DENOISE_RESPONSES,
    openapi_extra={"requestBody": DENOISE_BODY, "parameters": [PATH_PARAMETER, *QUERY_PARAMETERS]},
    operation_id="denoise_put",
)
async def denoise(request: Request) -> FileResponse:
    """Take a noisy cloud and give back the same points, in the same order, on the surface.

    Send a form with the cloud in the field `file`, or the cloud itself as the body and the options in the query
    string. Every field of the file but the positions comes back unchanged.
    """
    engine: Engine = request.app.state.engine
    engine.check_room()
    check_declared_size(request, engine.limits)
    _parse_fields(request.query_params)
    with ExitStack() as cleanup:
        folder = cleanup.enter_context(request.app.state.spool.folder())
        source, target = folder / "input", folder / "output"
        upload = await receive_upload(request, source, limits=engine.limits)
        fields = {**request.query_params, **upload.fields}
        options, format = _parse_fields(fields)
        name = _file_name(fields.get("filename") or request.path_params.get("filename") or upload.name)
        job = engine.submit(source, target, options=options, name=name, format=format)
        report = await _result_while_connected(job, request)
        return _SpooledFileResponse(
            target,
            cleanup=cleanup.pop_all(),
            filename=_result_name(name, report.format),
            media_type=format_named(report.format).media_type,
            headers=_report_headers(report),
        )


@router.get("/healthz", summary="Is the server there")
@router.get("/livez", include_in_schema=False)
async def health(request: Request) -> Health:
    """Answer as long as the process lives, however busy the workers are."""
    return Health(status="ok", ready=request.app.state.engine.ready)


@router.get("/readyz", summary="Is a worker warm", responses={503: {"model": Health}})
async def ready(request: Request) -> JSONResponse:
    """Answer 200 once the weights are loaded and a first cloud went through them, 503 before."""
    is_ready = request.app.state.engine.ready
    health = Health(status="ok" if is_ready else "starting", ready=is_ready)
    return JSONResponse(health.model_dump(), status_code=200 if is_ready else 503)


@router.get("/v1/info", summary="Version, limits, formats, devices")
async def info(request: Request) -> Info:
    """Say what this server is and takes."""
    engine: Engine = request.app.state.engine
    return Info(
        version=straightpcf.__version__,
        model="StraightPCF",
        weights=request.app.state.weights,
        devices=list(engine.backend.devices),
        max_bytes=engine.limits.max_bytes,
        max_points=engine.limits.max_points,
        max_jobs=engine.limits.max_jobs,
        max_iterations=MAX_ITERATIONS,
        formats=[
            FormatInfo(name=format.name, suffixes=list(format.suffixes), media_type=format.media_type)
            for format in FORMATS
        ],
    )


class _SpooledFileResponse(FileResponse):
    """Send a file and let go of its folder, also if the client breaks off."""

    def __init__(self, path: Any, *, cleanup: ExitStack, **options: Any) -> None:
        super().__init__(path, **options)
        self._cleanup = cleanup

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._cleanup:
            await super().__call__(scope, receive, send)


async def _result_while_connected(job: Job, request: Request) -> FileReport:
    """Wait for the job; a client that goes away cancels it, and so does a server that shuts down."""
    result = asyncio.ensure_future(job.result())
    gone = asyncio.ensure_future(_disconnected(request))
    try:
        await asyncio.wait([result, gone], return_when=asyncio.FIRST_COMPLETED)
        if not result.done():
            raise ClientDisconnect
        return result.result()
    finally:
        gone.cancel()
        result.cancel()
        await job.cancel()  # before the folder goes; nothing to do for a job that has ended


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _parse_fields(fields: Mapping[str, str]) -> tuple[DenoiseOptions, str | None]:
    if unknown := set(fields) - KNOWN_FIELDS:
        raise InvalidOptions(f"{min(unknown)[:40]!r} is no option; known: {', '.join(sorted(KNOWN_FIELDS))}")
    options = DenoiseOptions.parse(**{name: fields[name] for name in OPTION_FIELDS & set(fields)})
    if format := fields.get("format"):
        format_named(format)
    return options, format or None


def _file_name(name: str | None) -> str | None:
    """Keep the last part of what the client calls the file; it names a format and a download, never a path here."""
    if name is None:
        return None
    last = PurePosixPath(PureWindowsPath(name).name).name
    return "".join(char for char in last if char.isprintable())[-MAX_NAME_LENGTH:] or None


def _result_name(name: str | None, format: str) -> str:
    stem = PurePosixPath(name).stem if name else "cloud"
    suffixes = format_named(format).suffixes
    own = PurePosixPath(name).suffix.lower() if name else ""
    return f"{stem}_clean{own if own in suffixes else suffixes[0]}"


def _report_headers(report: FileReport) -> dict[str, str]:
    def number(value: float) -> str:
        return repr(value) if math.isfinite(value) else "nan"

    return {
        "X-Points": str(report.points),
        "X-Iterations": str(report.iterations),
        "X-Noise-Before": number(report.noise_before),
        "X-Noise-After": number(report.noise_after),
        "X-Untouched": str(report.untouched),
    }
