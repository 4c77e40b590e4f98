"""Carry requests over HTTP."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, Iterator
from functools import partial
from typing import Any, TypeVar

import httpx2

from straightpcf.clients.sdk.per_process import PerProcess
from straightpcf.clients.sdk.receive import Receiver
from straightpcf.clients.sdk.request import Call
from straightpcf.clients.sdk.response import failed_connection, failed_response
from straightpcf.clients.sdk.transport import AsyncTransport, Attempts, Transport, without_password
from straightpcf.points.errors import InvalidOptions, MissingDependency

__all__ = ["CONNECT_TIMEOUT_SECONDS", "AsyncHttpTransport", "HttpTransport"]

CONNECT_TIMEOUT_SECONDS = 10.0
# A stream keeps its own for as long as its job runs; a process has descriptors for a thousand or so.
_LIMITS = httpx2.Limits(max_connections=500, max_keepalive_connections=20)
_Client = TypeVar("_Client", httpx2.Client, httpx2.AsyncClient)
_FAULTS = (httpx2.TransportError, httpx2.DecodingError)


class HttpTransport(Transport):
    """Talk to the REST API."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
        self.again = partial(type(self), url, api_key=api_key, timeout=timeout, max_retries=max_retries)
        self.timeout, self.max_retries, self._url = timeout, max_retries, without_password(url)
        self._http = PerProcess(lambda: _made(httpx2.Client, url, api_key, timeout))

    def close(self) -> None:
        """Close the connections."""
        self.closed = True
        self._http.get().close()

    def attempt(self, call: Call, receiver: Receiver, attempts: Attempts) -> Iterator[None]:
        """Make one request."""
        asked = _request(call, receiver, self.timeout)
        try:
            body = None if call.body is None else call.chunks()
            with self._http.get().stream(**asked, content=body) as response:
                if response.is_success:
                    attempts.answered()
                    receiver.begin(response.status_code, response.headers)
                    has_events = call.events and response.status_code != 204
                    for item in httpx2.EventSource(response) if has_events else response.iter_bytes():
                        receiver.write(item)
                        yield
                    attempts.failure = receiver.finish()
                else:
                    response.read()
                    attempts.failure = failed_response(response, self._url)
        except _FAULTS as fault:
            attempts.failure = failed_connection(fault, self._url)


class AsyncHttpTransport(AsyncTransport):
    """Talk to the REST API from a coroutine."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
        self.again = partial(type(self), url, api_key=api_key, timeout=timeout, max_retries=max_retries)
        self.timeout, self.max_retries, self._url = timeout, max_retries, without_password(url)
        self._http = _made(httpx2.AsyncClient, url, api_key, timeout)

    async def close(self) -> None:
        """Close the connections; those of an event loop that is over went with it."""
        self.closed = True
        if self._loop is None or not self._loop.is_closed():
            await self._http.aclose()

    async def attempt(self, call: Call, receiver: Receiver, attempts: Attempts) -> AsyncGenerator[None]:
        """Make one request."""
        asked = _request(call, receiver, self.timeout)
        try:
            body = None if call.body is None else call.async_chunks()
            async with self._http.stream(**asked, content=body) as response:
                if response.is_success:
                    attempts.answered()
                    receiver.begin(response.status_code, response.headers)
                    has_events = call.events and response.status_code != 204
                    async for item in httpx2.EventSource(response) if has_events else response.aiter_bytes():
                        receiver.write(item)
                        yield
                    attempts.failure = receiver.finish()
                else:
                    await response.aread()
                    attempts.failure = failed_response(response, self._url)
        except _FAULTS as fault:
            attempts.failure = failed_connection(fault, self._url)


def _made(kind: type[_Client], url: str, api_key: str | None, timeout: float | None) -> _Client:
    try:
        base = httpx2.URL(url)
    except httpx2.InvalidURL as exc:
        raise InvalidOptions(f"{without_password(url)[:80]!r} is no address of a server: {exc}") from exc
    headers = {} if api_key is None else {"Authorization": f"Bearer {api_key}"}
    try:
        return kind(base_url=base, headers=headers, timeout=_silence(timeout), limits=_LIMITS)
    except ImportError as exc:
        raise MissingDependency("the environment (ALL_PROXY, ...) names a SOCKS proxy: pip install socksio") from exc
    except (httpx2.InvalidURL, ValueError, OSError) as exc:
        named = "HTTP_PROXY, HTTPS_PROXY, ALL_PROXY, SSL_CERT_FILE, SSL_CERT_DIR"
        raise InvalidOptions(f"what the environment says of proxies or certificates ({named}): {exc}") from exc


def _request(call: Call, receiver: Receiver, timeout: float | None) -> dict[str, Any]:
    silence = _silence(call.patience(timeout))
    if call.timeout is None and math.isinf(call.until):
        silence.pool = None  # to wait for other calls of this client is no silence of the server
    return {
        "method": call.method,
        "url": call.path,
        "params": call.params,
        "headers": {**call.all_headers(), **receiver.headers()},
        "timeout": silence,
    }


def _silence(seconds: float | None) -> httpx2.Timeout:
    return httpx2.Timeout(seconds, connect=min(CONNECT_TIMEOUT_SECONDS, math.inf if seconds is None else seconds))
