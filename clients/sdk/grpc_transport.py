"""Carry requests over gRPC (points/wire/straightpcf.proto); needs the extra `grpc`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Iterator
from typing import Any
from urllib.parse import urlsplit

from straightpcf.clients.sdk.receive import Receiver
from straightpcf.clients.sdk.request import Call
from straightpcf.clients.sdk.transport import AsyncTransport, Attempts, Transport
from straightpcf.points.errors import MissingDependency

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

# A dead peer is noticed by pings, so that a stream may be silent for as long as it likes.
_OPTIONS = (("grpc.keepalive_time_ms", 20_000), ("grpc.keepalive_timeout_ms", 10_000))


class GrpcTransport(Transport):
    """Talk to the gRPC service."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
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
        upload = Upload(call) if call.rpc == UPLOAD else None
        try:
            answer = Answer(call, receiver)
            send = upload or request_of(call, receiver)
            came = getattr(self._stub, call.rpc)(send, **_how(call, self._key, self.timeout))
            for message in came if hasattr(came, "__next__") else (came,):
                answer.take(message)
                yield
            attempts.failure = answer.finish()
        except grpc.RpcError as error:
            if upload is not None and upload.error is not None:
                raise upload.error from None
            attempts.failure = failed_rpc(error, self._url)


class AsyncGrpcTransport(AsyncTransport):
    """Talk to the gRPC service from a coroutine."""

    def __init__(self, url: str, *, api_key: str | None, timeout: float | None, max_retries: int) -> None:
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
        upload = Upload(call) if call.rpc == UPLOAD else None
        try:
            answer = Answer(call, receiver)
            send = request_of(call, receiver) if upload is None else _asynchronous(upload)
            came = getattr(self._stub, call.rpc)(send, **_how(call, self._key, self.timeout))
            if hasattr(came, "__aiter__"):
                async for message in came:
                    answer.take(message)
                    yield
            else:
                answer.take(await came)
                yield
            attempts.failure = answer.finish()
        except (grpc.RpcError, asyncio.CancelledError) as error:
            if upload is not None and upload.error is not None:
                raise upload.error from None
            if not isinstance(error, grpc.RpcError):
                if (task := asyncio.current_task()) is not None and not task.cancelling():
                    self.check_open()  # closing it cancels its calls, but not who waits for them
                raise
            attempts.failure = failed_rpc(error, self._url)

    def _open(self) -> None:
        if self._channel is None:
            target, credentials = _target(self._url)
            if credentials is None:
                self._channel = grpc.aio.insecure_channel(target, options=_OPTIONS)
            else:
                self._channel = grpc.aio.secure_channel(target, credentials, options=_OPTIONS)
            self._stub = _stub(self._channel)


def _stub(channel: Any) -> Any:
    stub: Any = DenoiseServiceStub(channel)  # type: ignore[no-untyped-call]
    stub.GetHealth = HealthStub(channel).Check  # the standard service, grpc.health.v1
    return stub


def _target(url: str) -> tuple[str, Any]:
    parts = urlsplit(url)
    return parts.netloc, grpc.ssl_channel_credentials() if parts.scheme == "grpcs" else None


def _how(call: Call, api_key: str | None, timeout: float | None) -> dict[str, Any]:
    """Return the metadata and the deadline: of a call with one short answer, and of one that is given up by then."""
    short = call.rpc in ("GetJob", "ListJobs", "CancelJob", "DeleteJob", "GetServerInfo", "GetHealth")
    return {"metadata": metadata_of(call, api_key), "timeout": call.patience(timeout if short else None)}


async def _asynchronous(messages: Iterator[Any]) -> AsyncIterator[Any]:
    while (message := await asyncio.to_thread(next, messages, None)) is not None:
        yield message
