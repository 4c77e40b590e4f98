"""The layout of a LAS file: header, variable length records, and the dimensions of a point."""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import check_room

__all__ = [
    "COPC_ID",
    "EXTRA_BYTES_ID",
    "LASZIP_ID",
    "LasDimension",
    "LasHeader",
    "LasRecord",
    "dimensions",
    "is_geographic",
    "read_header",
    "record_bytes",
    "standard_bytes",
    "standard_dimensions",
    "value_bytes",
]

LASZIP_ID = (b"laszip encoded", 22204)
EXTRA_BYTES_ID = (b"LASF_Spec", 4)
COPC_ID = (b"copc", 1)
_GEO_KEYS_ID, _WKT_ID = (b"LASF_Projection", 34735), (b"LASF_Projection", 2112)
_GEOGRAPHIC = (1024, 0, 1, 2)  # GTModelTypeGeoKey, its value in place, one of them: latitude and longitude
# What a text of a reference system (WKT, of 2001 and of 2019) says of the kind that it is, in any case and with spaces.
_OTHER_SYSTEMS = re.compile(
    rb"(PROJ(CS|CRS|ECTEDCRS)|GEOCCS|LOCAL_CS|ENG(INEERING)?CRS|CARTESIAN)\s*[\[(,]", re.IGNORECASE
)
_GEOGRAPHIC_SYSTEMS = re.compile(rb"(GEOG(CS|CRS|RAPHICCRS)|GEOD(ETIC)?CRS)\s*[\[(]", re.IGNORECASE)
_HEADER_SIZES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}
_RECORD_BYTES, _EXTENDED_BYTES = 54, 60
_MOST_EXTENDED = 10_000  # that are looked at: a broken count may be any
_EXTRA_STRUCT_BYTES = 192
_HAS_SCALE, _HAS_OFFSET = 0x08, 0x10  # bits of its options
_EXTRA_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")

# ASPRS LAS 1.4 R15, tables 7 to 17: what stands in a point besides X, Y, Z; a tuple is one byte or more of bit fields.
_Bits = tuple[tuple[str, int], ...]
_Table = tuple[tuple[str | _Bits, str], ...]
_OLD: _Table = (
    ("intensity", "u2"),
    ((("return_number", 3), ("number_of_returns", 3), ("scan_direction_flag", 1), ("edge_of_flight_line", 1)), "u1"),
    ((("classification", 5), ("synthetic", 1), ("key_point", 1), ("withheld", 1)), "u1"),
    ("scan_angle_rank", "i1"),
    ("user_data", "u1"),
    ("point_source_id", "u2"),
)
_NEW: _Table = (
    ("intensity", "u2"),
    ((("return_number", 4), ("number_of_returns", 4)), "u1"),
    (
        (
            *(("synthetic", 1), ("key_point", 1), ("withheld", 1), ("overlap", 1)),
            *(("scanner_channel", 2), ("scan_direction_flag", 1), ("edge_of_flight_line", 1)),
        ),
        "u1",
    ),
    ("classification", "u1"),
    ("user_data", "u1"),
    ("scan_angle", "i2"),
    ("point_source_id", "u2"),
    ("gps_time", "f8"),
)
_TIME: _Table = (("gps_time", "f8"),)
_RGB: _Table = (("red", "u2"), ("green", "u2"), ("blue", "u2"))
_NIR: _Table = (("nir", "u2"),)
_WAVE: _Table = (
    *(("wavepacket_index", "u1"), ("wavepacket_offset", "u8"), ("wavepacket_size", "u4")),
    *(("return_point_wave_location", "f4"), ("x_t", "f4"), ("y_t", "f4"), ("z_t", "f4")),
)
_POINT_FORMATS: tuple[_Table, ...] = (
    *(_OLD, _OLD + _TIME, _OLD + _RGB, _OLD + _TIME + _RGB, _OLD + _TIME + _WAVE, _OLD + _TIME + _RGB + _WAVE),
    *(_NEW, _NEW + _RGB, _NEW + _RGB + _NIR, _NEW + _WAVE, _NEW + _RGB + _NIR + _WAVE),
)


