"""Carry requests over HTTP."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from typing import Any

import httpx2

from straightpcf.clients.sdk.receive import Receiver
from straightpcf.clients.sdk.request import Call
from straightpcf.clients.sdk.response import failed_connection, failed_response
from straightpcf.clients.sdk.transport import AsyncTransport, Attempts, Transport
from straightpcf.points.errors import InvalidRequest

__all__ = ["CONNECT_TIMEOUT_SECONDS", "AsyncHttpTransport", "HttpTransport"]

CONNECT_TIMEOUT_SECONDS = 10.0
_FAULTS = (httpx2.TransportError, httpx2.SSEError)


class HttpTransport(Transport):
    """Talk to the REST API."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
        self.timeout, self.max_retries = timeout, max_retries
        self._http = httpx2.Client(**_options(url, api_key, timeout))

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def attempt(self, call: Call, receiver: Receiver, attempts: Attempts) -> Iterator[None]:
        """Make one request."""
        asked = _request(call, receiver, self.timeout)
        try:
            with call.open_body() as body, self._http.stream(**asked, content=body) as response:
                if response.is_success:
                    receiver.begin(response.status_code, response.headers)
                    has_events = call.events and response.status_code != 204
                    for item in httpx2.EventSource(response) if has_events else response.iter_bytes():
                        receiver.write(item)
                        yield
                    attempts.failure = receiver.finish()
                else:
                    response.read()
                    attempts.failure = failed_response(response)
        except _FAULTS as fault:
            attempts.failure = failed_connection(fault, self._http.base_url)


class AsyncHttpTransport(AsyncTransport):
    """Talk to the REST API from a coroutine."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
        self.timeout, self.max_retries = timeout, max_retries
        self._http = httpx2.AsyncClient(**_options(url, api_key, timeout))

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def attempt(self, call: Call, receiver: Receiver, attempts: Attempts) -> AsyncIterator[None]:
        """Make one request."""
        asked = _request(call, receiver, self.timeout)
        try:
            async with self._http.stream(**asked, content=call.stream_body()) as response:
                if response.is_success:
                    receiver.begin(response.status_code, response.headers)
                    has_events = call.events and response.status_code != 204
                    async for item in httpx2.EventSource(response) if has_events else response.aiter_bytes():
                        receiver.write(item)
                        yield
                    attempts.failure = receiver.finish()
                else:
                    await response.aread()
                    attempts.failure = failed_response(response)
        except _FAULTS as fault:
            attempts.failure = failed_connection(fault, self._http.base_url)


def _options(url: str, api_key: str | None, timeout: float | None) -> dict[str, Any]:
    try:
        base = httpx2.URL(url)
    except httpx2.InvalidURL as exc:
        raise InvalidRequest(f"{url[:80]!r} is no address of a server: {exc}") from exc
    return {
        "base_url": base,
        "headers": {} if api_key is None else {"Authorization": f"Bearer {api_key}"},
        "timeout": _silence(timeout),
    }


def _request(call: Call, receiver: Receiver, timeout: float | None) -> dict[str, Any]:
    silence = None if timeout is None else _silence(max(timeout, call.silence))
    return {
        "method": call.method,
        "url": call.path,
        "params": call.params,
        "headers": {**call.all_headers(), **receiver.headers()},
        "timeout": silence if call.timeout is None else call.timeout,
    }


def _silence(seconds: float | None) -> httpx2.Timeout:
    return httpx2.Timeout(seconds, connect=CONNECT_TIMEOUT_SECONDS)
