"""Carry requests over gRPC (points/wire/straightpcf.proto); needs the extra `grpc`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Coroutine, Generator, Iterator
from contextlib import aclosing, asynccontextmanager, closing
from functools import partial
from typing import Any, TypeVar
from urllib.parse import urlsplit

from straightpcf.clients.sdk.receive import Receiver
from straightpcf.clients.sdk.request import Call
from straightpcf.clients.sdk.retry import Failure
from straightpcf.clients.sdk.silence import Silence
from straightpcf.clients.sdk.transport import AsyncTransport, Attempts, Transport
from straightpcf.points.errors import ConnectionFailed, MissingDependency

try:
    import grpc
    from grpc_health.v1.health_pb2_grpc import HealthStub

    from straightpcf.clients.sdk.grpc_messages import (
        UPLOAD,
        Answer,
        Upload,
        failed_rpc,
        metadata_of,
        request_of,
    )
    from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub
except ImportError as exc:
    raise MissingDependency(f"grpc:// needs an extra: pip install 'straightpcf[grpc]' ({exc})") from exc

__all__ = ["AsyncGrpcTransport", "GrpcTransport"]

_T = TypeVar("_T")

_SHORT = frozenset(("GetJob", "ListJobs", "CancelJob", "DeleteJob", "GetServerInfo", "GetHealth"))
# A dead peer is noticed by pings before the silence is too long.
_OPTIONS = (("grpc.keepalive_time_ms", 20_000), ("grpc.keepalive_timeout_ms", 10_000))


class GrpcTransport(Transport):
    """Talk to the gRPC service."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
        self.again = partial(type(self), url, api_key=api_key, timeout=timeout, max_retries=max_retries)
        self.timeout, self.max_retries = timeout, max_retries
        self._url, self._key = url, api_key
        target, credentials = _target(url)
        if credentials is None:
            self._channel = grpc.insecure_channel(target, options=_OPTIONS)
        else:
            self._channel = grpc.secure_channel(target, credentials, options=_OPTIONS)
        self._stub = _stub(self._channel)

    def close(self) -> None:
        """Close the connections."""
        self.closed = True
        self._channel.close()

    def attempt(self, call: Call, receiver: Receiver, attempts: Attempts) -> Iterator[None]:
        """Make one call."""
        silence = _silence_in(call, self.timeout)
        upload = Upload(call, silence) if call.rpc == UPLOAD else None
        try:
            answer = Answer(call, receiver)
            with closing(self._messages(call, upload or request_of(call, receiver), silence, attempts)) as messages:
                for message in messages:
                    answer.take(message)
                    yield
            attempts.failure = answer.finish()
        except (grpc.RpcError, grpc.FutureCancelledError) as error:
            if upload is not None and upload.error is not None:
                raise upload.error from None
            attempts.failure = _failed(error, silence, self._url)

    def _messages(self, call: Call, send: Any, silence: Silence, attempts: Attempts) -> Generator[Any]:
        ask, how = getattr(self._stub, call.rpc), _how(call, self._key, self.timeout)
        if call.rpc in _SHORT:
            yield ask(send, **how)
        elif call.rpc == UPLOAD:
            coming = ask.future(send, **how)
            with silence.watched(coming):
                yield coming.result()
        else:
            coming = ask(send, **how)
            with silence.watched(coming):
                if coming.initial_metadata():  # which a server that hangs does not send
                    attempts.answered()
                for message in coming:
                    silence.ours()
                    yield message
                    silence.theirs()


