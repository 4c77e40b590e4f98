"""Carry requests over HTTP, again where that helps: the only part of the SDK that touches the network."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from typing import Any, TypeVar

import httpx2

from straightpcf.clients.sdk.flows import Flow, Step
from straightpcf.clients.sdk.receive import Receiver
from straightpcf.clients.sdk.request import Call
from straightpcf.clients.sdk.response import failed_connection, failed_response
from straightpcf.clients.sdk.retry import Failure, next_delay

__all__ = ["CONNECT_TIMEOUT_SECONDS", "AsyncTransport", "Transport"]

CONNECT_TIMEOUT_SECONDS = 10.0
_FAULTS = (httpx2.TransportError, httpx2.SSEError)

_T = TypeVar("_T")


class Transport:
    """Run flows in ordinary code."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
        self._max_retries = max_retries
        self._http = httpx2.Client(**_options(url, api_key, timeout))

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def run(self, flow: Flow[_T]) -> _T:
        """Do what a flow asks for, request by request; return what it returns, raise what it raises."""
        try:
            step = next(flow)
            while True:
                try:
                    for _ in self.stream(step):
                        pass
                except BaseException as error:
                    step = flow.throw(error)
                else:
                    step = flow.send(step[1].value)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]

    def stream(self, step: Step) -> Iterator[None]:
        """Make one request until its receiver has it all, and yield whenever something came; raises its error."""
        call, receiver = step
        attempts = _Attempts(call, receiver, self._max_retries)
        while True:
            try:
                with call.open_body() as body, self._http.stream(**_request(call, receiver), content=body) as response:
                    if response.is_success:
                        receiver.begin(response.status_code, response.headers)
                        for item in httpx2.EventSource(response) if call.events else response.iter_bytes():
                            receiver.write(item)
                            yield
                        failure = receiver.finish()
                    else:
                        response.read()
                        failure = failed_response(response)
            except _FAULTS as fault:
                failure = failed_connection(fault, self._http.base_url)
            if failure is None:
                return
            time.sleep(attempts.delay_after(failure))


class AsyncTransport:
    """Run flows in a coroutine; cancelling it ends the flow as an exception would."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
        self._max_retries = max_retries
        self._http = httpx2.AsyncClient(**_options(url, api_key, timeout))

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def run(self, flow: Flow[_T]) -> _T:
        """Do as `Transport.run`."""
        try:
            step = next(flow)
            while True:
                try:
                    async for _ in self.stream(step):
                        pass
                except BaseException as error:
                    step = flow.throw(error)
                else:
                    step = flow.send(step[1].value)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]

    async def stream(self, step: Step) -> AsyncIterator[None]:
        """Do as `Transport.stream`."""
        call, receiver = step
        attempts = _Attempts(call, receiver, self._max_retries)
        while True:
            try:
                body = call.stream_body()
                async with self._http.stream(**_request(call, receiver), content=body) as response:
                    if response.is_success:
                        receiver.begin(response.status_code, response.headers)
                        async for item in httpx2.EventSource(response) if call.events else response.aiter_bytes():
                            receiver.write(item)
                            yield
                        failure = receiver.finish()
                    else:
                        await response.aread()
                        failure = failed_response(response)
            except _FAULTS as fault:
                failure = failed_connection(fault, self._http.base_url)
            if failure is None:
                return
            await asyncio.sleep(attempts.delay_after(failure))


class _Attempts:
    """Count the attempts of one request, anew whenever one of them got on."""

    def __init__(self, call: Call, receiver: Receiver, max_retries: int) -> None:
        self._receiver = receiver
        self._max_retries = 0 if call.once else max_retries
        self._attempt, self._furthest = 0, receiver.furthest

    def delay_after(self, failure: Failure) -> float:
        """Return the seconds to wait before the next attempt, or raise what the last one met."""
        if self._receiver.furthest > self._furthest:
            self._attempt, self._furthest = 0, self._receiver.furthest
        delay = next_delay(failure, attempt=self._attempt, max_retries=self._max_retries)
        if delay is None:
            raise failure.error from failure.cause
        self._attempt += 1
        return delay


def _options(url: str, api_key: str | None, timeout: float | None) -> dict[str, Any]:
    return {
        "base_url": url,
        "headers": {} if api_key is None else {"Authorization": f"Bearer {api_key}"},
        "timeout": httpx2.Timeout(timeout, connect=CONNECT_TIMEOUT_SECONDS),
    }


def _request(call: Call, receiver: Receiver) -> dict[str, Any]:
    timeout = {} if call.timeout is None else {"timeout": call.timeout}
    headers = {**call.all_headers(), **receiver.headers()}
    return {"method": call.method, "url": call.path, "params": call.params, "headers": headers, **timeout}
