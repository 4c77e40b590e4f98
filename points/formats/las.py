"""LAS and LAZ: only the integers of moved points and the header's bounds change, every other byte is copied."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import UnsupportedCloud
from straightpcf.points.formats.base import Format, check_count, check_room
from straightpcf.points.formats.las_layout import (
    COPC_ID,
    EXTRA_BYTES_ID,
    LASZIP_ID,
    LasHeader,
    dimensions,
    is_geographic,
    read_header,
    record_bytes,
)
from straightpcf.points.formats.las_new import TAKEN, TYPES, as_dimensions, check_new, new_las, renamed
from straightpcf.points.formats.laz_codec import check_packing, pack, packing_record, unpack
from straightpcf.points.formats.positions import AXES, moved
from straightpcf.points.formats.scalars import not_held

__all__ = ["Las", "Laz"]

_DEGREES_SCALE = 1.0001e-5  # a metre; scans in metres have 0.01 to 0.0001


@dataclass(frozen=True)
class LasSource:
    """Hold the file, its parsed header, its points as (N, row_bytes) uint8 and the positions read from them."""

    raw: bytes
    header: LasHeader
    rows: npt.NDArray[np.uint8]
    xyz: npt.NDArray[np.float64]


class Las(Format):
    """Read and write LAS 1.0 to 1.5, point formats 0 to 10, without a library in between."""

    name = "las"
    suffixes: ClassVar[tuple[str, ...]] = (".las",)
    media_type = "application/vnd.las"
    is_compressed = False
    types = TYPES

    def estimate(self, head: bytes, size: int) -> int:
        """Read the header's count; packed points take few bytes."""
        (legacy,) = struct.unpack_from("<I", head, 107)
        return int(legacy or struct.unpack_from("<Q", head, 247)[0]) if len(head) >= 255 else size // 4

    def sniff(self, head: bytes) -> bool:
        """Recognise the signature, and by the point format's highest bit whether the points are packed."""
        return head.startswith(b"LASF") and (len(head) > 104 and head[104] >= 0x80) == self.is_compressed

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read every dimension; of those of extra bytes the values, where a scale or offset is said float64."""
        raw = path.read_bytes()
        header = read_header(raw)
        check_count(header.points, max_points, where="the LAS header")
        size = header.points * header.row_bytes
        if header.is_compressed:
            rows = np.frombuffer(unpack(raw, header), np.uint8)
        else:
            check_room(size, len(raw) - header.data_begin, what=f"LAS data of {header.points} points")
            rows = np.frombuffer(raw, np.uint8, size, header.data_begin) if size else np.empty(0, np.uint8)
        rows = rows.reshape(header.points, header.row_bytes)
        integers = np.ascontiguousarray(rows[:, :12]).view("<i4").reshape(header.points, 3)
        xyz = integers * header.scales + header.offsets
        if is_geographic(header):
            _refuse_degrees(xyz, header)
        source = LasSource(raw, header, rows, xyz.copy())
        return PointCloud(xyz, dimensions(rows, header), source, beside=_records(header))

    def left_behind(self, cloud: PointCloud) -> list[str]:
        """Name nothing of a file that is only packed or unpacked."""
        if isinstance(cloud.source, LasSource):
            return []
        attributes = as_dimensions(cloud.in_columns())
        return [*cloud.beside, *not_held(attributes, self.types, taken=TAKEN), *renamed(cloud)]

    def check(self, cloud: PointCloud) -> None:
        """Raise UnsupportedCloud where no file can be written; LAZ wants its library, too, and a known layout."""
        source = cloud.source
        if not isinstance(source, LasSource):
            check_new(cloud)
        else:
            _refuse_index(source.header)
        if self.is_compressed:
            check_packing(*((source.header, source.rows) if isinstance(source, LasSource) else ()))

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the file that was read, packed or not, with its moved points requantised; or a new one."""
        source = cloud.source
        if not isinstance(source, LasSource):
            raw, header, rows = _laid_out(new_las(cloud))
            is_new = True
        else:
            raw, header = source.raw, source.header
            changed = moved(cloud.xyz, source.xyz)
            rows = _requantised(source, cloud.xyz, changed)
            is_new = not changed.any()
        if is_new and header.is_compressed == self.is_compressed:
            path.write_bytes(raw)
        else:
            with path.open("wb") as file:  # part by part: joined, they would be held twice
                file.writelines(_assembled(raw, header, rows, compressed=self.is_compressed, keep_bounds=is_new))


class Laz(Las):
    """Read and write LAZ with lazrs, from the extra straightpcf[las]."""

    name = "laz"
    suffixes: ClassVar[tuple[str, ...]] = (".laz",)
    media_type = "application/vnd.laszip"
    is_compressed = True


def _refuse_index(header: LasHeader) -> None:
    if header.record(*COPC_ID) is not None:
        raise UnsupportedCloud(
            "a COPC file is indexed by position, and the index would be wrong: take another format, as PLY, or convert "
            "it to LAZ first"
        )