class AsyncGrpcTransport(AsyncTransport):
    """Talk to the gRPC service from a coroutine."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
        self.again = partial(type(self), url, api_key=api_key, timeout=timeout, max_retries=max_retries)
        self.timeout, self.max_retries = timeout, max_retries
        self._url, self._key = url, api_key
        self._channel: Any = None  # it belongs to the loop that makes the first call
        self._stub: Any = None

    async def close(self) -> None:
        """Close the connections."""
        self.closed = True
        if self._channel is not None:
            await self._channel.close()

    async def attempt(self, call: Call, receiver: Receiver, attempts: Attempts) -> AsyncGenerator[None]:
        """Make one call."""
        self._open()
        silence = _silence_in(call, self.timeout)
        upload = Upload(call, silence) if call.rpc == UPLOAD else None
        try:
            answer = Answer(call, receiver)
            send = request_of(call, receiver) if upload is None else _asynchronous(upload)
            async with aclosing(self._messages(call, send, silence, attempts)) as messages:
                async for message in messages:
                    answer.take(message)
                    yield
            attempts.failure = answer.finish()
        except (grpc.RpcError, asyncio.CancelledError) as error:
            if upload is not None and upload.error is not None:
                raise upload.error from None
            if not isinstance(error, grpc.RpcError):
                if (task := asyncio.current_task()) is not None and task.cancelling():
                    raise
                self.check_open()  # closing it cancels its calls, but not who waits for them
                if not silence.was_too_long:
                    raise
            attempts.failure = _failed(error, silence, self._url)

    async def _messages(self, call: Call, send: Any, silence: Silence, attempts: Attempts) -> AsyncGenerator[Any]:
        coming = getattr(self._stub, call.rpc)(send, **_how(call, self._key, self.timeout))
        ending = _Ending(coming)
        async with ending.told(), silence.watched_here(coming):
            if hasattr(coming, "__aiter__"):
                if await coming.initial_metadata():
                    attempts.answered()
                async for message in coming:
                    silence.ours()
                    yield message
                    silence.theirs()
            else:
                yield await coming

    def _open(self) -> None:
        if self._channel is None:
            target, credentials = _target(self._url)
            if credentials is None:
                self._channel = grpc.aio.insecure_channel(target, options=_OPTIONS)
            else:
                self._channel = grpc.aio.secure_channel(target, credentials, options=_OPTIONS)
            self._stub = _stub(self._channel)


class _Ending:
    """Keep the status that the other side gave a call.

    What is still being sent then fails, and grpc.aio puts an INTERNAL of its own in the status's place: a refusal
    would be told as that (grpc/grpc#36066, open with grpcio 1.85).
    """

    def __init__(self, coming: Any) -> None:
        self._error: grpc.aio.AioRpcError | None = None
        coming.add_done_callback(self._keep)

    @asynccontextmanager
    async def told(self) -> AsyncGenerator[None]:
        """Raise what was kept where gRPC raises its own."""
        try:
            yield
        except grpc.aio.AioRpcError as error:
            if self._error is None or not _is_of_a_failed_write(error):
                raise
            raise self._error from None

    def _keep(self, coming: Any) -> None:
        code, details = _at_once(coming.code()), _at_once(coming.details())
        if self._error is None and code is not grpc.StatusCode.OK:
            beside = [_at_once(metadata) for metadata in (coming.initial_metadata(), coming.trailing_metadata())]
            error = grpc.aio.AioRpcError(code, *beside, details=details)
            if not _is_of_a_failed_write(error):
                self._error = error


def _is_of_a_failed_write(error: grpc.aio.AioRpcError) -> bool:
    return error.code() is grpc.StatusCode.INTERNAL and error.details() == "Internal error from Core"


def _at_once(known: Coroutine[Any, Any, _T]) -> _T:
    """Return what a coroutine returns that has nothing to wait for: in a task it would be read too late."""
    try:
        known.send(None)
    except StopIteration as end:
        return end.value  # type: ignore[no-any-return]
    known.close()
    raise AssertionError("a call that is over does not know how it ended")


def _stub(channel: Any) -> Any:
    stub: Any = DenoiseServiceStub(channel)  # type: ignore[no-untyped-call]
    stub.GetHealth = HealthStub(channel).Check  # the standard service, grpc.health.v1
    return stub


def _target(url: str) -> tuple[str, Any]:
    parts = urlsplit(url)
    return parts.netloc, grpc.ssl_channel_credentials() if parts.scheme == "grpcs" else None


def _how(call: Call, api_key: str | None, timeout: float | None) -> dict[str, Any]:
    """Return the metadata and the deadline: of a call with one short answer, and of one that is given up by then."""
    usual = timeout if call.rpc in _SHORT else None
    return {"metadata": metadata_of(call, api_key), "timeout": call.patience(usual)}


def _silence_in(call: Call, timeout: float | None) -> Silence:
    return Silence(None if call.rpc in _SHORT else call.patience(timeout))


def _failed(error: BaseException, silence: Silence, url: str) -> Failure:
    """Tell what ended a call."""
    if isinstance(error, grpc.RpcError) and not silence.was_too_long:
        return failed_rpc(error, url)
    said = f"{url}: nothing came or was taken for {silence.seconds:g} s"
    return Failure(error=ConnectionFailed(said), retryable=True, cause=error if isinstance(error, Exception) else None)


async def _asynchronous(messages: Iterator[Any]) -> AsyncIterator[Any]:
    while (message := await asyncio.to_thread(next, messages, None)) is not None:
        yield message
