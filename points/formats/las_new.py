"""A new LAS file for a cloud of another format: a scale that fits, attributes as dimensions or extra bytes."""

from __future__ import annotations

import math
import struct
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import UnsupportedCloud
from straightpcf.points.formats.colours import RGB, in_16_bits
from straightpcf.points.formats.las_layout import (
    EXTRA_BYTES_ID,
    LasDimension,
    record_bytes,
    standard_bytes,
    standard_dimensions,
)
from straightpcf.points.formats.positions import check_held, from_middle, rounding
from straightpcf.points.formats.scalars import meant, scalar_columns

__all__ = ["TAKEN", "TYPES", "as_dimensions", "check_new", "new_las", "renamed"]

FINEST_USUAL_SCALE = 1e-4
_MOST_LOST = 1e-4  # of the extent of most points, by rounding to a step of the scale
MAX_EXTRA_DIMENSIONS = 300
_MOST_DIMENSIONS = 3  # the point format that is written at most: with times and colours
_HEADER_BYTES = 227
TAKEN = ("x", "y", "z", "X", "Y", "Z")  # laspy calls positions and their integers so
TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
# What laspy calls the bytes of bit fields, and parts of its own record: it opens no file with such dimensions.
_RESERVED = ("bit_fields", "raw_classification", "header", "scales", "offsets")


def check_new(cloud: PointCloud) -> None:
    """Raise UnsupportedCloud where `new_las` would."""
    _quantised(cloud.xyz)
    _laid_out(cloud)


def renamed(cloud: PointCloud) -> list[str]:
    """Say which columns become extra bytes of another name: theirs is a dimension's, or longer than 32 bytes."""
    *_, labels = _laid_out(cloud)
    short = [name.decode("utf-8", "replace") for name in _short_names(labels)]
    return [f"{was} (renamed to {now})" for was, now in zip(labels.values(), short, strict=True) if was != now]


