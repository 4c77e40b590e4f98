"""Which other pages may call this server (CORS): those of the origins that its operator names."""

from __future__ import annotations

from collections.abc import Collection

from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp

from straightpcf.points.errors import CrossOrigin
from straightpcf.service.api.errors import STATUS_BY_CODE, problem_response
from straightpcf.service.api.request_id import HEADER, usable_id

__all__ = ["CorsMiddleware"]

_FROM_OUTSIDE = "access-control-request-private-network"


class CorsMiddleware(CORSMiddleware):
    """Let pages of these origins call everything, also from another network; say to others what keeps them out."""

    def __init__(self, app: ASGIApp, *, origins: Collection[str]) -> None:
        super().__init__(app, allow_origins=origins, allow_methods=["*"], allow_headers=["*"], expose_headers=["*"])

    def preflight_response(self, request_headers: Headers) -> Response:
        """Answer what a browser asks before a page's request."""
        # Chromium of before 142 asks whether a page of the internet may call a machine at home. Old versions of
        # Starlette know nothing of it, newer ones refuse it.
        others = [pair for pair in request_headers.raw if pair[0].decode("latin-1") != _FROM_OUTSIDE]
        answer = super().preflight_response(Headers(raw=others))
        if answer.status_code < 400:
            if _FROM_OUTSIDE in request_headers:
                answer.headers["Access-Control-Allow-Private-Network"] = "true"
            return answer
        origin, method = request_headers["origin"], request_headers["access-control-request-method"]
        error = CrossOrigin(
            f"{bytes(answer.body).decode()}: a page of {origin[:80]!r} may not ask this server for {method[:20]!r}; "
            "STRAIGHTPCF_CORS_ORIGINS names those that may ask"
        )
        asked = Request({"type": "http", "request_id": usable_id(request_headers.get(HEADER))})
        vary = {"Vary": answer.headers.get("vary", "Origin")}
        return problem_response(asked, error, STATUS_BY_CODE[error.code], headers=vary)
