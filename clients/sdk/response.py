"""Read what a server answered: headers and JSON into values, problems into our errors; touches no network."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import httpx2

from straightpcf.clients.sdk.retry import Failure
from straightpcf.points.errors import (
    ERRORS_BY_CODE,
    ConnectionFailed,
    InternalError,
    InvalidRequest,
    ServerBusy,
    StraightPCFError,
    TooManyBytes,
    Unauthorized,
)

__all__ = ["Health", "ServerInfo", "failed_connection", "failed_response", "parse_health", "parse_info"]

_GATEWAY = (502, 503, 504)  # of a proxy, whose server is gone or restarted: what ours says of itself has a code
_ELSEWHERE = (404, 405, 501)  # of what knows nothing of ours: a proxy without its route, files that take no PUT
# A request that may have reached the server is sent again only because every one of ours is idempotent.
_RETRYABLE_FAULTS = (
    httpx2.NetworkError, httpx2.TimeoutException, httpx2.RemoteProtocolError, httpx2.SSEError, httpx2.DecodingError,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Health:
    """Tell whether the server is there, and whether a worker is warm."""

    status: str
    ready: bool


@dataclass(frozen=True, kw_only=True)
class ServerInfo:
    """Tell what a server is and takes; formats by name.

    max_bytes: of one request body.  max_points: of one cloud.  max_jobs, max_queued_points: jobs, and points of them
    all, that wait and run at once, over all keys.  max_iterations: of one job.
    max_sync_seconds: how long POST /denoise waits before it answers with the job instead of the result.
    result_ttl_seconds: how long a finished job's files are kept.
    """

    version: str
    model: str
    weights: str
    devices: tuple[str, ...]
    max_bytes: int
    max_points: int
    max_jobs: int
    max_queued_points: int
    max_iterations: int
    max_sync_seconds: float
    result_ttl_seconds: float
    formats: tuple[str, ...]


def parse_health(body: Mapping[str, Any]) -> Health:
    """Read GET /healthz."""
    return Health(status=body["status"], ready=body["ready"])


def parse_info(body: Mapping[str, Any]) -> ServerInfo:
    """Read GET /v1/info; what a newer server adds is left out."""
    plain = (
        "version", "model", "weights", "max_bytes", "max_points", "max_jobs", "max_queued_points", "max_iterations",
        "max_sync_seconds", "result_ttl_seconds",
    )  # fmt: skip
    return ServerInfo(
        **{name: body[name] for name in plain},
        devices=tuple(body["devices"]),
        formats=tuple(entry["name"] for entry in body["formats"]),
    )


def failed_response(response: httpx2.Response, url: object) -> Failure:
    """Turn an error response, its body read, into the error that has its code; url: of the server that was asked."""
    problem = _problem(response)
    request_id = problem.get("request_id") or response.headers.get("X-Request-Id")
    kind = ERRORS_BY_CODE.get(str(problem.get("code")), _kind_of_status(response.status_code))
    told = f"{url}: HTTP {response.status_code} {response.reason_phrase}"
    if response.is_redirect and (place := response.headers.get("Location")):
        told += f" to {place[:200]}: give the address that it ends at"
    else:
        told += ", of a proxy or another server"
    detail = str(problem.get("detail") or told) if "code" in problem else told
    return Failure(
        error=kind(detail, request_id=request_id),
        retryable=bool(problem.get("retryable", response.status_code in (429, *_GATEWAY))),
        retry_after=_seconds(response.headers),
    )


def failed_connection(fault: httpx2.TransportError | httpx2.DecodingError, url: object) -> Failure:
    """Turn what the network did into our error."""
    error = ConnectionFailed(f"{url}: {type(fault).__name__}: {fault}")
    return Failure(error=error, retryable=isinstance(fault, _RETRYABLE_FAULTS), cause=fault)


def _problem(response: httpx2.Response) -> dict[str, Any]:
    try:
        body = response.json()
    except (json.JSONDecodeError, UnicodeDecodeError):
        return {}  # a proxy in between answers in HTML
    return body if isinstance(body, dict) else {}


def _kind_of_status(status: int) -> type[StraightPCFError]:
    if status == 413:
        return TooManyBytes
    if status == 429:
        return ServerBusy
    if status in _GATEWAY + _ELSEWHERE:
        return ConnectionFailed
    if status == 401:
        return Unauthorized
    return InvalidRequest if 300 <= status < 500 else InternalError


def _seconds(headers: Mapping[str, str]) -> float | None:
    try:
        return max(0.0, float(headers.get("Retry-After", "")))
    except ValueError:
        return None  # absent, or a date: the usual backoff will do