def as_dimensions(attributes: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Return attributes with those that a standard dimension holds called as it is; a colour as it was."""
    known = {name: where for name, where in standard_dimensions(_MOST_DIMENSIONS).items() if name not in RGB}
    called = {}
    for name, was in meant(attributes, known).items():
        values = attributes[was]
        if values.ndim == 1 and values.dtype.kind in "biuf" and _fits(values, known[name]):
            called[was] = name
    return {called.get(name, name): values for name, values in attributes.items()}


def new_las(cloud: PointCloud) -> bytes:
    """Return a LAS 1.2 file, uncompressed; raises UnsupportedCloud where positions are not finite or lie too far apart.

    Attributes with the name of a standard dimension that fit into it take its place, the others become extra bytes.
    """
    scales, offsets, integers = _quantised(cloud.xyz)
    point_format, held, extra, _ = _laid_out(cloud)
    standard = standard_dimensions(point_format)
    points = np.zeros((len(cloud), standard_bytes(point_format)), np.uint8)
    points[:, :12] = integers.astype("<i4").view(np.uint8)
    for name, values in held.items():
        _put(points, values, standard[name])
    rows = np.hstack([points, *map(_bytes, extra.values())])
    record = _extra_bytes_record(extra)
    begin = _HEADER_BYTES + len(record)
    head = _header(len(cloud), begin, 1 if extra else 0, point_format, rows.shape[1])
    head += struct.pack("<5I", *_by_return(held.get("return_number"), len(cloud)))
    head += struct.pack("<6d", *scales, *offsets)
    for axis in range(3):
        bounds = (integers[:, axis].max(), integers[:, axis].min()) if len(cloud) else (0, 0)
        head += struct.pack("<2d", *(float(bound * scales[axis] + offsets[axis]) for bound in bounds))
    return head + record + rows.tobytes()


def _laid_out(
    cloud: PointCloud,
) -> tuple[int, dict[str, npt.NDArray[Any]], dict[str, npt.NDArray[Any]], dict[str, str]]:
    """Return the point format, the columns that its dimensions hold, those of extra bytes, and what these were called.

    The last by the names that they have now.
    """
    columns = scalar_columns(in_16_bits(as_dimensions(cloud.in_columns())), TYPES, taken=TAKEN)
    has_rgb = all(name in columns and columns[name].dtype == np.uint16 for name in RGB)
    has_time = "gps_time" in columns and _is_double(columns["gps_time"])
    point_format = 2 * has_rgb + has_time
    standard = standard_dimensions(point_format)
    held = {n: values for n, values in columns.items() if n in standard and _fits(values, standard[n])}
    labels = _labels([name for name in columns if name not in held], columns, {*standard, *_RESERVED})
    extra = {label: columns[name] for label, name in labels.items()}
    if len(extra) > MAX_EXTRA_DIMENSIONS:
        raise UnsupportedCloud(
            f"{len(extra)} attributes are more than the {MAX_EXTRA_DIMENSIONS} that LAS extra bytes hold"
        )
    return point_format, held, extra, labels


def _check_positions(xyz: npt.NDArray[np.float64]) -> None:
    check_held(xyz, np.isfinite(xyz).all(axis=1), "; LAS has no place for NaN and infinity")
    if len(xyz) and np.abs(xyz).max() > 1e100:
        raise UnsupportedCloud(f"a coordinate of {np.abs(xyz).max():g} is beyond 1e100, which LAS is not written for")


def _quantised(xyz: npt.NDArray[np.float64]) -> tuple[list[float], list[float], npt.NDArray[np.int32]]:
    if not len(xyz):
        return [FINEST_USUAL_SCALE] * 3, [0.0] * 3, np.empty((0, 3), np.int32)
    _check_positions(xyz)
    lowest, highest = xyz.min(axis=0), xyz.max(axis=0)
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
    lost, half = rounding(xyz, integers * scale + offsets)
    if 0 < _MOST_LOST * half < lost / 2:
        row = int(np.argmax(from_middle(xyz)))
        raise UnsupportedCloud(
            f"point {row}, {xyz[row].tolist()}, lies so far from most that the 32 bits of LAS would put these up to "
            f"{lost:.3g} off, more than {_MOST_LOST:g} of their extent ({2 * half:.6g}): take it out, or another format"
        )
    return [scale] * 3, offsets, integers.astype(np.int32)


def _is_double(values: npt.NDArray[Any]) -> bool:
    """Say whether (N,) numbers are the same as float64."""
    return values.dtype.kind == "f" or values.dtype.itemsize < 8


def _fits(values: npt.NDArray[Any], dimension: LasDimension) -> bool:
    """Say whether (N,) numbers are ones that the dimension holds."""
    if dimension.dtype.kind == "f":
        return _is_double(values)
    limits = np.iinfo(dimension.dtype)
    low, high = limits.min, limits.max if dimension.bits is None else (1 << dimension.bits) - 1
    with np.errstate(invalid="ignore"):  # a signalling NaN is no warning
        if values.dtype.kind == "f" and values.dtype.itemsize == 2:
            values = values.astype(np.float32)  # to a half 65535 is infinity
        return bool(((values >= low) & (values <= high) & (values == np.rint(values))).all())


def _put(points: npt.NDArray[np.uint8], values: npt.NDArray[Any], dimension: LasDimension) -> None:
    """Store (N,) numbers that fit in (N, M) points, beside the other bits of a byte."""
    stored = values.astype(dimension.dtype) << dimension.shift if dimension.bits else values.astype(dimension.dtype)
    points[:, dimension.at : dimension.at + dimension.dtype.itemsize] |= _bytes(stored)


def _bytes(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """View (N,) numbers as (N, bytes of each)."""
    return np.ascontiguousarray(values).view(np.uint8).reshape(len(values), values.dtype.itemsize)


def _labels(names: Iterable[str], taken: Collection[str], reserved: Collection[str]) -> dict[str, str]:
    """Return what extra bytes of these names are called, none with a reserved name: laspy would not open the file."""
    labels: dict[str, str] = {}
    for name in names:
        label = name
        while label in reserved or (label != name and label in taken):
            label = f"extra_{label}"
        labels[label] = name
    return labels


def _extra_bytes_record(extra: dict[str, npt.NDArray[Any]]) -> bytes:
    if not extra:
        return b""
    body = b"".join(
        struct.pack("<2xBx32s156x", TYPES.index(values.dtype.str[1:]) + 1, name)
        for name, values in zip(_short_names(extra), extra.values(), strict=True)
    )
    return record_bytes(EXTRA_BYTES_ID, body, b"Extra Bytes Record")


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
    return software + sizes + struct.pack("<BHI", point_format, row_bytes, points)


def _by_return(numbers: npt.NDArray[Any] | None, points: int) -> list[int]:
    """Count the points of each of five returns; all are first ones where no (N,) numbers say otherwise."""
    return [points, 0, 0, 0, 0] if numbers is None else [int((numbers == which).sum()) for which in range(1, 6)]
