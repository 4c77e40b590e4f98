"""NPZ: a zip of arrays, one of them the positions; no member is unpacked before its declared size is known."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, TooManyBytes, UnsupportedCloud
from straightpcf.points.formats.base import Format, check_count, check_room
from straightpcf.points.formats.npy import (
    ArrayHeader,
    NpySource,
    array_bytes,
    array_of,
    check_positions,
    npy_source,
    patched,
    read_array_header,
)
from straightpcf.points.formats.positions import moved
from straightpcf.points.formats.scalars import further_columns

__all__ = ["MAX_MEMBERS", "MAX_UNPACKED_BYTES", "Npz"]

MAX_UNPACKED_BYTES = 4 << 30
MAX_MEMBERS = 10_000
POSITION_KEYS = ("points", "xyz", "pos")
_COPY_BYTES = 1 << 20


@dataclass(frozen=True)
class NpzSource:
    """Hold the zip as it was, and the member with the positions."""

    raw: bytes
    member: str
    positions: NpySource


class Npz(Format):
    """Read and write positions under `points`, `xyz`, `pos`, or as the only (N, M >= 3) float array."""

    name = "npz"
    suffixes = (".npz",)

    def sniff(self, head: bytes) -> bool:
        """Recognise a zip file."""
        return head[:4] in (b"PK\x03\x04", b"PK\x05\x06")

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read the positions; other arrays with a row a point become attributes. Nothing is ever unpickled."""
        raw = path.read_bytes()
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            headers = _headers(archive)
            member = _position_member(headers)
            check_positions(headers[member], f"array {_key(member)}")
            check_count(headers[member].shape[0], max_points, f"array {_key(member)}")
            positions = npy_source(_unpacked(archive, member), f"array {_key(member)}", max_points)
            attributes = further_columns(array_of(positions.raw, positions.header))
            for name in _attribute_members(headers, member):
                attributes[_key(name)] = array_of(_unpacked(archive, name), headers[name])
        return PointCloud(positions.xyz.copy(), attributes, NpzSource(raw, member, positions))

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the zip that was read with its positions replaced, or a new one: `points` and every attribute."""
        source = cloud.source
        if not isinstance(source, NpzSource):
            _write_new(cloud, path)
        elif moved(cloud.xyz, source.positions.xyz).any():
            _write_patched(source, cloud.xyz, path)
        else:
            path.write_bytes(source.raw)


def _headers(archive: zipfile.ZipFile) -> dict[str, ArrayHeader]:
    """Read the header of every array; only declared sizes and first bytes are looked at."""
    members = archive.infolist()
    if len(members) > MAX_MEMBERS:
        raise TooManyBytes(f"the NPZ file has {len(members)} members; the limit is {MAX_MEMBERS}")
    total = sum(member.file_size for member in members)
    if total > MAX_UNPACKED_BYTES:
        raise TooManyBytes(f"the NPZ file declares {total} unpacked bytes; the limit is {MAX_UNPACKED_BYTES}")
    headers: dict[str, ArrayHeader] = {}
    for member in members:
        if not member.filename.endswith(".npy"):
            continue
        where = f"array {_key(member.filename)}"
        if member.filename in headers:
            raise MalformedFile(f"{where} is in the NPZ file twice")
        with archive.open(member) as file:
            header = read_array_header(file, where)
        if not header.dtype.hasobject:
            check_room(header.size + header.data_bytes, member.file_size, what=f"{where} of shape {header.shape}")
        headers[member.filename] = header
    return headers


def _position_member(headers: dict[str, ArrayHeader]) -> str:
    for key in POSITION_KEYS:
        if f"{key}.npy" in headers:
            return f"{key}.npy"
    fitting = [name for name, header in headers.items() if _could_be_positions(header)]
    if len(fitting) == 1:
        return fitting[0]
    listed = ", ".join(f"{_key(name)} {header.shape}" for name, header in headers.items())[:300] or "none"
    raise UnsupportedCloud(
        f"the NPZ file has no array named {', '.join(POSITION_KEYS)}, and {len(fitting)} of its arrays "
        f"are (N, 3) floats or wider; its arrays are: {listed}"
    )


def _could_be_positions(header: ArrayHeader) -> bool:
    return header.dtype.kind == "f" and len(header.shape) == 2 and header.shape[1] >= 3


def _attribute_members(headers: dict[str, ArrayHeader], positions: str) -> Iterator[str]:
    count = headers[positions].shape[0]
    for name, header in headers.items():
        has_row_a_point = len(header.shape) in (1, 2) and header.shape[0] == count
        if name != positions and has_row_a_point and not header.dtype.hasobject:
            yield name


def _unpacked(archive: zipfile.ZipFile, name: str) -> bytes:
    member = archive.getinfo(name)
    with archive.open(member) as file:
        raw = file.read(member.file_size + 1)
    if len(raw) != member.file_size:
        raise MalformedFile(f"{_key(name)} unpacks to {len(raw)} bytes, not the {member.file_size} it declares")
    return raw


def _write_patched(source: NpzSource, xyz: npt.NDArray[np.float64], path: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(source.raw)) as old, zipfile.ZipFile(path, "w") as new:
        new.comment = old.comment
        for member in old.infolist():
            with new.open(_copied(member), "w", force_zip64=member.file_size >= 1 << 30) as target:
                if member.filename == source.member:
                    target.write(patched(source.positions, xyz))
                    continue
                with old.open(member) as file:
                    while chunk := file.read(_COPY_BYTES):
                        target.write(chunk)


def _copied(member: zipfile.ZipInfo) -> zipfile.ZipInfo:
    copy = zipfile.ZipInfo(member.filename, member.date_time)
    copy.compress_type, copy.external_attr, copy.comment = member.compress_type, member.external_attr, member.comment
    copy.create_system = member.create_system
    return copy


def _write_new(cloud: PointCloud, path: Path) -> None:
    """Write with a fixed date, so that the same cloud gives the same bytes."""
    arrays: dict[str, npt.NDArray[Any]] = {"points": cloud.xyz}
    arrays |= {name.replace("/", "_"): values for name, values in cloud.attributes.items() if name != "points"}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, values in arrays.items():
            info = zipfile.ZipInfo(f"{key}.npy")
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=values.nbytes >= 1 << 30) as target:
                target.write(array_bytes(values))


def _key(member: str) -> str:
    return member.removesuffix(".npy")[:80]
