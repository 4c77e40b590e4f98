"""PCD: ascii, binary and binary_compressed; everything but moved positions is kept as it stands."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import NORMALS, PointCloud
from straightpcf.points.errors import MalformedFile
from straightpcf.points.formats import lzf
from straightpcf.points.formats.base import Format, check_count, check_room, check_unpacked
from straightpcf.points.formats.colours import PACKED, packed
from straightpcf.points.formats.pcd_header import MAX_FIELDS, PcdField, PcdHeader, read_header
from straightpcf.points.formats.positions import AXES, WRITTEN, changes, moved, put_positions, rounding, widened
from straightpcf.points.formats.scalars import check_columns, scalar_columns, with_intensity
from straightpcf.points.formats.text import (
    Lines,
    as_integers,
    as_numbers,
    begin_of_text,
    blocks,
    refuse_binary,
    replaced,
    shown,
)

__all__ = ["Pcd"]

_MOST_LOST = 1e-6  # of a new file's extent, by float positions; those of an object or a frame lose 1e-7
_FLOATS = frozenset(("intensity", "curvature", *NORMALS[1]))  # of PCL's point types: until 1.15 it reads no other there
_Tokens = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]  # where each begins, and where it ends
_TYPES = ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8")


@dataclass(frozen=True)
class PcdSource:
    """Hold the file, its parsed header and the positions that were read from it.

    tokens: where those of a text file begin and end, (N,) int64 byte offsets of each axis and of the normals.
    unpacked: of a compressed one.
    """

    raw: bytes
    header: PcdHeader
    xyz: npt.NDArray[np.float64]
    tokens: dict[str, _Tokens] | None = None
    unpacked: bytes | None = None


class Pcd(Format):
    """Read and write PCD; x, y and z, or X, Y and Z, must be fields of one float."""

    name = "pcd"
    suffixes = (".pcd",)
    media_type = "application/vnd.pcl.pcd"
    writes_normals = True
    types = _TYPES

    def sniff(self, head: bytes) -> bool:
        """Recognise the comment that PCL writes, or the first keyword after comments."""
        head = head[begin_of_text(head) :]
        if head.startswith(b"# .PCD"):
            return True
        lines = (line.strip() for line in head.split(b"\n"))
        first = next((line for line in lines if line and not line.startswith(b"#")), b"")
        return first.split()[:1] in ([b"VERSION"], [b"FIELDS"], [b"COLUMNS"])

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read all fields; those with COUNT > 1 become (N, COUNT) attributes."""
        raw = path.read_bytes()
        header = read_header(raw)
        check_count(header.points, max_points, where="PCD POINTS")
        if header.encoding == "ascii":
            return _read_ascii(raw, header)
        unpacked = _unpacked(raw, header) if header.encoding == "binary_compressed" else None
        columns = _columns(raw, header) if unpacked is None else _planes(unpacked, header)
        xyz = widened([columns[axis] for axis in header.axes])
        source = PcdSource(raw, header, xyz.copy(), unpacked=unpacked)
        return PointCloud(xyz, _attributes(columns, header), source, beside=header.beside)

    def check(self, cloud: PointCloud) -> None:
        """Raise UnsupportedCloud where a new file has more fields than one may."""
        if not isinstance(cloud.source, PcdSource):
            check_columns(packed(cloud.attributes), MAX_FIELDS, what="PCD")

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the file that was read with its positions replaced, or a new binary one."""
        source = cloud.source
        if not isinstance(source, PcdSource):
            self.check(cloud)
            path.write_bytes(_new_file(cloud))
            return
        names, new, old = changes(cloud, source.xyz, source.header.axes)
        if not moved(new, old).any():
            path.write_bytes(source.raw)
        elif source.tokens is not None:
            starts = np.stack([source.tokens[name][0] for name in names], axis=1)
            ends = np.stack([source.tokens[name][1] for name in names], axis=1)
            path.write_bytes(replaced(source.raw, starts, ends, new, old))
        elif source.unpacked is not None:
            path.write_bytes(_repacked(source, source.unpacked, names, new, old))
        else:
            out = bytearray(source.raw)
            put_positions(_columns(out, source.header), new, old, names)
            path.write_bytes(out)


def _attributes(columns: dict[str, npt.NDArray[Any]], header: PcdHeader) -> dict[str, npt.NDArray[Any]]:
    return {name: values for name, values in columns.items() if name not in header.axes and name.strip("_")}


def _columns(raw: bytes | bytearray, header: PcdHeader) -> dict[str, npt.NDArray[Any]]:
    """View the rows of a binary file."""
    dtype = header.row_dtype
    check_room(header.points * dtype.itemsize, len(raw) - header.size, what=f"PCD data of {header.points} points")
    rows = np.frombuffer(raw, dtype, header.points, header.size) if header.points else np.empty(0, dtype)
    return {field.label: rows[field.label] for field in header.fields}


def _unpacked(raw: bytes, header: PcdHeader) -> bytes:
    expected = header.points * header.row_dtype.itemsize
    if expected == 0 and len(raw) < header.size + 8:
        return b""
    check_room(8, len(raw) - header.size, what="the two sizes before compressed PCD data")
    packed_size, size = struct.unpack_from("<II", raw, header.size)
    if size != expected:
        raise MalformedFile(f"compressed PCD data declares {size} bytes unpacked, the header's fields need {expected}")
    check_room(packed_size, len(raw) - header.size - 8, what=f"compressed PCD data at byte {header.size + 8}")
    check_unpacked(size, len(raw), what="compressed PCD data")
    return lzf.decompress(raw[header.size + 8 : header.size + 8 + packed_size], size)


def _planes(unpacked: bytes | bytearray, header: PcdHeader) -> dict[str, npt.NDArray[Any]]:
    """View the fields of an unpacked file: one after the other, each for all points."""
    columns: dict[str, npt.NDArray[Any]] = {}
    at = 0
    for field in header.fields:
        values = header.points * field.count
        plane = np.frombuffer(unpacked, field.dtype, values, at) if values else np.empty(0, field.dtype)
        columns[field.label] = plane.reshape(header.points, field.count) if field.count != 1 else plane
        at += values * field.dtype.itemsize
    return columns


def _repacked(
    source: PcdSource,
    unpacked: bytes,
    names: tuple[str, ...],
    new: npt.NDArray[np.float64],
    old: npt.NDArray[np.float64],
) -> bytes:
    out = bytearray(unpacked)
    put_positions(_planes(out, source.header), new, old, names)
    packed = lzf.compress(out)
    begin = source.header.size
    (packed_size,) = struct.unpack_from("<I", source.raw, begin)
    sizes = struct.pack("<II", len(packed), len(out))
    return b"".join([source.raw[:begin], sizes, packed, source.raw[begin + 8 + packed_size :]])


def _read_ascii(raw: bytes, header: PcdHeader) -> PointCloud:
    parts: dict[str, list[npt.NDArray[Any]]] = {field.label: [] for field in header.fields}
    tokens: dict[str, list[_Tokens]] = {name: [] for name in WRITTEN.intersection(parts)}
    for rows, numbers in _ascii_rows(raw, header):
        at = 0
        for field in header.fields:
            index = (rows.first[:, None] + np.arange(at, at + field.count)).reshape(-1)
            first, last = rows.starts[index], rows.ends[index]
            parts[field.label].append(_text_values(raw, first, last, field, numbers))
            if field.label in tokens:
                tokens[field.label].append((first, last))
            at += field.count
    found = {
        field.label: np.concatenate(parts[field.label]) if parts[field.label] else np.empty(0, field.dtype)
        for field in header.fields
    }
    for name in PACKED:  # four bytes that are called a float, and may come from a number of text
        if name in found and found[name].dtype.kind == "f":
            with np.errstate(over="ignore"):
                found[name] = np.where(np.isnan(found[name]), np.nan, found[name]).astype(np.float32)
    xyz = widened([found[axis] for axis in header.axes])
    none = np.empty(0, np.int64)
    where = {
        name: (np.concatenate([none, *(p[0] for p in places)]), np.concatenate([none, *(p[1] for p in places)]))
        for name, places in tokens.items()
    }
    source = PcdSource(raw, header, xyz.copy(), where)
    return PointCloud(xyz, _attributes(found, header), source, beside=header.beside)


def _ascii_rows(raw: bytes, header: PcdHeader) -> Iterator[tuple[Lines, npt.NDArray[np.int64]]]:
    """Yield the lines of points, some at a time, with their numbers; raises MalformedFile where they are no table."""
    refuse_binary(raw, header.size)
    width = sum(field.count for field in header.fields)
    check_room(
        max(2 * width * header.points - 1, 0),
        len(raw) - header.size,
        what=f"PCD data of {header.points} points with {width} values",
    )
    left, line = header.points, header.lines + 1
    for lines, _ in blocks(raw, header.size):
        filled = np.flatnonzero(lines.counts)  # PCL skips blank lines
        if len(filled) > left and lines.counts[filled[left]] == width:
            raise MalformedFile(f"PCD POINTS is {header.points}, and line {line + filled[left]} is one more")
        filled = filled[:left]
        rows, numbers = lines.pick(filled), line + filled
        wrong = rows.counts != width
        if wrong.any():
            row = int(np.argmax(wrong))
            raise MalformedFile(f"line {numbers[row]} has {rows.counts[row]} values, the PCD fields have {width}")
        yield rows, numbers
        line, left = line + len(lines), left - len(rows)
    if left:
        raise MalformedFile(
            f"PCD POINTS is {header.points}, the file ends after {header.points - left}: it is truncated"
        )


def _text_values(
    raw: bytes,
    first: npt.NDArray[np.int64],
    last: npt.NDArray[np.int64],
    field: PcdField,
    numbers: npt.NDArray[np.int64],
) -> npt.NDArray[Any]:
    """Read the tokens of a field in lines of these numbers, (K,): (K,) or (K, COUNT)."""
    values, bad = _as_numbers(raw, first, last, field)
    if bad is not None:
        token = shown(raw[first[bad] : last[bad]])
        raise MalformedFile(f"line {numbers[bad // field.count]}: {field.label} is {token}, no {field.dtype.name}")
    return values if field.count == 1 else values.reshape(-1, field.count)


def _as_numbers(
    raw: bytes, first: npt.NDArray[np.int64], last: npt.NDArray[np.int64], field: PcdField
) -> tuple[npt.NDArray[Any], int | None]:
    if field.dtype.kind == "f":
        return as_numbers(raw, first, last)
    if field.label in PACKED and field.dtype == np.int32:  # a colour with alpha is often written as if it had no sign
        values, bad = as_integers(raw, first, last, np.dtype("<u4"))
        if bad is None:
            return values.view("<i4"), None
    return as_integers(raw, first, last, field.dtype)


def _position_type(xyz: npt.NDArray[np.float64]) -> str:
    """Choose float, the only one that PCL's point types and Open3D take, where it holds (N, 3) well; else double."""
    with np.errstate(over="ignore", invalid="ignore"):
        stored = xyz.astype("<f4")
        lost, half = rounding(xyz, stored)
    is_held = np.array_equal(np.isfinite(stored), np.isfinite(xyz))
    return "<f4" if is_held and lost / 2 <= _MOST_LOST * half else "<f8"


