"""The patch stream: finished patches as framed bytes (docs/api.md, `application/vnd.straightpcf.patches`)."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile

__all__ = [
    "BYTES_PER_POINT",
    "PATCHES_MEDIA_TYPE",
    "PatchFrame",
    "PatchReader",
    "encode_end",
    "encode_frame",
    "encode_header",
]

PATCHES_MEDIA_TYPE = "application/vnd.straightpcf.patches"
_MAGIC, _VERSION = b"SPCP", 1
_HEADER = struct.Struct("<4sHHQ")
_FRAME = struct.Struct("<IHHfI")  # length of what follows it, iteration, flags, progress, n
_FINAL, _END = 1, 2
BYTES_PER_POINT = 4 + 3 * 8  # of each pass
_MAX_FRAME_POINTS = 2**24  # a frame is one patch; more is not a frame


@dataclass(frozen=True, eq=False)
class PatchFrame:
    """Hold one finished patch.

    indices: (n,) uint32 rows of the cloud; xyz: (n, 3) float64, the cloud's unit; final: no pass comes after this one,
    as far as is known; end: the job has succeeded and nothing follows; progress: 0..1.
    """

    iteration: int
    final: bool
    end: bool
    progress: float
    indices: npt.NDArray[np.uint32]
    xyz: npt.NDArray[np.float64]


def encode_header(points: int) -> bytes:
    """Begin a stream about a cloud of `points` rows."""
    return _HEADER.pack(_MAGIC, _VERSION, 0, points)


def encode_frame(
    indices: npt.NDArray[np.integer], xyz: npt.NDArray[np.float64], *, iteration: int, final: bool, progress: float
) -> bytes:
    """Encode (n,) rows and their (n, 3) positions."""
    return _frame(indices, xyz, iteration, _FINAL if final else 0, progress)


def encode_end(iteration: int) -> bytes:
    """Close the stream of a job that succeeded after `iteration` passes."""
    return _frame(np.empty(0, np.uint32), np.empty((0, 3)), iteration, _FINAL | _END, 1.0)


def _frame(
    indices: npt.NDArray[np.integer], xyz: npt.NDArray[np.float64], iteration: int, flags: int, progress: float
) -> bytes:
    count = len(indices)
    length = _FRAME.size - 4 + count * BYTES_PER_POINT
    head = _FRAME.pack(length, iteration, flags, progress, count)
    return b"".join([head, indices.astype("<u4").tobytes(), xyz.astype("<f8").tobytes()])


class PatchReader:
    """Decode a stream that comes in chunks of any size; `points` is None until the header is there."""

    def __init__(self) -> None:
        self.points: int | None = None
        self._buffer = bytearray()

    def feed(self, chunk: bytes) -> list[PatchFrame]:
        """Take the next bytes and return the frames that they complete; raises MalformedFile."""
        self._buffer += chunk
        if self.points is None:
            if len(self._buffer) < _HEADER.size:
                return []
            magic, version, _, self.points = _HEADER.unpack_from(self._buffer)
            if magic != _MAGIC or version != _VERSION:
                raise MalformedFile(f"a patch stream begins with {_MAGIC!r} 1, this one with {magic!r} {version}")
            del self._buffer[: _HEADER.size]
        frames, at = [], 0
        while len(self._buffer) - at >= _FRAME.size:
            length, iteration, flags, progress, count = _FRAME.unpack_from(self._buffer, at)
            if count > _MAX_FRAME_POINTS or length != _FRAME.size - 4 + count * BYTES_PER_POINT:
                raise MalformedFile(f"a patch frame of {count} points cannot have {length} bytes")
            if len(self._buffer) - at < 4 + length:
                break
            rows = bytes(self._buffer[at + _FRAME.size : at + 4 + length])
            indices = np.frombuffer(rows, "<u4", count).astype(np.uint32)
            xyz = np.frombuffer(rows, "<f8", 3 * count, offset=4 * count).reshape(count, 3).astype(np.float64)
            frames.append(PatchFrame(iteration, bool(flags & _FINAL), bool(flags & _END), progress, indices, xyz))
            at += 4 + length
        del self._buffer[:at]
        return frames