@dataclass(frozen=True)
class LasRecord:
    """Hold one variable length record; raw: with its header of 54 bytes."""

    user_id: bytes
    record_id: int
    raw: bytes

    @property
    def data(self) -> bytes:
        """Return the record after its header."""
        return self.raw[_RECORD_BYTES:]


@dataclass(frozen=True)
class LasDimension:
    """Say where a point has a dimension: its byte, its type, and of that the first bit and the bits of a bit field."""

    at: int
    dtype: np.dtype[Any]
    shift: int = 0
    bits: int | None = None


@dataclass(frozen=True)
class LasHeader:
    """Describe the file; scales, offsets: (3,) float64, position = scale * integer + offset.

    head: the public header as it stands.  gap: what stands between the last record and the points.
    first_extended: byte offset of the first extended record, or of waveform data, or None.
    wkt: the text of the reference system, of a record or an extended one; empty without.
    """

    minor: int
    head: bytes
    records: tuple[LasRecord, ...]
    gap: bytes
    point_format: int
    is_compressed: bool
    row_bytes: int
    points: int
    data_begin: int
    scales: npt.NDArray[np.float64]
    offsets: npt.NDArray[np.float64]
    first_extended: int | None
    wkt: bytes

    def record(self, user_id: bytes, record_id: int) -> LasRecord | None:
        """Return the first record of an identity."""
        return next((r for r in self.records if (r.user_id, r.record_id) == (user_id, record_id)), None)


def read_header(raw: bytes) -> LasHeader:
    """Parse header and records; raises MalformedFile naming the field and its value."""
    check_room(227, len(raw), what="the LAS header")
    if raw[:4] != b"LASF":
        raise MalformedFile(f"a LAS file begins with b'LASF', not {raw[:4]!r}")
    major, minor = raw[24], raw[25]
    if major != 1 or minor not in _HEADER_SIZES:
        raise UnsupportedCloud(f"LAS version {major}.{minor} is not known; 1.0 to 1.5 are")
    size, begin, count = struct.unpack_from("<HII", raw, 94)
    if size < _HEADER_SIZES[minor]:
        raise MalformedFile(f"the LAS header declares {size} bytes; version 1.{minor} has {_HEADER_SIZES[minor]}")
    check_room(size, len(raw), what="the LAS header")
    check_room(begin, len(raw), what="the LAS point data offset")
    kind, row_bytes, points = struct.unpack_from("<BHI", raw, 104)
    if minor >= 4:
        points = struct.unpack_from("<Q", raw, 247)[0] or points  # which some writers of old leave alone
    if kind & 0x40:
        raise UnsupportedCloud(f"LAS point format byte is {kind}: compression of before LASzip 1.0 is not known")
    point_format = kind & 0x3F
    if point_format >= len(_POINT_FORMATS):
        raise UnsupportedCloud(f"LAS point format {point_format} is not known; 0 to {len(_POINT_FORMATS) - 1} are")
    standard = standard_bytes(point_format)
    if row_bytes < standard:
        raise MalformedFile(f"LAS point length is {row_bytes}; point format {point_format} has {standard} bytes")
    scales, offsets = np.frombuffer(raw, "<f8", 3, 131), np.frombuffer(raw, "<f8", 3, 155)
    if not (np.isfinite(scales).all() and np.isfinite(offsets).all() and (scales != 0).all()):
        raise MalformedFile(f"LAS scales {scales.tolist()} and offsets {offsets.tolist()} must be finite, scales not 0")
    if np.abs(scales).max() > 1e200 or np.abs(offsets).max() > 1e200:
        raise MalformedFile(f"LAS scales {scales.tolist()} or offsets {offsets.tolist()} are beyond 1e200")
    records, end = _records(raw, size, count, begin)
    return LasHeader(
        minor, raw[:size], records, raw[end:begin], point_format, bool(kind & 0x80), row_bytes, points, begin,
        scales, offsets, _first_extended(raw, minor, begin), _wkt(raw, minor, records),
    )  # fmt: skip


