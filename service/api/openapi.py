"""What the OpenAPI document says of bodies that are streamed, and so parsed by hand."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from straightpcf.points.formats import FORMATS
from straightpcf.points.options import MAX_ITERATIONS
from straightpcf.service.api.schemas import Job, Problem

__all__ = [
    "DENOISE_BODY",
    "DENOISE_FORM_BODY",
    "DENOISE_PARAMETERS",
    "DENOISE_RESPONSES",
    "EVENTS_PARAMETERS",
    "EVENTS_RESPONSES",
    "HEAD_RESULT_RESPONSES",
    "JOB_BODY",
    "JOB_PARAMETERS",
    "JOB_RESPONSES",
    "MISDIRECTED",
    "PATH_PARAMETER",
    "PUT_JOB_RESPONSES",
    "RESULT_PARAMETERS",
    "RESULT_RESPONSES",
    "STREAM_RESPONSES",
    "complete_document",
    "problems",
]

_SHA256 = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
_FORMAT_NAMES = [format.name for format in FORMATS]

_OPTIONS: dict[str, dict[str, Any]] = {
    "iterations": {
        "description": "Passes of the filter; auto decides from the cloud itself.",
        "default": "auto",
        "oneOf": [
            {"type": "string", "enum": ["auto"]},
            {"type": "integer", "minimum": 1, "maximum": MAX_ITERATIONS},
        ],
    },
    "seed": {
        "description": "The same seed gives the same bytes.",
        "type": "integer",
        "default": 0,
        "minimum": 0,
        "maximum": 2**32 - 1,
    },
    "strength": {
        "description": "The share of the displacement that is applied.",
        "type": "number",
        "default": 1.0,
        "minimum": 0,
        "maximum": 1,
    },
    "normals": {
        "description": "Keep the file's normals, or recompute them at the new positions (PLY, PCD, E57).",
        "type": "string",
        "default": "keep",
        "enum": ["keep", "recompute"],
    },
    "format": {
        "description": "The format of the result; by default that of the input.",
        "type": "string",
        "enum": _FORMAT_NAMES,
    },
    "filename": {
        "description": "The name of the file, where the body has none: its suffix helps to recognise the format.",
        "type": "string",
        "example": "scan.ply",
    },
}

_QUERY: list[dict[str, Any]] = [
    {
        "name": name,
        "in": "query",
        "required": False,
        "description": schema["description"],
        "schema": {key: value for key, value in schema.items() if key != "description"},
    }
    for name, schema in _OPTIONS.items()
]

_REPORT: dict[str, Any] = {
    "description": "Send multipart/mixed: the report as JSON, then the cloud.",
    "type": "boolean",
    "default": False,
}


def _header(name: str, description: str, example: str) -> dict[str, Any]:
    return {
        "name": name,
        "in": "header",
        "required": False,
        "description": description,
        "schema": {"type": "string"},
        "example": example,
    }


_IDEMPOTENCY_KEY = _header(
    "Idempotency-Key", "The same key with the same request stands for the same job.", "b9f7a0c2-scan-17"
)
_PREFER = _header("Prefer", "`respond-async`, `wait=N` (seconds) or both (RFC 7240).", "wait=30")

JOB_PARAMETERS: list[dict[str, Any]] = [*_QUERY, _IDEMPOTENCY_KEY]

DENOISE_PARAMETERS: list[dict[str, Any]] = [
    *_QUERY,
    {"name": "report", "in": "query", "required": False, "schema": _REPORT},
    _IDEMPOTENCY_KEY,
    _PREFER,
]

EVENTS_PARAMETERS = [_header("Last-Event-ID", "Go on behind this event.", "17")]

RESULT_PARAMETERS = [
    _header("Range", "Send these bytes alone; what is malformed is ignored.", "bytes=0-65535"),
    _header("If-Range", "Heed Range only while this is the result's ETag.", f'"{_SHA256}"'),
    _header("If-Match", "Answer 412 unless one of these is the result's ETag.", f'"{_SHA256}"'),
    _header("If-None-Match", "Answer 304 where one of these is the result's ETag.", f'"{_SHA256}"'),
]

PATH_PARAMETER: dict[str, Any] = {
    "name": "filename",
    "in": "path",
    "required": True,
    "description": "The name of the file, as `curl -T` appends it.",
    "schema": {"type": "string"},
    "example": "scan.ply",
}

_RAW: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}

DENOISE_BODY: dict[str, Any] = {
    "required": True,
    "description": "The cloud itself, in any format of /v1/info.",
    "content": {"application/octet-stream": _RAW},
}


def _form_body(fields: dict[str, dict[str, Any]]) -> dict[str, Any]:
    return {
        "required": True,
        "description": "A form with the cloud in `file`, or the cloud itself.",
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {"file": {"type": "string", "format": "binary"}, **fields},
                },
                "example": {"file": "@scan.ply", "iterations": "auto", "seed": 0, "strength": 1.0, "format": "ply"},
            },
            "application/octet-stream": _RAW,
        },
    }


JOB_BODY = _form_body(_OPTIONS)
DENOISE_FORM_BODY = _form_body({**_OPTIONS, "report": _REPORT})

_HEADERS = {
    "X-Request-Id": ("The id of this request, also in every problem.", "string", "8b1e6f0a5d9c4c2f9a53d8f6f3f6a2d1"),
    "X-Job-Id": ("The job that made it.", "string", "c53b6bb26ca24d55af66ff11d0fa5dea"),
    "X-Points": ("Points in, and points out.", "integer", 10000),
    "X-Iterations": ("Passes of the filter.", "integer", 2),
    "X-Noise-Before": ("Estimated noise of the input, in the cloud's unit; nan if unknown.", "string", "0.0123"),
    "X-Noise-After": ("Estimated noise of the result.", "string", "0.0021"),
    "X-Untouched": ("Points passed through: not finite, no data, too far out or apart from all others.", "integer", 0),
    "Content-Disposition": ("The name of the result.", "string", 'attachment; filename="scan_clean.ply"'),
    "ETag": ("The sha256 of the result in hex.", "string", f'"{_SHA256}"'),
    "Repr-Digest": ("The same as RFC 9530 has it.", "string", "sha-256=:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=:"),
    "Cache-Control": ("Ask before it is used again.", "string", "private, no-cache"),
    "Content-Range": ("Which part it is; of 416: how large the result is.", "string", "bytes 0-65535/240128"),
    "Location": ("Where the job is.", "string", "/jobs/c53b6bb26ca24d55af66ff11d0fa5dea"),
    "Preference-Applied": ("What of `Prefer` was heeded, if anything.", "string", "respond-async"),
    "Retry-After": ("After how many seconds to try again, where that may help.", "integer", 2),
    "WWW-Authenticate": ("How to say the key.", "string", "Bearer"),
}
_OF_FILE = ("X-Request-Id", "X-Job-Id", "X-Points", "X-Iterations", "X-Noise-Before", "X-Noise-After", "X-Untouched")
_OF_RESULT = (*_OF_FILE, "Content-Disposition", "ETag", "Repr-Digest", "Cache-Control")
_OF_PROBLEM = {401: ("WWW-Authenticate",), 416: ("Content-Range",)} | {
    status: ("Retry-After",) for status in (408, 429, 503, 507)
}
_TEXT: dict[str, Any] = {"schema": {"type": "string"}}
_FILE_CONTENT = {format.media_type: _RAW for format in FORMATS}


def _headers(*names: str) -> dict[str, Any]:
    return {
        name: {"description": description, "schema": {"type": kind}, "example": example}
        for name, (description, kind, example) in _HEADERS.items()
        if name in names
    }


_FILE: dict[str, Any] = {"content": _FILE_CONTENT, "headers": _headers(*_OF_RESULT)}


def _problem(status: int) -> dict[str, Any]:
    return {
        "description": _PROBLEMS[status],
        "content": {"application/problem+json": {"schema": {"$ref": f"#/components/schemas/{Problem.__name__}"}}},
        "headers": _headers("X-Request-Id", *_OF_PROBLEM.get(status, ())),
    }


_PROBLEMS = {
    400: "The request itself is broken (`invalid_request`).",
    401: "No API key, or an unknown one (`unauthorized`).",
    403: "This server has no keys and does nothing for pages of that origin (`cross_origin`).",
    404: "There is no such job, or not for this key (`not_found`).",
    408: "The body stopped coming (`request_timeout`).",
    409: "It is not finished, was canceled, or its id is taken (`job_not_finished`, `job_canceled`, `id_conflict`).",
    410: "Its files have been removed (`job_expired`).",
    412: "If-Match names another result, or a job, which has no ETag (`precondition_failed`).",
    413: "Over a limit of /v1/info (`too_many_bytes`, `too_many_points`, `too_large`).",
    415: "No format recognises the file (`unknown_format`, `missing_dependency`).",
    416: "No byte of the result is in the range (`range_not_satisfiable`).",
    421: "This server has no keys and does not answer for that host (`misdirected_request`).",
    422: "A parameter, an option, a key or the cloud is unusable (`invalid_request`, `invalid_options`, "
    "`malformed_file`, `too_few_points`, `invalid_cloud`, `unsupported_cloud`, `idempotency_conflict`).",
    429: "This key has too many requests or jobs (`rate_limited`, `quota_exceeded`); see Retry-After.",
    500: "A fault of the server (`internal_error`).",
    503: "Try again after Retry-After (`server_busy`), or no device (`device_unavailable`).",
    507: "The server's disk is full (`spool_full`).",
}


MISDIRECTED: dict[int | str, dict[str, Any]] = {421: _problem(421)}  # of what asks for no key
_ANYWHERE = (421, 422, 429, 500, 503)


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Describe problems by status."""
    return {status: _problem(status) for status in sorted({*statuses, *_ANYWHERE})}


