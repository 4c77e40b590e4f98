"""The JSON bodies of the REST API."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

__all__ = ["FormatInfo", "Health", "Info", "Problem"]


class Problem(BaseModel):
    """Say what went wrong (RFC 9457)."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    retryable: bool
    request_id: str

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "type": "urn:straightpcf:error:malformed_file",
                "title": "Unprocessable Entity",
                "status": 422,
                "detail": "the header promises 100 vertices, the file ends after 42",
                "code": "malformed_file",
                "retryable": False,
                "request_id": "8b1e6f0a5d9c4c2f9a53d8f6f3f6a2d1",
            }
        }
    )


class Health(BaseModel):
    """Say how the server is."""

    status: str
    ready: bool

    model_config = ConfigDict(json_schema_extra={"example": {"status": "ok", "ready": True}})


class FormatInfo(BaseModel):
    """Describe one file format."""

    name: str
    suffixes: list[str]
    media_type: str


class Info(BaseModel):
    """Say what this server is and takes."""

    version: str
    model: str
    weights: str
    devices: list[str]
    max_bytes: int
    max_points: int
    max_jobs: int
    max_iterations: int
    formats: list[FormatInfo]
