"""Every error as application/problem+json (RFC 9457); the tables from code to HTTP and to gRPC status."""

from __future__ import annotations

import errno
import logging
import sqlite3
from collections.abc import Mapping
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.middleware.errors import ServerErrorMiddleware
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from straightpcf.points.errors import (
    InternalError,
    InvalidRequest,
    MethodNotAllowed,
    NotFound,
    ServerBusy,
    StraightPCFError,
)
from straightpcf.service.api.request_id import HEADER, request_id
from straightpcf.service.api.schemas import Problem

__all__ = [
    "GRPC_STATUS_BY_CODE",
    "OUT_OF_DESCRIPTORS",
    "PROBLEM_MEDIA_TYPE",
    "RETRY_AFTER_SECONDS",
    "STATUS_BY_CODE",
    "busy",
    "install_error_handlers",
    "problem_response",
]

PROBLEM_MEDIA_TYPE = "application/problem+json"
RETRY_AFTER_SECONDS = 2

STATUS_BY_CODE: Mapping[str, int] = {
    "error": 500,
    "invalid_request": 400,
    "invalid_options": 422,
    "unknown_format": 415,
    "missing_dependency": 415,  # what is missing is the reader of this media type
    "invalid_cloud": 422,
    "malformed_file": 422,
    "too_few_points": 422,
    "unsupported_cloud": 422,
    "too_large": 413,
    "too_many_points": 413,
    "too_many_bytes": 413,
    "unauthorized": 401,
    "not_found": 404,
    "method_not_allowed": 405,
    "misdirected_request": 421,
    "cross_origin": 403,
    "request_timeout": 408,
    "job_not_finished": 409,
    "job_canceled": 409,
    "id_conflict": 409,
    "job_expired": 410,
    "precondition_failed": 412,
    "range_not_satisfiable": 416,
    "idempotency_conflict": 422,
    "rate_limited": 429,
    "quota_exceeded": 429,
    "device_unavailable": 503,
    "server_busy": 503,
    "spool_full": 507,
    "internal_error": 500,
    "connection_failed": 502,
}

# The names of grpc.StatusCode: REST needs no grpcio.
GRPC_STATUS_BY_CODE: Mapping[str, str] = {
    "error": "INTERNAL",
    "invalid_request": "INVALID_ARGUMENT",
    "invalid_options": "INVALID_ARGUMENT",
    "unknown_format": "INVALID_ARGUMENT",
    "missing_dependency": "UNIMPLEMENTED",
    "invalid_cloud": "INVALID_ARGUMENT",
    "malformed_file": "INVALID_ARGUMENT",
    "too_few_points": "INVALID_ARGUMENT",
    "unsupported_cloud": "INVALID_ARGUMENT",
    "too_large": "INVALID_ARGUMENT",  # RESOURCE_EXHAUSTED would say that a later try may do
    "too_many_points": "INVALID_ARGUMENT",
    "too_many_bytes": "INVALID_ARGUMENT",
    "unauthorized": "UNAUTHENTICATED",
    "not_found": "NOT_FOUND",
    "method_not_allowed": "UNIMPLEMENTED",
    "misdirected_request": "INVALID_ARGUMENT",
    "cross_origin": "PERMISSION_DENIED",
    "request_timeout": "DEADLINE_EXCEEDED",
    "job_not_finished": "FAILED_PRECONDITION",
    "job_canceled": "ABORTED",
    "id_conflict": "ALREADY_EXISTS",
    "job_expired": "NOT_FOUND",
    "precondition_failed": "FAILED_PRECONDITION",
    "range_not_satisfiable": "OUT_OF_RANGE",
    "idempotency_conflict": "ALREADY_EXISTS",
    "rate_limited": "RESOURCE_EXHAUSTED",
    "quota_exceeded": "RESOURCE_EXHAUSTED",
    "device_unavailable": "UNAVAILABLE",
    "server_busy": "UNAVAILABLE",
    "spool_full": "RESOURCE_EXHAUSTED",
    "internal_error": "INTERNAL",
    "connection_failed": "UNAVAILABLE",
}