def is_geographic(header: LasHeader) -> bool:
    """Tell whether a record says that x and y are longitude and latitude."""
    if _OTHER_SYSTEMS.search(header.wkt) is not None:
        return False
    if _GEOGRAPHIC_SYSTEMS.search(header.wkt) is not None:
        return True
    keys = header.record(*_GEO_KEYS_ID)
    data = keys.data if keys is not None else b""
    return _GEOGRAPHIC in struct.iter_unpack("<4H", data[: len(data) // 8 * 8])


def record_bytes(identity: tuple[bytes, int], data: bytes, description: bytes) -> bytes:
    """Return a variable length record: its header of 54 bytes, and its data."""
    return struct.pack("<H16sHH32s", 0, *identity, len(data), description) + data


def _records(raw: bytes, at: int, count: int, limit: int) -> tuple[tuple[LasRecord, ...], int]:
    check_room(count * _RECORD_BYTES, limit - at, what=f"{count} LAS variable length records")
    records = []
    for number in range(count):
        check_room(_RECORD_BYTES, limit - at, what=f"LAS variable length record {number}")
        user_id, record_id, length = struct.unpack_from("<2x16sHH", raw, at)
        check_room(_RECORD_BYTES + length, limit - at, what=f"LAS variable length record {number}")
        end = at + _RECORD_BYTES + length
        records.append(LasRecord(user_id.split(b"\0")[0], record_id, raw[at:end]))
        at = end
    if at > limit:
        raise MalformedFile(f"the LAS point data offset {limit} lies within the header, which ends at byte {at}")
    return tuple(records), at


def _wkt(raw: bytes, minor: int, records: tuple[LasRecord, ...]) -> bytes:
    """Return the text of the reference system; what is broken of extended records, which are only kept, ends them."""
    found = next((record.data for record in records if (record.user_id, record.record_id) == _WKT_ID), None)
    if found is not None or minor < 4:
        return found or b""
    at, count = struct.unpack_from("<QI", raw, 235)
    for _ in range(min(count, _MOST_EXTENDED)):
        if at + _EXTENDED_BYTES > len(raw):
            break
        user_id, record_id, length = struct.unpack_from("<2x16sHQ", raw, at)
        at += _EXTENDED_BYTES
        if (user_id.split(b"\0")[0], record_id) == _WKT_ID:
            return raw[at : at + length]
        at += length
    return b""


def _first_extended(raw: bytes, minor: int, begin: int) -> int | None:
    """Return where what follows the points begins, if the header says that something does."""
    marks = []
    if minor >= 3:
        marks.append(struct.unpack_from("<Q", raw, 227)[0])
    if minor >= 4 and struct.unpack_from("<I", raw, 243)[0]:
        marks.append(struct.unpack_from("<Q", raw, 235)[0])
    for mark in marks:
        if mark and not begin <= mark <= len(raw):
            raise MalformedFile(f"a LAS extended record is said to begin at byte {mark}, outside {begin}..{len(raw)}")
    return min((mark for mark in marks if mark), default=None)


def standard_bytes(point_format: int) -> int:
    """Return the bytes of a point without extra ones."""
    return 12 + sum(np.dtype(code).itemsize for _, code in _POINT_FORMATS[point_format])


def standard_dimensions(point_format: int) -> dict[str, LasDimension]:
    """Return every dimension that points of this format have by themselves, but X, Y, Z."""
    found: dict[str, LasDimension] = {}
    at = 12
    for names, code in _POINT_FORMATS[point_format]:
        dtype = np.dtype("<" + code)
        if isinstance(names, str):
            found[names] = LasDimension(at, dtype)
        else:
            shift = 0
            for name, bits in names:
                found[name] = LasDimension(at, dtype, shift, bits)
                shift += bits
        at += dtype.itemsize
    return found


def dimensions(rows: npt.NDArray[np.uint8], header: LasHeader) -> dict[str, npt.NDArray[Any]]:
    """Return every dimension of (N, row_bytes) points but X, Y, Z as (N,) or (N, M); bit fields are unpacked."""
    found: dict[str, npt.NDArray[Any]] = {}
    for name, standard in standard_dimensions(header.point_format).items():
        values = _column(rows, standard.at, standard.dtype)
        found[name] = values if standard.bits is None else (values >> standard.shift) & ((1 << standard.bits) - 1)
    at = standard_bytes(header.point_format)
    for extra in _extra_dimensions(header, at):
        label = extra.name
        while label in found or label in tuple("xyzXYZ"):
            label = f"extra_{label}"
        end = at + extra.dtype.itemsize * extra.width
        values = rows[:, at:end].view(extra.dtype)
        values = values if extra.is_plain else _scaled(values, extra)
        found[label] = values if extra.width > 1 else values[:, 0]
        at = end
    if at < header.row_bytes:
        found["extra_bytes"] = rows[:, at:]
    return found


def value_bytes(header: LasHeader) -> int:
    """Return the bytes of a point once `dimensions` has read it: those of extra bytes with a scale become float64."""
    extra = _extra_dimensions(header, standard_bytes(header.point_format))
    return header.row_bytes + sum(8 * dimension.width for dimension in extra if not dimension.is_plain)


def _column(rows: npt.NDArray[np.uint8], at: int, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    values: npt.NDArray[Any] = rows[:, at : at + dtype.itemsize].view(dtype)[:, 0]
    return values


@dataclass(frozen=True)
class _Extra:
    """Describe a dimension of extra bytes; width: of bytes that have no type, or values.

    A value is scale * stored + offset, each of which there is one of, or one a value.
    """

    name: str
    dtype: np.dtype[Any]
    width: int
    scale: tuple[float, ...]
    offset: tuple[float, ...]

    @property
    def is_plain(self) -> bool:
        return set(self.scale) == {1} and set(self.offset) == {0}


def _scaled(values: npt.NDArray[Any], extra: _Extra) -> npt.NDArray[np.float64]:
    with np.errstate(over="ignore", invalid="ignore"):  # floats with a scale may be anything
        scaled: npt.NDArray[np.float64] = values.astype(np.float64) * extra.scale + extra.offset
    return scaled


def _extra_dimensions(header: LasHeader, at: int) -> list[_Extra]:
    """Return the extra bytes that a record describes and the point length has room for."""
    record = header.record(*EXTRA_BYTES_ID)
    found: list[_Extra] = []
    data = record.data if record is not None else b""
    for begin in range(0, len(data) - _EXTRA_STRUCT_BYTES + 1, _EXTRA_STRUCT_BYTES):
        kind, options = data[begin + 2], data[begin + 3]
        name = data[begin + 4 : begin + 36].split(b"\0")[0].decode("utf-8", "replace") or f"extra_{len(found)}"
        if kind > 3 * len(_EXTRA_TYPES) or (kind == 0 and options == 0):
            break  # left as unnamed extra bytes
        if kind:  # from 11 on pairs, from 21 on triples: of LAS 1.4 before R14, and of laspy still
            width, code = (kind - 1) // len(_EXTRA_TYPES) + 1, _EXTRA_TYPES[(kind - 1) % len(_EXTRA_TYPES)]
            dtype, values = np.dtype("<" + code), width
        else:
            dtype, width, values = np.dtype("u1"), options, 1
        at += dtype.itemsize * width
        if at > header.row_bytes:
            break
        ones, zeros, numbers = (1.0,) * values, (0.0,) * values, f"<{values}d"
        scale = struct.unpack_from(numbers, data, begin + 112) if kind and options & _HAS_SCALE else ones
        offset = struct.unpack_from(numbers, data, begin + 136) if kind and options & _HAS_OFFSET else zeros
        is_usable = all(map(math.isfinite, (*scale, *offset))) and 0 not in scale
        found.append(_Extra(name, dtype, width, *((scale, offset) if is_usable else (ones, zeros))))
    return found
