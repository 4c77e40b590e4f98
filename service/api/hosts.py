"""For whom a request is meant, and whose page sends it: a server without keys, on loopback, is for its own alone."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from straightpcf.points.errors import CrossOrigin, MisdirectedRequest, StraightPCFError
from straightpcf.service.api.errors import STATUS_BY_CODE, problem_response

__all__ = ["HostMiddleware", "is_loopback"]

_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})  # RFC 9110, 9.2.1: they change nothing, and CORS keeps what they show


def is_loopback(host: str) -> bool:
    """Tell whether a name or an address can only be this machine's own."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")  # RFC 6761; browsers ask no DNS


class HostMiddleware:
    """Refuse requests for other hosts than loopback's and those that are named, and those of other hosts' pages.

    A web page whose own name suddenly stands for 127.0.0.1 (DNS rebinding) would else read every job: to its browser
    this server is the page's own. One thing it cannot do is to change the Host header. And any page may post a form
    here, whose answer it does not see, but which fills the queue: its browser says in Origin where it is from.
    """

    def __init__(self, app: ASGIApp, *, hosts: tuple[str, ...] = (), origins: tuple[str, ...] = ()) -> None:
        self._app, self._hosts, self._origins = app, hosts, origins

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on, or answer 421 or 403."""
        error = self._error(scope) if scope["type"] == "http" else None
        if error is None:
            await self._app(scope, receive, send)
            return
        await problem_response(Request(scope), error, STATUS_BY_CODE[error.code])(scope, receive, send)

    def _error(self, scope: Scope) -> StraightPCFError | None:
        headers = Headers(scope=scope)
        host = _name_in(headers.get("host", ""))
        if host and not self._is_own(host):  # a browser sends one always
            return MisdirectedRequest(
                f"this server has no keys and does not answer for {host[:80]!r}: ask for localhost, or name it in "
                "STRAIGHTPCF_ALLOWED_HOSTS"
            )
        origin = headers.get("origin")
        if scope["method"] in _SAFE or origin is None or {"*", origin} & {*self._origins}:
            return None
        if self._is_own(_host_of(origin)):
            return None
        return CrossOrigin(
            f"this server has no keys and does nothing for pages of {origin[:80]!r}: name it in "
            "STRAIGHTPCF_CORS_ORIGINS"
        )

    def _is_own(self, host: str) -> bool:
        return is_loopback(host) or host in self._hosts


def _host_of(origin: str) -> str:
    """Return the name in an origin, "" where it has none: `null`, of a page in a sandbox or a file."""
    try:
        return urlsplit(origin).hostname or ""
    except ValueError:
        return ""


def _name_in(host: str) -> str:
    """Leave out the port, the brackets of IPv6 and what makes no difference."""
    host = host.strip().lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0].removesuffix(".")
