"""Whole numbers in as many bits as they need, the lowest first, without gaps between them: E57's bitPackCodec."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["bits_packed", "bits_unpacked"]

_AT_ONCE = 1 << 16  # a multiple of 8: every part begins with a byte


def bits_unpacked(stream: bytes, bits: int, count: int) -> npt.NDArray[np.int64]:
    """Return (count,) numbers of `bits` bits; those of 64 are as they are in two's complement."""
    whole = np.zeros(count, np.int64)
    packed = np.frombuffer(stream, np.uint8)
    for begin in range(0, count if bits else 0, _AT_ONCE):
        some = whole[begin : begin + _AT_ONCE]
        here = packed[begin * bits // 8 :][: (len(some) * bits + 7) // 8]
        wide = np.zeros((len(some), 64), np.uint8)
        wide[:, :bits] = np.unpackbits(here, bitorder="little", count=len(some) * bits).reshape(len(some), bits)
        some[:] = np.packbits(wide, axis=1, bitorder="little").view("<i8")[:, 0]
    return whole


def bits_packed(whole: npt.NDArray[np.int64], bits: int) -> bytes:
    """Return (N,) numbers as a stream: the inverse of `bits_unpacked`."""
    parts = []
    for begin in range(0, len(whole) if bits else 0, _AT_ONCE):
        some = np.ascontiguousarray(whole[begin : begin + _AT_ONCE]).astype("<i8").view(np.uint8).reshape(-1, 8)
        each = np.unpackbits(some, axis=1, bitorder="little")[:, :bits]
        parts.append(np.packbits(each.reshape(-1), bitorder="little").tobytes())
    return b"".join(parts)
