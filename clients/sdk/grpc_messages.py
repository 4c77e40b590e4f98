"""A request of the SDK as a gRPC call, and what comes back as a receiver takes it; touches no network."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import grpc
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import Message
from google.rpc import error_details_pb2
from grpc_health.v1.health_pb2 import HealthCheckRequest, HealthCheckResponse
from grpc_status import rpc_status

from straightpcf.clients.sdk.receive import Receiver
from straightpcf.clients.sdk.request import Call
from straightpcf.clients.sdk.retry import Failure
from straightpcf.clients.sdk.silence import Silence
from straightpcf.points.errors import (
    ERRORS_BY_CODE,
    ConnectionFailed,
    InternalError,
    ServerBusy,
    StraightPCFError,
    TooManyBytes,
)
from straightpcf.points.wire import straightpcf_pb2 as pb
from straightpcf.points.wire.messages import event_of, frame_of, message_of, plain_of
from straightpcf.points.wire.patches import encode_end, encode_frame, encode_header

__all__ = ["UPLOAD", "Answer", "Upload", "failed_rpc", "metadata_of", "request_of"]

UPLOAD = "CreateJob"
_PART_BYTES = 2**16  # of a file in one message: it is taken whole or not at all, and a line may be slow
# What gRPC says of a message that is larger than one side takes, or of metadata that are.
_TOO_LARGE = re.compile(r"(?:larger than max|exceeds hard limit) \(\D*(\d+) vs\. (\d+)\)")

_REQUESTS: Mapping[str, type[Message]] = {
    "GetJob": pb.GetJobRequest,
    "ListJobs": pb.ListJobsRequest,
    "WatchJob": pb.WatchJobRequest,
    "CancelJob": pb.CancelJobRequest,
    "DeleteJob": pb.DeleteJobRequest,
    "StreamPatches": pb.StreamPatchesRequest,
    "DownloadResult": pb.DownloadResultRequest,
    "GetServerInfo": Empty,
    "GetHealth": HealthCheckRequest,
}


def request_of(call: Call, receiver: Receiver) -> Message:
    """Build the one message that a call other than the upload sends, going on where the receiver stands."""
    fields = dict(call.fields)
    if call.rpc == "WatchJob":
        fields["after"] = receiver.furthest
    elif call.rpc == "DownloadResult" and (rest := receiver.headers().get("Range")):
        fields["offset"] = int(rest.removeprefix("bytes=").removesuffix("-"))
    return message_of(_REQUESTS[call.rpc], fields)


class Upload(Iterator[pb.CreateJobRequest]):
    """A job's config and its file in chunks; error: what kept the rest from being read, of which gRPC says nothing.

    silence: is told when the other side took a message, and when it has the next one.
    """

    def __init__(self, call: Call, silence: Silence) -> None:
        self._silence = silence
        parts = (chunk[at : at + _PART_BYTES] for chunk in call.chunks() for at in range(0, len(chunk), _PART_BYTES))
        chunks = (pb.CreateJobRequest(chunk=part) for part in parts)
        self._messages = chain([pb.CreateJobRequest(config=message_of(pb.JobConfig, call.fields))], chunks)
        self.error: Exception | None = None

    def __next__(self) -> pb.CreateJobRequest:
        """Make one message."""
        self._silence.ours()
        try:
            return next(self._messages)
        except (StraightPCFError, OSError) as error:
            self.error = error
            raise
        finally:
            self._silence.theirs()


def metadata_of(call: Call, api_key: str | None) -> tuple[tuple[str, str], ...]:
    """Return what stands beside a call."""
    said = {"x-request-id": call.request_id}
    if (key := call.headers.get("Idempotency-Key")) is not None:
        said["idempotency-key"] = key
    if api_key is not None:
        said["authorization"] = f"Bearer {api_key}"
    return tuple(said.items())


@dataclass(frozen=True)
class _Event:
    event: str
    id: str
    data: str


class Answer:
    """Hand what comes back to a receiver, in the words of REST."""

    def __init__(self, call: Call, receiver: Receiver) -> None:
        self._call, self._receiver = call, receiver
        self._offset = 0
        self._points: int | None = None
        self._is_empty = True
        if call.rpc not in ("DownloadResult", "StreamPatches"):
            receiver.begin(200, {})

    def take(self, message: Any) -> None:
        """Take the next message."""
        receiver = self._receiver
        self._is_empty = False
        match message:
            case pb.JobEvent():
                kind, seq, data = event_of(message)
                receiver.write(_Event(kind, str(seq), json.dumps(data)))
            case pb.Patch():
                self._begin_patches(message.points)
                frame = frame_of(message)
                receiver.write(
                    encode_frame(
                        frame.indices, frame.xyz, iteration=frame.iteration, final=frame.final, progress=frame.progress
                    )
                )
            case pb.DownloadResultResponse(result=result) if message.HasField("result"):
                self._begin_file(result)
            case pb.DownloadResultResponse():
                receiver.write(message.chunk)
            case HealthCheckResponse():
                ready = message.status == HealthCheckResponse.SERVING
                receiver.write(json.dumps({"status": "ok" if ready else "not serving", "ready": ready}).encode())
            case Empty():
                pass
            case _:
                receiver.write(json.dumps(plain_of(message)).encode())

    def finish(self) -> Failure | None:
        """Take the end of a call that went well."""
        if self._call.rpc == "StreamPatches":
            self._begin_patches(0)  # nothing came of a cloud that was not filtered: all of it lies in one place
            self._receiver.write(encode_end(1))
        elif self._call.rpc == "WatchJob" and self._is_empty:
            self._receiver.begin(204, {})  # as REST says that nothing is left to tell
        return self._receiver.finish()

    def _begin_patches(self, points: int) -> None:
        if self._points is None:
            self._points = points
            self._receiver.begin(200, {})
            self._receiver.write(encode_header(points))

    def _begin_file(self, result: pb.ResultInfo) -> None:
        asked = self._receiver.headers().get("Range")
        offset = int(asked.removeprefix("bytes=").removesuffix("-")) if asked else 0
        headers = {"ETag": f'"{result.sha256}"'}
        if offset:
            headers["Content-Range"] = f"bytes {offset}-{result.bytes - 1}/{result.bytes}"
        self._receiver.begin(206 if offset else 200, headers)


def failed_rpc(error: grpc.RpcError, url: str) -> Failure:
    """Turn a status into the error that it stands for."""
    reason, request_id, retry_after = None, None, None
    status = rpc_status.from_call(error)
    for detail in status.details if status is not None else ():
        info, retry = error_details_pb2.ErrorInfo(), error_details_pb2.RetryInfo()
        if detail.Unpack(info):
            reason, request_id = info.reason.lower(), info.metadata.get("request_id")
        elif detail.Unpack(retry):
            retry_after = float(retry.retry_delay.seconds)
    code, text = error.code(), str(error.details())
    if reason is not None:
        ours = ERRORS_BY_CODE.get(reason, InternalError)(text, request_id=request_id)
        return Failure(error=ours, retryable=ours.retryable, retry_after=retry_after, cause=error)
    if code == grpc.StatusCode.RESOURCE_EXHAUSTED:  # of gRPC itself, on either side, or of a proxy
        if (sizes := _TOO_LARGE.search(text)) is None:
            return Failure(error=ServerBusy(f"{url}: {text}"), retryable=True, cause=error)
        said = f"{url}: {sizes[1]} bytes at once; the limit is {sizes[2]} ({text})"
        return Failure(error=TooManyBytes(said), retryable=False, cause=error)
    again = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED, grpc.StatusCode.CANCELLED)
    return Failure(error=ConnectionFailed(f"{url}: {code.name}: {text}"), retryable=code in again, cause=error)