def _refuse_degrees(xyz: npt.NDArray[np.float64], header: LasHeader) -> None:
    """Raise where x and y can be what a record says they are: a scan in metres may be said to be in degrees, too."""
    if (np.abs(xyz[:, :2]) <= (360, 90)).all() and np.abs(header.scales[:2]).max() <= _DEGREES_SCALE:
        raise UnsupportedCloud(
            f"the LAS records say that x and y are degrees, and scales {header.scales[:2].tolist()} do not deny it: no "
            "distance can be told in them: project the points first (easting, northing, height)"
        )


def _records(header: LasHeader) -> tuple[str, ...]:
    """Name the records that say something of the cloud: its reference system, for one."""
    ids = {(r.user_id, r.record_id): None for r in header.records}  # in their order, each once
    said = [id for id in ids if id not in (LASZIP_ID, EXTRA_BYTES_ID)]
    names = [f"record {user.decode('ascii', 'replace')} {record}" for user, record in said]
    return (*names, *(["extended records"] if header.first_extended is not None else []))


def _laid_out(raw: bytes) -> tuple[bytes, LasHeader, npt.NDArray[np.uint8]]:
    header = read_header(raw)
    rows = np.frombuffer(raw, np.uint8)[header.data_begin :].reshape(header.points, header.row_bytes)
    return raw, header, rows


def _requantised(
    source: LasSource, xyz: npt.NDArray[np.float64], changed: npt.NDArray[np.bool_]
) -> npt.NDArray[np.uint8]:
    """Return the points with the moved coordinates as the nearest multiples of the header's scales."""
    if not changed.any():
        return source.rows
    rows = source.rows.copy()
    for axis in range(3):
        picked = np.flatnonzero(changed[:, axis])
        with np.errstate(over="ignore"):
            values = np.rint((xyz[picked, axis] - source.header.offsets[axis]) / source.header.scales[axis])
        outside = ~((values >= -(2**31)) & (values < 2**31))
        if outside.any():
            row = picked[int(np.argmax(outside))]
            raise UnsupportedCloud(
                f"the new {AXES[axis]} of point {row}, {xyz[row, axis]:g}, has no place in 32 bits "
                f"at LAS scale {source.header.scales[axis]:g} and offset {source.header.offsets[axis]:g}"
            )
        rows[picked, 4 * axis : 4 * axis + 4] = values.astype("<i4").view(np.uint8).reshape(-1, 4)
    return rows


def _assembled(
    raw: bytes, header: LasHeader, rows: npt.NDArray[np.uint8], *, compressed: bool, keep_bounds: bool
) -> list[bytes | memoryview]:
    """Return the file's parts: header, records, points, and what follows them, with every offset where it now is."""
    _refuse_index(header)
    kept = [record.raw for record in header.records if (record.user_id, record.record_id) != LASZIP_ID]
    record = packing_record(header) if compressed else b""
    old = header.record(*LASZIP_ID)
    records = kept
    if compressed and old is not None and old.data == record:
        records = [entry.raw for entry in header.records]
    elif compressed:
        records = [*kept, record_bytes(LASZIP_ID, record, b"straightpcf")]
    begin = len(header.head) + sum(map(len, records)) + len(header.gap)
    points: bytes | memoryview = pack(rows, record, begin) if compressed else rows.reshape(-1).data
    after, follows_at = _follows(raw, header)
    head = bytearray(header.head)
    struct.pack_into("<IIB", head, 96, begin, len(records), header.point_format | (0x80 if compressed else 0))
    _move_offsets(head, header, begin + len(points) - follows_at)
    if not keep_bounds:
        _put_bounds(head, header, rows)
    return [bytes(head), *records, header.gap, points, after]


def _follows(raw: bytes, header: LasHeader) -> tuple[bytes, int]:
    """Return what stands behind the points, and where it begins; behind packed points only what has an offset."""
    if header.is_compressed:
        begin = len(raw) if header.first_extended is None else header.first_extended
    else:
        begin = header.data_begin + header.points * header.row_bytes
    return raw[begin:], begin


def _move_offsets(head: bytearray, header: LasHeader, distance: int) -> None:
    """Shift the places of waveform data and extended records, which stand behind the points."""
    for at, first_minor in ((227, 3), (235, 4)):
        if header.minor >= first_minor:
            (place,) = struct.unpack_from("<Q", head, at)
            if place:
                struct.pack_into("<Q", head, at, max(place + distance, 0))


def _put_bounds(head: bytearray, header: LasHeader, rows: npt.NDArray[np.uint8]) -> None:
    integers = np.ascontiguousarray(rows[:, :12]).view("<i4").reshape(len(rows), 3)
    lowest = integers.min(axis=0) * header.scales + header.offsets
    highest = integers.max(axis=0) * header.scales + header.offsets
    for axis in range(3):
        pair = sorted((float(lowest[axis]), float(highest[axis])), reverse=True)  # a scale may be negative
        struct.pack_into("<2d", head, 179 + 16 * axis, *pair)
