"""What a request line asks for: `GET http://host/livez`, as a proxy is asked, is `GET /livez` of that host."""

from __future__ import annotations

import re
from urllib.parse import unquote

from starlette.types import ASGIApp, Receive, Scope, Send

__all__ = ["TargetMiddleware"]

_ABSOLUTE = re.compile(rb"https?://(?:[^/@]*@)?([^/]*)", re.IGNORECASE)


class TargetMiddleware:
    """Bring an absolute target (RFC 9112, 3.2.2) into the usual form: its path, and its host instead of `Host`."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on."""
        if scope["type"] == "http":
            root: str = scope["root_path"]
            target = scope["raw_path"].removeprefix(root.encode())
            if absolute := _ABSOLUTE.match(target):
                scope = {**scope, "headers": [pair for pair in scope["headers"] if pair[0] != b"host"]}
                scope["headers"].append((b"host", absolute[1]))
                raw = target[absolute.end() :] or b"/"
                scope["raw_path"], scope["path"] = root.encode() + raw, root + unquote(raw.decode("ascii"))
        await self._app(scope, receive, send)