def complete_document(app: FastAPI) -> None:
    """Put into the app's OpenAPI document the schema of problems, and what a job has that is null in its example."""
    plain = app.openapi

    def openapi() -> dict[str, Any]:
        document = plain()
        schemas = document["components"]["schemas"]
        schemas[Problem.__name__] = Problem.model_json_schema()
        schemas[Job.__name__]["example"] = Job.model_json_schema()["example"]  # FastAPI leaves out every null
        return document

    app.openapi = openapi  # type: ignore[method-assign]


_INTAKE = (400, 401, 403, 408, 413, 415, 507)
_JOB: dict[str, Any] = {"application/json": {"schema": {"$ref": "#/components/schemas/Job"}}}
_LOCATION = _headers("Location")


DENOISE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The cloud, in the requested format; with `report` the report before it; or the job's events.",
        "content": {**_FILE_CONTENT, "multipart/mixed": _RAW, "text/event-stream": _TEXT},
        "headers": _headers(*_OF_RESULT, "Location", "Preference-Applied"),
    },
    202: {
        "description": "The job, if it was preferred so, took longer than this server lets a request wait, or it ends.",
        "content": _JOB,
        "headers": _headers("Location", "Preference-Applied"),
    },
    **problems(*_INTAKE, 404, 409, 410),
}

