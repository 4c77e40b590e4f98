"""For whom a request is meant: a server without keys, on loopback, answers its own names alone."""

from __future__ import annotations

import ipaddress

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from straightpcf.points.errors import MisdirectedRequest
from straightpcf.service.api.errors import STATUS_BY_CODE, problem_response

__all__ = ["HostMiddleware", "is_loopback"]


def is_loopback(host: str) -> bool:
    """Tell whether a name or an address can only be this machine's own."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")  # RFC 6761; browsers ask no DNS


class HostMiddleware:
    """Refuse requests for other hosts than loopback's and those that are named.

    A web page whose own name suddenly stands for 127.0.0.1 (DNS rebinding) would else read every job: to its browser
    this server is the page's own. One thing it cannot do is to change the Host header.
    """

    def __init__(self, app: ASGIApp, *, hosts: tuple[str, ...] = ()) -> None:
        self._app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on, or answer 421."""
        host = _name_in(Headers(scope=scope).get("host", "")) if scope["type"] == "http" else ""
        if not host or is_loopback(host) or host in self._hosts:  # a browser sends one always
            await self._app(scope, receive, send)
            return
        error = MisdirectedRequest(
            f"this server has no keys and does not answer for {host[:80]!r}: ask for localhost, or name it in "
            "STRAIGHTPCF_ALLOWED_HOSTS"
        )
        await problem_response(Request(scope), error, STATUS_BY_CODE[error.code])(scope, receive, send)


def _name_in(host: str) -> str:
    """Leave out the port, the brackets of IPv6 and what makes no difference."""
    host = host.strip().lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0].removesuffix(".")
