"""The sync and the async client: a loop of attempts each, around one pure core."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, TypeVar

import httpx2

from straightpcf.clients.atomic import replaced_when_complete
from straightpcf.clients.sdk.request import Call, Source, denoise_call
from straightpcf.clients.sdk.response import (
    Health,
    ServerInfo,
    failed_connection,
    failed_response,
    parse_health,
    parse_info,
)
from straightpcf.clients.sdk.result import Denoised
from straightpcf.clients.sdk.retry import MAX_RETRIES, next_delay

__all__ = ["CONNECT_TIMEOUT_SECONDS", "DEFAULT_TIMEOUT_SECONDS", "AsyncClient", "Client"]

DEFAULT_TIMEOUT_SECONDS = 600.0  # of silence: the server says nothing while it computes
CONNECT_TIMEOUT_SECONDS = 10.0

_HEALTH = Call(method="GET", path="/healthz")
_INFO = Call(method="GET", path="/v1/info")

_T = TypeVar("_T")


class Client:
    """Call a server from ordinary code; use it as a context manager or close it.

    url: where the server is, "http://127.0.0.1:8000".
    api_key: sent as a bearer token.
    timeout: seconds of silence that are borne while the server computes, None for ever.
    max_retries: of a busy server and of a broken connection; every other error is raised at once.
    """

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout: float | None = DEFAULT_TIMEOUT_SECONDS,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        self._max_retries = max_retries
        self._http = httpx2.Client(**_http_options(url, api_key, timeout))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def denoise(
        self,
        source: Source,
        target: str | Path | None = None,
        *,
        iterations: int | Literal["auto"] = "auto",
        seed: int = 0,
        strength: float = 1.0,
        format: str | None = None,
    ) -> Denoised:
        """Denoise one cloud: the same points in the same order, every other field unchanged.

        source: a path, the bytes of a file, an (N, 3) array, or an open3d cloud.
        target: where to write the result; by default it is held in memory.
        format: of the result; by default that of the target's name, else that of the source.
        Raises the StraightPCFError that the server met; a target is written complete or not at all.
        """
        path = None if target is None else Path(target)
        call = denoise_call(source, path, iterations=iterations, seed=seed, strength=strength, format=format)

        def receive(response: httpx2.Response) -> Denoised:
            if path is None:
                return Denoised.from_headers(response.headers, content=response.read(), source=_open3d_cloud(source))
            with replaced_when_complete(path) as unfinished, unfinished.open("wb") as file:
                for chunk in response.iter_bytes():
                    file.write(chunk)
            return Denoised.from_headers(response.headers, path=path, source=_open3d_cloud(source))

        return self._send(call, receive)

    def health(self) -> Health:
        """Ask whether the server is there, and warm."""
        return self._send(_HEALTH, _read_then(parse_health))

    def info(self) -> ServerInfo:
        """Ask what the server is and takes."""
        return self._send(_INFO, _read_then(parse_info))

    def _send(self, call: Call, receive: Callable[[httpx2.Response], _T]) -> _T:
        for attempt in itertools.count():
            try:
                with call.open_body() as body, self._http.stream(**_request(call), content=body) as response:
                    if response.is_success:
                        return receive(response)
                    response.read()
                    failure = failed_response(response)
            except httpx2.TransportError as fault:
                failure = failed_connection(fault, self._http.base_url)
            delay = next_delay(failure, attempt=attempt, max_retries=self._max_retries)
            if delay is None:
                raise failure.error from failure.cause
            time.sleep(delay)
        raise AssertionError("unreachable")


class AsyncClient:
    """Call a server from a coroutine; the same as `Client` otherwise."""

    def __init__(
        self,
        url: str,
        *,
        api_key: str | None = None,
        timeout: float | None = DEFAULT_TIMEOUT_SECONDS,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        self._max_retries = max_retries
        self._http = httpx2.AsyncClient(**_http_options(url, api_key, timeout))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def denoise(
        self,
        source: Source,
        target: str | Path | None = None,
        *,
        iterations: int | Literal["auto"] = "auto",
        seed: int = 0,
        strength: float = 1.0,
        format: str | None = None,
    ) -> Denoised:
        """Denoise one cloud, as `Client.denoise`; cancelling the coroutine cancels the work on the server."""
        path = None if target is None else Path(target)
        call = denoise_call(source, path, iterations=iterations, seed=seed, strength=strength, format=format)

        async def receive(response: httpx2.Response) -> Denoised:
            if path is None:
                content = await response.aread()
                return Denoised.from_headers(response.headers, content=content, source=_open3d_cloud(source))
            with replaced_when_complete(path) as unfinished, unfinished.open("wb") as file:
                async for chunk in response.aiter_bytes():
                    await asyncio.to_thread(file.write, chunk)
            return Denoised.from_headers(response.headers, path=path, source=_open3d_cloud(source))

        return await self._send(call, receive)

    async def health(self) -> Health:
        """Ask whether the server is there, and warm."""
        return await self._send(_HEALTH, _aread_then(parse_health))

    async def info(self) -> ServerInfo:
        """Ask what the server is and takes."""
        return await self._send(_INFO, _aread_then(parse_info))

    async def _send(self, call: Call, receive: Callable[[httpx2.Response], Awaitable[_T]]) -> _T:
        for attempt in itertools.count():
            try:
                async with self._http.stream(**_request(call), content=call.stream_body()) as response:
                    if response.is_success:
                        return await receive(response)
                    await response.aread()
                    failure = failed_response(response)
            except httpx2.TransportError as fault:
                failure = failed_connection(fault, self._http.base_url)
            delay = next_delay(failure, attempt=attempt, max_retries=self._max_retries)
            if delay is None:
                raise failure.error from failure.cause
            await asyncio.sleep(delay)
        raise AssertionError("unreachable")


def _http_options(url: str, api_key: str | None, timeout: float | None) -> dict[str, Any]:
    return {
        "base_url": url,
        "headers": {} if api_key is None else {"Authorization": f"Bearer {api_key}"},
        "timeout": httpx2.Timeout(timeout, connect=CONNECT_TIMEOUT_SECONDS),
    }


def _request(call: Call) -> dict[str, Any]:
    return {"method": call.method, "url": call.path, "params": call.params, "headers": call.headers}


def _open3d_cloud(source: Source) -> Any:
    return source if type(source).__module__.startswith("open3d") else None


def _read_then(parse: Callable[[httpx2.Response], _T]) -> Callable[[httpx2.Response], _T]:
    def receive(response: httpx2.Response) -> _T:
        response.read()
        return parse(response)

    return receive


def _aread_then(parse: Callable[[httpx2.Response], _T]) -> Callable[[httpx2.Response], Awaitable[_T]]:
    async def receive(response: httpx2.Response) -> _T:
        await response.aread()
        return parse(response)

    return receive