JOB_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"description": "The same request made it before.", "content": _JOB, "headers": _LOCATION},
    202: {"description": "It waits for a worker.", "headers": _LOCATION},
    **problems(*_INTAKE),
}
PUT_JOB_RESPONSES = {**JOB_RESPONSES, **problems(404, 409)}

RESULT_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"description": "The cloud.", **_FILE},
    206: {
        "description": "The part that was asked for, or several.",
        "content": {**_FILE_CONTENT, "multipart/byteranges": _RAW},
        "headers": _headers(*_OF_RESULT, "Content-Range"),
    },
    304: {"description": "What If-None-Match names is still the result.", "headers": _headers("ETag", "Cache-Control")},
    **problems(401, 404, 409, 410, 412, 413, 415, 416, 507),
}
HEAD_RESULT_RESPONSES = {status: said for status, said in RESULT_RESPONSES.items() if status not in (206, 416)}

EVENTS_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Events `queued start progress preview output log completed`; docs/api.md says what is in each.",
        "content": {"text/event-stream": _TEXT},
    },
    204: {"description": "It is finished, and nothing happened behind `Last-Event-ID`."},
    **problems(400, 401, 404),
}

STREAM_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Finished patches, framed as in docs/api.md.",
        "content": {
            "application/vnd.straightpcf.patches": _RAW,
            "application/x-ndjson": _TEXT,
        },
    },
    **problems(400, 401, 404, 409, 410, 413, 415, 507),
}