_KINDS: Mapping[int, type[StraightPCFError]] = {404: NotFound, 405: MethodNotAllowed}
_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")
OUT_OF_DESCRIPTORS = frozenset({errno.EMFILE, errno.ENFILE})
_UNUSABLE = frozenset(
    {errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOENT, errno.ENOTDIR, errno.EIO, errno.ESTALE, errno.ENODEV}
)
_SQLITE_UNUSABLE = frozenset(
    {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN}
)
_PRIMARY = 0xFF  # of SQLite's codes: the other bits say more

logger = logging.getLogger("uvicorn.error")


def install_error_handlers(app: FastAPI) -> None:
    """Answer every exception of an app, whoever raised it, with a problem; to be called before middleware is added."""
    app.add_exception_handler(StraightPCFError, _ours)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(RequestValidationError, _validation)
    app.add_exception_handler(ClientDisconnect, _nobody_listens)
    app.add_exception_handler(OSError, _system)
    app.add_exception_handler(sqlite3.Error, _system)
    # Not as an exception handler, whose answer passes by every middleware: a page of another origin (CORS) could not
    # read it. This one is the innermost.
    app.add_middleware(ServerErrorMiddleware, handler=_unforeseen)


async def _ours(request: Request, error: Exception) -> Response:
    assert isinstance(error, StraightPCFError)
    return problem_response(request, error, STATUS_BY_CODE[error.code])


async def _http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    path = f"{request.method} {request.url.path[:200]}"
    kind = _KINDS.get(error.status_code, InvalidRequest if error.status_code < 500 else InternalError)
    # Starlette names the methods of the first route that has the path; another route may have more.
    headers = {"Allow": ", ".join(_methods(request))} if error.status_code == 405 else error.headers
    return problem_response(request, kind(f"{error.detail}: {path}"), error.status_code, headers=headers)


def _methods(request: Request) -> list[str]:
    """Return the methods that a request's path takes."""
    routes = request.app.routes
    return [
        method
        for method in _METHODS
        if any(route.matches({**request.scope, "method": method})[0] is Match.FULL for route in routes)
    ]


async def _validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    faults = "; ".join(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors())
    return problem_response(request, InvalidRequest(faults), 422)


async def _nobody_listens(request: Request, error: Exception) -> Response:
    return Response(status_code=400)


async def _system(request: Request, error: Exception) -> Response:
    if not isinstance(error, OSError | sqlite3.Error) or (passing := busy(error)) is None:
        raise error  # to _unforeseen, and into the log
    return await _ours(request, passing)


def busy(error: OSError | sqlite3.Error) -> ServerBusy | None:
    """Return what to say of an error that passes: others let go of their files, or an operator mends the disk."""
    if isinstance(error, OSError) and error.errno in OUT_OF_DESCRIPTORS:
        told = "the server has no file descriptor left for this request"
    elif _is_unusable(error):
        told = "the server's data directory cannot be used at the moment; its log says why"
    else:
        return None
    logger.warning("a request is sent away: %s", error)
    return ServerBusy(told)


def _is_unusable(error: OSError | sqlite3.Error) -> bool:
    """Tell whether it came of a data directory that is gone or read-only, or of a file that another process locks."""
    if isinstance(error, OSError):
        return error.errno in _UNUSABLE
    return getattr(error, "sqlite_errorcode", 0) & _PRIMARY in _SQLITE_UNUSABLE


async def _unforeseen(request: Request, error: Exception) -> Response:
    # Its message may hold paths or contents: the log has it, with its traceback behind this line.
    logger.error("request %s: %s %r failed", request_id(request), request.method, request.url.path[:200])
    return problem_response(request, InternalError("the server met an error of its own"), 500)


def problem_response(
    request: Request, error: StraightPCFError, status: int, *, headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """Answer with an error; `headers` are what its status asks for beside the usual."""
    problem = Problem(
        type=f"urn:straightpcf:error:{error.code}",
        title=HTTPStatus(status).phrase,
        status=status,
        detail=error.message,
        code=error.code,
        retryable=error.retryable,
        request_id=request_id(request),
    )
    own = {HEADER: request_id(request)}
    if error.retryable:
        own["Retry-After"] = str(error.retry_after or RETRY_AFTER_SECONDS)
    if status == 408:
        own["Connection"] = "close"  # the rest of the body has no place in another request
    if status == 401:
        own["WWW-Authenticate"] = "Bearer"
    return JSONResponse(
        problem.model_dump(), status_code=status, media_type=PROBLEM_MEDIA_TYPE, headers={**(headers or {}), **own}
    )
