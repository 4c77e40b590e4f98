"""LZF, the compression of binary_compressed PCD: literal runs and back references, no checksum."""

from __future__ import annotations

import numpy as np

from straightpcf.points.errors import MalformedFile

__all__ = ["compress", "decompress"]

PERIOD = 4  # repeats are looked for one float32 or int32 back
MAX_LITERAL = 32
MAX_MATCH = 264
MAX_RATIO = MAX_MATCH / 3 + 1


def decompress(packed: bytes, size: int) -> bytes:
    """Unpack to exactly `size` bytes; raises MalformedFile naming the byte where the stream is wrong."""
    if size > MAX_RATIO * len(packed):
        raise MalformedFile(f"{len(packed)} LZF bytes cannot unpack to {size} bytes; the most is {MAX_RATIO:g} for one")
    out = bytearray()
    at, end = 0, len(packed)
    try:
        while at < end:
            control = packed[at]
            at += 1
            if control < MAX_LITERAL:
                out += packed[at : at + control + 1]
                at += control + 1
            else:
                length = control >> 5
                if length == 7:
                    length += packed[at]
                    at += 1
                distance = ((control & 31) << 8) + packed[at] + 1
                at += 1
                length += 2
                begin = len(out) - distance
                if begin < 0:
                    raise MalformedFile(f"LZF byte {at - 1} refers {distance} back, only {len(out)} are unpacked")
                if distance >= length:
                    out += out[begin : begin + length]
                else:
                    out += (out[begin:] * (length // distance + 1))[:length]
            if len(out) > size:
                raise MalformedFile(f"the LZF stream unpacks to more than the {size} bytes declared, at byte {at}")
    except IndexError as exc:
        raise MalformedFile(f"the LZF stream ends at byte {end} within a back reference") from exc
    if at > end or len(out) != size:
        raise MalformedFile(f"the LZF stream of {end} bytes unpacks to {len(out)} bytes, {size} are declared")
    return bytes(out)


def compress(data: bytes | bytearray) -> bytes:
    """Pack into a valid LZF stream: values that repeat become back references, everything else literal runs.

    Only repeats of the value before are sought: that is what images with empty regions and labels have, and numpy
    finds them; a full search would take minutes in Python.
    """
    values = np.frombuffer(data, np.uint8)
    same = values[PERIOD:] == values[:-PERIOD]
    edges = np.diff(same.view(np.int8), prepend=np.int8(0), append=np.int8(0))
    starts, ends = np.flatnonzero(edges == 1) + PERIOD, np.flatnonzero(edges == -1) + PERIOD
    long = ends - starts >= 3
    pieces: list[bytes] = []
    at = 0
    for start, end in zip(starts[long].tolist(), ends[long].tolist(), strict=True):
        _literals(data, at, start, pieces)
        _matches(end - start, pieces)
        at = end
    _literals(data, at, len(data), pieces)
    return b"".join(pieces)


def _literals(data: bytes | bytearray, begin: int, end: int, pieces: list[bytes]) -> None:
    for at in range(begin, end, MAX_LITERAL):
        run = data[at : min(at + MAX_LITERAL, end)]
        pieces.append(bytes([len(run) - 1]))
        pieces.append(bytes(run))


def _matches(length: int, pieces: list[bytes]) -> None:
    while length:
        step = min(length, MAX_MATCH)
        if 0 < length - step < 3:  # a match has at least three bytes
            step -= 3
        short = step - 2
        pieces.append(bytes([short << 5, PERIOD - 1] if short < 7 else [7 << 5, short - 7, PERIOD - 1]))
        length -= step
