"""A new LAS file for a cloud of another format: a scale that fits, attributes as dimensions or extra bytes."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import UnsupportedCloud
from straightpcf.points.formats.scalars import scalar_columns

__all__ = ["TYPES", "new_las"]

FINEST_USUAL_SCALE = 1e-4
MAX_EXTRA_DIMENSIONS = 300
_HEADER_BYTES = 227
TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
_RGB = ("red", "green", "blue")


def new_las(cloud: PointCloud) -> bytes:
    """Return a LAS 1.2 file, uncompressed; raises UnsupportedCloud where a position is NaN or infinite.

    Attributes with the name and type of a standard dimension take its place, the others become extra bytes.
    """
    scales, offsets, integers = _quantised(cloud.xyz)
    columns = scalar_columns(cloud.attributes, TYPES, taken=("x", "y", "z", "X", "Y", "Z"))
    has_rgb = all(name in columns and columns[name].dtype == np.uint16 for name in _RGB)
    has_time = "gps_time" in columns and columns["gps_time"].dtype == np.float64
    point_format = 2 * has_rgb + has_time
    dtype = _row_dtype(has_time=has_time, has_rgb=has_rgb)
    extra = {name: values for name, values in columns.items() if not _is_standard(dtype, name, values)}
    if len(extra) > MAX_EXTRA_DIMENSIONS:
        raise UnsupportedCloud(
            f"{len(extra)} attributes are more than the {MAX_EXTRA_DIMENSIONS} that LAS extra bytes hold"
        )
    labels = {name: f"extra {number}" for number, name in enumerate(extra)}  # a label of its own beside "intensity"
    rows = np.zeros(len(cloud), np.dtype([*dtype.descr, *((labels[n], v.dtype.str) for n, v in extra.items())]))
    for axis, name in enumerate(("X", "Y", "Z")):
        rows[name] = integers[:, axis]
    for name, values in columns.items():
        rows[labels.get(name, name)] = values
    record = _extra_bytes_record(extra)
    begin = _HEADER_BYTES + len(record)
    head = _header(len(cloud), begin, 1 if extra else 0, point_format, rows.dtype.itemsize)
    head += struct.pack("<6d", *scales, *offsets)
    for axis in range(3):
        bounds = (integers[:, axis].max(), integers[:, axis].min()) if len(cloud) else (0, 0)
        head += struct.pack("<2d", *(float(bound * scales[axis] + offsets[axis]) for bound in bounds))
    return head + record + rows.tobytes()


def _quantised(xyz: npt.NDArray[np.float64]) -> tuple[list[float], list[float], npt.NDArray[np.int32]]:
    if not len(xyz):
        return [FINEST_USUAL_SCALE] * 3, [0.0] * 3, np.empty((0, 3), np.int32)
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise UnsupportedCloud(f"point {row} is {xyz[row].tolist()}; LAS has no place for NaN and infinity")
    lowest, highest = xyz.min(axis=0), xyz.max(axis=0)
    if np.abs(xyz).max() > 1e100:
        raise UnsupportedCloud(f"a coordinate of {np.abs(xyz).max():g} is beyond 1e100, which LAS is not written for")
    extent = max(float((highest - lowest).max()), 1e-12)
    finest = 10.0 ** math.ceil(math.log10(extent / 2e9))
    scale = max(finest, min(FINEST_USUAL_SCALE, 10.0 ** (math.floor(math.log10(extent)) - 6)))
    offsets = [
        math.floor(low / scale / 1e6) * 1e6 * scale if abs(low) > 1e-3 / scale else 0.0 for low in lowest.tolist()
    ]
    integers = np.rint((xyz - offsets) / scale)
    if np.abs(integers).max() >= 2**31:
        offsets = lowest.tolist()
        integers = np.rint((xyz - offsets) / scale)
    return [scale] * 3, offsets, integers.astype(np.int32)


def _row_dtype(*, has_time: bool, has_rgb: bool) -> np.dtype[Any]:
    fields = [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("returns", "u1")]
    fields += [("classification", "u1"), ("scan_angle_rank", "i1"), ("user_data", "u1"), ("point_source_id", "<u2")]
    fields += [("gps_time", "<f8")] if has_time else []
    fields += [(name, "<u2") for name in _RGB] if has_rgb else []
    return np.dtype(fields)


def _is_standard(dtype: np.dtype[Any], name: str, values: npt.NDArray[Any]) -> bool:
    # The classification byte of these point formats holds five bits and three flags: not for any u1.
    return name not in ("classification", "returns") and name in (dtype.names or ()) and dtype[name] == values.dtype


def _extra_bytes_record(extra: dict[str, npt.NDArray[Any]]) -> bytes:
    if not extra:
        return b""
    body = b"".join(
        struct.pack("<2xBx32s156x", TYPES.index(values.dtype.str[1:]) + 1, name)
        for name, values in zip(_short_names(extra), extra.values(), strict=True)
    )
    return struct.pack("<H16sHH32s", 0, b"LASF_Spec", 4, len(body), b"Extra Bytes Record") + body


def _short_names(names: Iterable[str]) -> list[bytes]:
    """Cut names to the 32 bytes that a record has for each, numbered where they would then be the same."""
    short: list[bytes] = []
    for name in names:
        cut, number = name.encode()[:32], 2
        while cut in short:
            suffix = b"_%d" % number
            cut, number = name.encode()[: 32 - len(suffix)] + suffix, number + 1
        short.append(cut)
    return short


def _header(points: int, begin: int, records: int, point_format: int, row_bytes: int) -> bytes:
    if points > 0xFFFFFFFF:
        raise UnsupportedCloud(f"{points} points are more than the 4294967295 that LAS 1.2 holds")
    software = struct.pack("<4sHH16sBB32s32s", b"LASF", 0, 0, b"", 1, 2, b"OTHER", b"straightpcf")
    sizes = struct.pack("<HHHII", 1, 2024, _HEADER_BYTES, begin, records)
    return software + sizes + struct.pack("<BHI5I", point_format, row_bytes, points, points, 0, 0, 0, 0)
