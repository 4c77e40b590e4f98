"""What a request line asks for, in the usual form: its path; and where a path that ends otherwise is answered."""

from __future__ import annotations

import re
from urllib.parse import unquote

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["TargetMiddleware"]

_ABSOLUTE = re.compile(rb"https?://(?:[^/@]*@)?([^/]*)", re.IGNORECASE)
_REDIRECTED = 307  # to the path with, or without, a slash at its end


class TargetMiddleware:
    """Bring a target into the usual form, and say where else a path is in a form that holds behind every proxy.

    `GET http://host/livez` (RFC 9112, 3.2.2), as a proxy is asked, is `GET /livez` of that host; `//livez` and `livez`,
    as of a proxy that takes `/straightpcf` off with a slash too few or too many, are `/livez`.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        root: str = scope["root_path"]
        target = raw = scope["raw_path"].removeprefix(root.encode())
        if absolute := _ABSOLUTE.match(target):
            scope = {**scope, "headers": [pair for pair in scope["headers"] if pair[0] != b"host"]}
            scope["headers"].append((b"host", absolute[1]))
            raw = target[absolute.end() :]
        if raw != b"*":  # of OPTIONS, the whole server
            raw = b"/" + raw.lstrip(b"/")
        if raw != target:
            scope = {**scope, "raw_path": root.encode() + raw, "path": root + unquote(raw.decode("ascii"))}

        async def send_relative(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] == _REDIRECTED:
                other = _other_end(raw.decode("ascii"), scope["query_string"].decode("ascii"))
                MutableHeaders(scope=message)["location"] = other
            await send(message)

        await self._app(scope, receive, send_relative)


def _other_end(path: str, query: str) -> str:
    """Return a path without the slashes at its end, or with one, relative to itself: a proxy may show it elsewhere."""
    bare = path.rstrip("/")
    name, slashes = bare.rpartition("/")[2], len(path) - len(bare)
    return ("../" * slashes + name if slashes else f"./{name}/") + (f"?{query}" if query else "")
