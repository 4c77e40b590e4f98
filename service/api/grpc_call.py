"""What every call of the gRPC face shares: who asks, its request id, and errors as rich statuses (google.rpc)."""

from __future__ import annotations

import asyncio
import logging
import sqlite3
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Never, TypeAlias

import grpc
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import DecodeError
from google.rpc import code_pb2, error_details_pb2, status_pb2
from grpc_status import rpc_status

from straightpcf.points.errors import InternalError, InvalidRequest, StraightPCFError, TooManyBytes
from straightpcf.service.api.auth import Gate
from straightpcf.service.api.errors import GRPC_STATUS_BY_CODE, RETRY_AFTER_SECONDS, busy
from straightpcf.service.api.intake import checked_key
from straightpcf.service.api.request_id import usable_id
from straightpcf.service.telemetry import Telemetry

__all__ = ["Caller", "Context", "LateParsing", "answering"]

_LARGEST_MESSAGE = 2**20 + 4096  # a chunk of 1 MiB, and what is around it
DOMAIN = "straightpcf"
_MESSAGE_BYTES = 1500  # it is sent twice, once percent-encoded, in metadata of which clients take 8 KiB
_CANCELLED_WITHIN_SECONDS = 1.0
_GIVE_BACK = frozenset({"CancelJob", "DeleteJob"})

Context: TypeAlias = grpc.aio.ServicerContext[Any, Any]

logger = logging.getLogger("uvicorn.error")


@dataclass(frozen=True, kw_only=True)
class Caller:
    """Hold what a call's metadata says."""

    owner: str
    request_id: str
    idempotency_key: str | None
    traceparent: str | None


class LateParsing(grpc.aio.ServerInterceptor):  # type: ignore[misc]  # grpc.aio is untyped
    """Let a request that is too large or none of the schema's reach its method: grpc's own answer has no ErrorInfo."""

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> grpc.RpcMethodHandler:
        """Return the handler of a call; what its single request is, is told where that is first looked at."""
        handler: Any = await continuation(handler_call_details)
        if handler is None:
            return handler
        parse = handler.request_deserializer
        if handler.request_streaming:  # the messages of a stream are parsed inside of the method
            return handler._replace(request_deserializer=lambda data: _parsed(parse, data))
        return handler._replace(request_deserializer=lambda data: _parsed_late(parse, data))


class _Unparsable:
    def __init__(self, fault: DecodeError | TooManyBytes) -> None:
        self._fault = fault

    def __getattr__(self, name: str) -> Never:
        raise self._fault


def _parsed(parse: Callable[[bytes], Any], data: bytes) -> Any:
    if len(data) > _LARGEST_MESSAGE:
        size = f"a message of the call has {len(data)} bytes; the limit is {_LARGEST_MESSAGE}"
        raise TooManyBytes(f"{size}: send a file in smaller chunks")
    return parse(data)


def _parsed_late(parse: Callable[[bytes], Any], data: bytes) -> Any:
    try:
        return _parsed(parse, data)
    except (DecodeError, TooManyBytes) as fault:
        return _Unparsable(fault)


@asynccontextmanager
async def answering(context: Context, method: str, *, gate: Gate, telemetry: Telemetry) -> AsyncIterator[Caller]:
    """Let a caller in, and end the call with a status that says what the block raised."""
    metadata = [pair for pair in context.invocation_metadata() or () if isinstance(pair[1], str)]
    said = dict(metadata)
    id = usable_id(said.get("x-request-id"))
    status = "OK"
    try:
        await context.send_initial_metadata((("x-request-id", id),))
        yield Caller(
            owner=gate.admit(said.get("authorization"), gives_back=method in _GIVE_BACK),
            request_id=id,
            idempotency_key=checked_key([value for name, value in metadata if name == "idempotency-key"]),
            traceparent=said.get("traceparent"),
        )
    except StraightPCFError as error:
        status = GRPC_STATUS_BY_CODE[error.code]
        await _abort(context, error, id)
    except Exception as fault:
        if isinstance(fault, grpc.aio.InternalError):
            # A write fails so in whose midst the caller ended the call, or its deadline; grpc then cancels this task.
            status = "CANCELLED"
            await asyncio.sleep(_CANCELLED_WITHIN_SECONDS)
        told = _explained(fault)
        if told is None:
            logger.exception("request %s: %s failed", id, method)
            told = InternalError("the server met an error of its own")
        status = GRPC_STATUS_BY_CODE[told.code]
        await _abort(context, told, id)
    except BaseException:
        status = "CANCELLED"
        raise
    finally:
        telemetry.grpc_requests.labels(method, status).inc()


def _explained(fault: Exception) -> StraightPCFError | None:
    if isinstance(fault, DecodeError):
        return InvalidRequest(f"a message of the call is none of this service's schema: {fault}")
    return busy(fault) if isinstance(fault, OSError | sqlite3.Error) else None


async def _abort(context: Context, error: StraightPCFError, request_id: str) -> Never:
    code = GRPC_STATUS_BY_CODE[error.code]
    metadata = {"retryable": str(error.retryable).lower(), "request_id": request_id}
    details = [error_details_pb2.ErrorInfo(reason=error.code.upper(), domain=DOMAIN, metadata=metadata)]
    if error.retryable:
        delay = Duration(seconds=error.retry_after or RETRY_AFTER_SECONDS)
        details.append(error_details_pb2.RetryInfo(retry_delay=delay))
    message = error.message.encode()[:_MESSAGE_BYTES].decode(errors="ignore")
    rich = status_pb2.Status(code=code_pb2.Code.Value(code), message=message)
    for detail in details:
        (packed := AnyMessage()).Pack(detail)
        rich.details.append(packed)
    status = rpc_status.to_status(rich)
    await context.abort(status.code, status.details, status.trailing_metadata)
    raise AssertionError("abort always raises")
