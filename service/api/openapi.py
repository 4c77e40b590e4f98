"""What the OpenAPI document says of bodies that are streamed, and so parsed by hand."""

from __future__ import annotations

from typing import Any

from straightpcf.points.formats import FORMATS
from straightpcf.points.options import MAX_ITERATIONS
from straightpcf.service.api.schemas import Problem

__all__ = ["DENOISE_BODY", "DENOISE_FORM_BODY", "DENOISE_RESPONSES", "PATH_PARAMETER", "QUERY_PARAMETERS"]

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

QUERY_PARAMETERS: list[dict[str, Any]] = [
    {
        "name": name,
        "in": "query",
        "required": False,
        "description": schema["description"],
        "schema": {key: value for key, value in schema.items() if key != "description"},
    }
    for name, schema in _OPTIONS.items()
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

DENOISE_FORM_BODY: dict[str, Any] = {
    "required": True,
    "description": "A form with the cloud in `file`, or the cloud itself.",
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["file"],
                "properties": {"file": {"type": "string", "format": "binary"}, **_OPTIONS},
            },
            "example": {"file": "@scan.ply", "iterations": "auto", "seed": 0, "strength": 1.0, "format": "ply"},
        },
        "application/octet-stream": _RAW,
    },
}

_RESULT_HEADERS = {
    "X-Request-Id": ("The id of this request, also in every problem.", "string", "8b1e6f0a5d9c4c2f9a53d8f6f3f6a2d1"),
    "X-Points": ("Points in, and points out.", "integer", 10000),
    "X-Iterations": ("Passes of the filter.", "integer", 2),
    "X-Noise-Before": ("Estimated noise of the input, in the cloud's unit; nan if unknown.", "string", "0.0123"),
    "X-Noise-After": ("Estimated noise of the result.", "string", "0.0021"),
    "X-Untouched": ("Points that were NaN or infinite, and passed through.", "integer", 0),
    "Content-Disposition": ("The name of the result.", "string", 'attachment; filename="scan_clean.ply"'),
}


def _problem(description: str) -> dict[str, Any]:
    return {
        "description": description,
        "content": {"application/problem+json": {"schema": {"$ref": f"#/components/schemas/{Problem.__name__}"}}},
    }


DENOISE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The cloud, in the requested format.",
        "content": {"application/octet-stream": _RAW},
        "headers": {
            name: {"description": description, "schema": {"type": kind}, "example": example}
            for name, (description, kind, example) in _RESULT_HEADERS.items()
        },
    },
    400: _problem("The request itself is broken (`invalid_request`)."),
    413: _problem("Over a limit of /v1/info (`too_many_bytes`, `too_many_points`, `too_large`)."),
    415: _problem("No format recognises the file (`unknown_format`, `missing_dependency`)."),
    422: _problem(
        "An option or the cloud is unusable "
        "(`invalid_options`, `malformed_file`, `too_few_points`, `invalid_cloud`, `unsupported_cloud`)."
    ),
    500: {"model": Problem, **_problem("A fault of the server (`internal_error`).")},
    503: _problem("Try again after Retry-After (`server_busy`), or no device (`device_unavailable`)."),
}
