"""The JSON form of a job (docs/api.md) as protobuf messages, and back: the two transports say the same."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC
from typing import Any, TypeVar

import numpy as np
from google.protobuf.descriptor import EnumDescriptor
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from straightpcf.points.wire import straightpcf_pb2 as pb
from straightpcf.points.wire.patches import PatchFrame

__all__ = [
    "event_message",
    "event_of",
    "frame_of",
    "message_of",
    "name_of",
    "patch_messages",
    "plain_of",
]

MAX_PATCH_POINTS = 2**14  # of a message, 448 KiB; only points that lie in one place make a patch as large as that

_M = TypeVar("_M", bound=Message)


def message_of(kind: type[_M], values: Mapping[str, Any]) -> _M:
    """Build a message from the JSON form; what is None or not in the schema is left out."""
    message = kind()
    _fill(message, values)
    return message


def plain_of(message: Message) -> dict[str, Any]:
    """Return the JSON form of a message, None where an optional field is absent."""
    if isinstance(message, pb.DenoiseOptions):
        return {
            "iterations": message.iterations if message.HasField("iterations") else "auto",
            "seed": message.seed,
            "strength": message.strength if message.HasField("strength") else 1.0,
            "normals": "recompute" if message.recompute_normals else "keep",
        }
    return {field.name: _plain_field(message, field) for field in message.DESCRIPTOR.fields}


def event_message(kind: str, seq: int, at: str, data: Mapping[str, Any]) -> pb.JobEvent:
    """Build an event; at: RFC 3339, data: as the event's JSON has it."""
    if kind == "preview":
        data = {**data, "xyz": [value for point in data["xyz"] for value in point]}
    return message_of(pb.JobEvent, {"seq": seq, "at": at, kind: data})


def event_of(message: pb.JobEvent) -> tuple[str, int, dict[str, Any]]:
    """Return an event's kind, number and data, as its JSON has them."""
    kind = str(message.WhichOneof("kind"))
    data = plain_of(getattr(message, kind))
    if kind == "preview":
        data["xyz"] = [data["xyz"][start : start + 3] for start in range(0, len(data["xyz"]), 3)]
    return kind, message.seq, data


def patch_messages(frame: PatchFrame, *, points: int) -> Iterator[pb.Patch]:
    """Build what carries one frame of a cloud of `points` rows: a few messages if it is too large for one."""
    for start in range(0, len(frame.indices), MAX_PATCH_POINTS):
        rows = slice(start, start + MAX_PATCH_POINTS)
        yield pb.Patch(
            iteration=frame.iteration,
            final=frame.final,
            progress=frame.progress,
            indices=frame.indices[rows].tolist(),
            xyz=frame.xyz[rows].ravel().tolist(),
            points=points,
        )


def frame_of(patch: pb.Patch) -> PatchFrame:
    """Return the frame that a message carries."""
    indices = np.array(patch.indices, np.uint32)
    xyz = np.array(patch.xyz, np.float64).reshape(-1, 3)
    return PatchFrame(patch.iteration, patch.final, False, patch.progress, indices, xyz)


def _fill(message: Message, values: Mapping[str, Any]) -> None:
    for field in message.DESCRIPTOR.fields:
        value = values.get(field.name)
        if value is None:
            continue
        if field.message_type is None:
            _set(message, field, value)
        elif field.is_repeated:
            for item in value:
                _fill(getattr(message, field.name).add(), item)
        elif field.message_type is Timestamp.DESCRIPTOR:
            getattr(message, field.name).FromJsonString(value)
        elif field.message_type is pb.DenoiseOptions.DESCRIPTOR:
            getattr(message, field.name).CopyFrom(_options(value))
        else:
            part = getattr(message, field.name)
            part.SetInParent()
            _fill(part, value)


def _options(options: Mapping[str, Any]) -> pb.DenoiseOptions:
    iterations = options["iterations"]
    return pb.DenoiseOptions(
        iterations=None if iterations == "auto" else iterations,
        seed=options["seed"],
        strength=options["strength"],
        recompute_normals=options["normals"] == "recompute",
    )


def _set(message: Message, field: Any, value: Any) -> None:
    if field.enum_type is not None:
        value = (
            [_number(field.enum_type, name) for name in value] if field.is_repeated else _number(field.enum_type, value)
        )
    if field.is_repeated:
        getattr(message, field.name).extend(value)
    else:
        setattr(message, field.name, value)


def _plain_field(message: Message, field: Any) -> Any:
    if field.has_presence and not message.HasField(field.name):
        return None
    value = getattr(message, field.name)
    if field.is_repeated:
        return [plain_of(item) for item in value] if field.message_type is not None else list(value)
    if isinstance(value, Timestamp):
        return value.ToDatetime(tzinfo=UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    if field.message_type is not None:
        return plain_of(value)
    if field.enum_type is not None:
        return name_of(field.enum_type, value)
    return value


def name_of(kind: EnumDescriptor, number: int) -> str:
    """Return an enum's value as JSON has it, JOB_STATE_QUEUED as "queued"; raises KeyError where there is none."""
    return str(kind.values_by_number[number].name.removeprefix(_prefix(kind)).lower())


def _number(kind: EnumDescriptor, name: str) -> int:
    return int(kind.values_by_name[_prefix(kind) + name.upper()].number)


def _prefix(kind: EnumDescriptor) -> str:
    """Return what the style guide puts before every value of an enum: JobState -> JOB_STATE_."""
    return kind.values[0].name.removesuffix("UNSPECIFIED")
