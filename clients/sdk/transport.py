"""Run flows over some wire, again where that helps: what every transport has in common."""

from __future__ import annotations

import asyncio
import math
import re
import time
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import aclosing, closing
from typing import TypeVar
from urllib.parse import urlsplit, urlunsplit

from straightpcf.clients.sdk.arguments import check_count, check_text, silence_of
from straightpcf.clients.sdk.flows import Flow, Step
from straightpcf.clients.sdk.receive import Receiver
from straightpcf.clients.sdk.request import Call
from straightpcf.clients.sdk.retry import FIRST_DELAY_SECONDS, Failure, next_delay
from straightpcf.points.errors import ConnectionFailed, InvalidOptions, InvalidRequest, NotFound

__all__ = ["AsyncTransport", "Attempts", "Transport", "connect", "connect_async", "without_password"]

_SCHEMES = ("http", "https", "grpc", "grpcs")
_HELD_SECONDS = 10.0  # after an answer began: what breaks off sooner is broken
_T = TypeVar("_T")


def connect(url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> Transport:
    """Choose the transport by the URL's scheme: http(s), or grpc(s) with the extra `grpc`.

    Raises InvalidOptions for a URL and a key that cannot be, InvalidRequest for what is of another kind,
    MissingDependency.
    """
    _check(url, api_key, max_retries)
    url, timeout = _address(url), silence_of("timeout", timeout)
    if url.startswith("grpc"):
        from straightpcf.clients.sdk.grpc_transport import GrpcTransport

        return GrpcTransport(url, api_key=api_key, timeout=timeout, max_retries=max_retries)
    from straightpcf.clients.sdk.http_transport import HttpTransport

    return HttpTransport(url, api_key=api_key, timeout=timeout, max_retries=max_retries)


def connect_async(url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> AsyncTransport:
    """Do as `connect`."""
    _check(url, api_key, max_retries)
    url, timeout = _address(url), silence_of("timeout", timeout)
    if url.startswith("grpc"):
        from straightpcf.clients.sdk.grpc_transport import AsyncGrpcTransport

        return AsyncGrpcTransport(url, api_key=api_key, timeout=timeout, max_retries=max_retries)
    from straightpcf.clients.sdk.http_transport import AsyncHttpTransport

    return AsyncHttpTransport(url, api_key=api_key, timeout=timeout, max_retries=max_retries)


def without_password(url: str) -> str:
    """Return a URL as it may be shown and logged."""
    return re.sub(r"//[^/]*@", "//", url)


def _address(url: str) -> str:
    """Return a server's URL in one spelling: its scheme in small letters, no slash at its end."""
    shown = without_password(url)[:80]
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as exc:
        raise InvalidOptions(f"{shown!r} is no address of a server: {exc}") from exc
    wrong = None
    if parts.scheme not in _SCHEMES:
        wrong = "it must begin with http://, https://, grpc:// or grpcs://"
    elif not parts.hostname:
        wrong = "it names no host"
    elif parts.query or parts.fragment:
        wrong = "a query is not part of it"
    elif parts.scheme == "grpc" and port is None:
        wrong = "gRPC has no usual port: grpc://HOST:PORT"
    elif parts.scheme.startswith("grpc") and (parts.path.strip("/") or parts.username is not None):
        wrong = "it must be grpc://HOST:PORT or grpcs://HOST:PORT"
    if wrong is not None:
        raise InvalidOptions(f"{shown!r} is no address of a server: {wrong}")
    return urlunsplit((parts.scheme, parts.netloc, parts.path.rstrip("/"), "", ""))


def _check(url: str, api_key: str | None, max_retries: int) -> None:
    check_text("url", url)
    check_text("api_key", "" if api_key is None else api_key)
    check_count("max_retries", max_retries)
    if api_key is not None and not (api_key.isascii() and api_key.isprintable()):
        raise InvalidOptions("the API key holds more than printable ASCII, which no header can carry")
    if api_key is not None and (not api_key or api_key != api_key.strip()):
        raise InvalidOptions("the API key is empty, or begins or ends with a space")
    if api_key is not None and without_password(url) != url:
        raise InvalidOptions(
            f"{without_password(url)[:80]!r} names a user: a request carries that or the API key, not both"
        )


class Attempts:
    """Count the attempts of one request, anew whenever one of them got on; `failure` is what the last one met.

    patience: so many seconds are tried a request that uploads nothing, however often the server is not to be reached.
    """

    def __init__(self, call: Call, receiver: Receiver, max_retries: int, patience: float = 0.0) -> None:
        self._receiver = receiver
        self._max_retries = 0 if call.once else max_retries
        self._patience = patience if call.body is None else 0.0
        self._attempt, self._furthest = 0, receiver.furthest
        self._since, self._until = math.nan, call.until
        self._held_seconds = min(_HELD_SECONDS, call.silence / 2) if call.may_wait else None
        self._answered: float | None = None
        self._deletes, self._is_unheard = call.method == "DELETE", False
        self.failure: Failure | None = None

    @property
    def is_done(self) -> bool:
        """Tell whether the last attempt did it, or found no job to delete behind one that nobody heard the end of."""
        if self.failure is None:
            return True
        return self._deletes and self._is_unheard and isinstance(self.failure.error, NotFound)

    def answered(self) -> None:
        """Note that an attempt is being answered."""
        if self._held_seconds is not None:
            self._answered = time.monotonic()

    def delay(self) -> float:
        """Return the seconds to wait before the next attempt, or raise what the last one met."""
        assert self.failure is not None
        if self._was_held() and self.failure.retryable:
            self._attempt = 0
            return FIRST_DELAY_SECONDS
        if self._receiver.furthest > self._furthest:
            self._attempt, self._furthest = 0, self._receiver.furthest
        if self._attempt == 0:
            self._since = time.monotonic()
        most = self._max_retries
        is_gone = isinstance(self.failure.error, ConnectionFailed)
        if most and is_gone and time.monotonic() - self._since < self._patience:
            most = max(most, self._attempt + 1)
        delay = next_delay(self.failure, attempt=self._attempt, max_retries=most)
        if delay is None or (self._until < math.inf and time.monotonic() + delay > self._until):
            raise self.failure.error from self.failure.cause
        self._attempt += 1
        self._is_unheard = self._is_unheard or is_gone
        return delay

    def _was_held(self) -> bool:
        """Tell whether the server held the last answer open, as for a job that waits: a proxy or we gave that up."""
        began, self._answered = self._answered, None
        return began is not None and time.monotonic() - began >= (self._held_seconds or 0.0)


class _Patience:
    """Know how long to go on asking: a server that answered once is restarted, not missing, when it is gone."""

    timeout: float | None
    max_retries: int
    closed = False
    _has_answered = False

    def check_open(self) -> None:
        """Raise InvalidRequest of a client that is closed, before each attempt: another task may close it."""
        if self.closed:
            raise InvalidRequest("this client is closed")

    def attempts(self, step: Step) -> Attempts:
        """Begin to count the attempts of one request."""
        patience = math.inf if self.timeout is None else self.timeout
        return Attempts(*step, self.max_retries, patience if self._has_answered else 0.0)


class Transport(_Patience, ABC):
    """Run flows in ordinary code; timeout: seconds of silence to bear, None for any.

    again: makes another, for the last word of a flow under which this one was closed.
    """

    again: Callable[[], Transport]

    @abstractmethod
    def close(self) -> None:
        """Close the connections."""

    @abstractmethod
    def attempt(self, call: Call, receiver: Receiver, attempts: Attempts) -> Iterator[None]:
        """Make one request, yield whenever something came, and leave what is missing in `attempts.failure`."""

    def run(self, flow: Flow[_T]) -> _T:
        """Do what a flow asks for, request by request; return what it returns, raise what it raises."""
        self.check_open()  # before it begins: it would say its last word of what it never asked for
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
        if self.closed and step[0].once:
            yield from self._farewell(step)
            return
        attempts = self.attempts(step)
        while True:
            self.check_open()
            yield from self.attempt(*step, attempts)
            if attempts.is_done:
                self._has_answered = True
                return
            time.sleep(attempts.delay())

    def _farewell(self, step: Step) -> Iterator[None]:
        """Make the last request of a flow that a close has cut off: its job would run on for nobody."""
        with closing(self.again()) as other:
            yield from other.stream(step)


class AsyncTransport(_Patience, ABC):
    """Run flows in a coroutine; cancelling it ends the flow as an exception would. again: as of `Transport`."""

    again: Callable[[], AsyncTransport]
    _loop: asyncio.AbstractEventLoop | None = None

    def check_open(self) -> None:
        """Raise InvalidRequest also in another event loop than that of the first call, where connections belong."""
        super().check_open()
        loop = asyncio.get_running_loop()
        self._loop = self._loop or loop
        if loop is not self._loop:
            raise InvalidRequest("this client belongs to another event loop, that of its first call: make one in each")

    @abstractmethod
    async def close(self) -> None:
        """Close the connections."""

    @abstractmethod
    def attempt(self, call: Call, receiver: Receiver, attempts: Attempts) -> AsyncGenerator[None]:
        """Do as `Transport.attempt`."""

    async def run(self, flow: Flow[_T]) -> _T:
        """Do as `Transport.run`.

        A scope of anyio, as of Starlette's requests and `move_on_after`, cancels its task again at each step: not those
        with which a flow that is cancelled ends its work on the server.
        """
        from anyio import CancelScope
        from anyio.lowlevel import checkpoint_if_cancelled

        self.check_open()
        canceled = False
        try:
            step = next(flow)
            while True:
                try:
                    with CancelScope(shield=canceled):
                        async for _ in self.stream(step):
                            pass
                except BaseException as error:
                    canceled = canceled or isinstance(error, asyncio.CancelledError)
                    step = flow.throw(error)
                else:
                    step = flow.send(step[1].value)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]
        except asyncio.CancelledError:
            await checkpoint_if_cancelled()  # raises that of the scope, which knows its own alone; gRPC makes another
            raise

    async def stream(self, step: Step) -> AsyncGenerator[None]:
        """Do as `Transport.stream`."""
        if self.closed and step[0].once:
            async with aclosing(self._farewell(step)) as coming:
                async for _ in coming:
                    yield
            return
        attempts = self.attempts(step)
        while True:
            self.check_open()
            async with aclosing(self.attempt(*step, attempts)) as coming:
                async for _ in coming:
                    yield
            if attempts.is_done:
                self._has_answered = True
                return
            await asyncio.sleep(attempts.delay())

    async def _farewell(self, step: Step) -> AsyncGenerator[None]:
        """Do as `Transport._farewell`."""
        other = self.again()
        try:
            async for _ in other.stream(step):
                yield
        finally:
            await other.close()
