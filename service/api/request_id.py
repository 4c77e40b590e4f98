"""Give every request an id: the caller's own where it is usable, else a fresh one; on every response and error."""

from __future__ import annotations

import re
import uuid

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["HEADER", "RequestIdMiddleware", "request_id", "usable_id"]

HEADER = "X-Request-Id"
_USABLE = re.compile(r"[A-Za-z0-9._:-]{1,128}")


def request_id(request: Request) -> str:
    """Return the id of a request that came through the middleware."""
    return str(request.scope.get("request_id") or "")


def usable_id(theirs: str | None) -> str:
    """Return the caller's id of a request, or a fresh one where there is none that a log could hold."""
    return theirs if theirs and _USABLE.fullmatch(theirs) else uuid.uuid4().hex


class RequestIdMiddleware:
    """Set scope["request_id"] and the response header."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        scope["request_id"] = usable_id(Headers(scope=scope).get(HEADER))

        async def send_with_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[HEADER] = scope["request_id"]
            await send(message)

        await self._app(scope, receive, send_with_id)