def _float(name: str, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return (N,) numbers as float32 where that says the same, of a normal where it has a place for them at all."""
    with np.errstate(over="ignore", invalid="ignore"):
        stored = values.astype("<f4")
        again = stored.astype(values.dtype)
    if name in NORMALS[1] and values.dtype.kind == "f":  # whole numbers are no normal
        return stored if np.array_equal(np.isfinite(stored), np.isfinite(values)) else values
    others = moved(again, values)
    # Of a text, 0.4 is the float32 that is written so.
    is_said = not others.any() or np.array_equal(stored[others].astype(str).astype(np.float64), values[others])
    return stored if is_said else values


def _new_file(cloud: PointCloud) -> bytes:
    """Write a binary file with positions and every attribute as fields of one value."""
    kind = _position_type(cloud.xyz)
    columns = {axis: cloud.xyz[:, column].astype(kind) for column, axis in enumerate(AXES)}
    further = scalar_columns(packed(with_intensity(cloud.new_attributes(NORMALS[1]))), _TYPES, taken=AXES)
    columns |= {name: _float(name, values) if name in _FLOATS else values for name, values in further.items()}
    table = np.empty(len(cloud), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    kinds = [values.dtype for values in columns.values()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {len(cloud)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(cloud)}",
        "DATA binary",
        "",
    ]
    return "\n".join(header).encode() + table.tobytes()
