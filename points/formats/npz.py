"""NPZ: one array of positions among others; the others are kept, and a zip bomb is refused unread."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, TooManyBytes, UnsupportedCloud
from straightpcf.points.formats.base import Format, check_unpacked, most_unpacked
from straightpcf.points.formats.npy_array import (
    HEADER_BYTES,
    MAGIC,
    NpyHeader,
    columns_of,
    patched,
    positions_header,
    read_header,
    view,
)
from straightpcf.points.formats.positions import moved, widened

__all__ = ["KEYS", "MAX_MEMBERS", "MAX_UNPACKED_BYTES", "Npz"]

KEYS = ("points", "xyz", "pos", "positions", "coord", "coords", "vertices")
_NO_POSITIONS = ("normal", "color", "colour", "rgb")  # how names of arrays begin that are (N, 3) as well
MAX_MEMBERS = 1000
MAX_UNPACKED_BYTES = 4 << 30
# Of a point: what is beyond stays packed, as arrays that are no attributes do. So does what `most_unpacked` forbids.
MAX_ATTRIBUTE_BYTES = 4096
_COPY_BYTES = 1 << 20


@dataclass(frozen=True)
class NpzSource:
    """Hold the archive as it is packed, and which member is the cloud: its name, NPY bytes, header and positions."""

    raw: bytes
    member: str
    array: bytes
    header: NpyHeader
    xyz: npt.NDArray[np.float64]


class Npz(Format):
    """Read and write NPZ; the positions are the first of KEYS that can be, or the only array (N, >= 3) there is.

    Refused is one that is so called and has such rows of whole numbers or objects: the only one is something else then.
    """

    name = "npz"
    suffixes = (".npz",)
    media_type = "application/x-npz"

    def sniff(self, head: bytes) -> bool:
        """Recognise a zip archive."""
        return head[:4] in (b"PK\x03\x04", b"PK\x05\x06")

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read the positions; what the archive's directory declares is checked before anything is unpacked."""
        raw = path.read_bytes()
        with _opened(raw) as archive:
            members = _members(archive)
            member = _choose(archive, members)
            where = f"array {member.filename[:80]}"
            header = positions_header(_head(archive, member), where=where, max_points=max_points)
            check_unpacked(header.data_bytes, len(raw), what=where)
            array = _unpacked(archive, member, header)
            axes, attributes, fields = columns_of(array, header)
            xyz = widened(axes)
            room = min(MAX_ATTRIBUTE_BYTES * len(xyz), most_unpacked(len(raw)) - len(array))
            for other in members:
                head = b"" if other is member else _head(archive, other)
                if not head.startswith(MAGIC):
                    continue
                found = read_header(head, where=f"array {other.filename[:80]}")
                if found.is_attribute_of(len(xyz)) and found.data_bytes <= room:
                    room -= found.data_bytes
                    attributes[_key(other)] = view(_unpacked(archive, other, found), found)
            known = {member.filename, *(f"{name}.npy" for name in attributes)}
            others = tuple(info.filename for info in archive.infolist() if info.filename not in known)
        return PointCloud(
            xyz, attributes, NpzSource(raw, member.filename, array, header, xyz.copy()), beside=(*fields, *others)
        )

    def left_behind(self, cloud: PointCloud) -> list[str]:
        """Name what no array of the archive can be called."""
        return [*cloud.beside, *(name for name, values in cloud.attributes.items() if not _is_array(name, values))]

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the archive that was read with its positions replaced; a cloud of another format as `points` and more.

        The attributes of another format become arrays of their own.
        """
        source = cloud.source
        if not isinstance(source, NpzSource):
            _write_new(cloud, path)
        elif not moved(cloud.xyz, source.xyz).any():
            path.write_bytes(source.raw)
        else:
            _rewrite(source, cloud.xyz, path)


@contextmanager
def _opened(raw: bytes) -> Iterator[zipfile.ZipFile]:
    """Open an archive; what zipfile and zlib find wrong with it becomes MalformedFile, here and only here.

    An OSError is none of these: the archive is in memory, so it is of the disk that it is written anew to.
    """
    try:
        with zipfile.ZipFile(BytesIO(raw)) as archive:
            yield archive
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as exc:
        raise MalformedFile(f"the NPZ archive is broken: {exc}") from exc


def _members(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Check the central directory, and return its arrays."""
    members = archive.infolist()
    if len(members) > MAX_MEMBERS:
        raise TooManyBytes(f"the NPZ archive has {len(members)} members; the limit is {MAX_MEMBERS}")
    total = sum(member.file_size for member in members)
    if total > MAX_UNPACKED_BYTES:
        raise TooManyBytes(f"the NPZ archive declares {total} bytes unpacked; the limit is {MAX_UNPACKED_BYTES}")
    if len({member.filename for member in members}) != len(members):
        raise MalformedFile("the NPZ archive has two members of one name")
    for member in members:
        name = member.filename[:80]
        if member.flag_bits & 1:
            raise UnsupportedCloud(f"member {name} of the NPZ archive is encrypted")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise UnsupportedCloud(f"member {name} of the NPZ archive is packed with method {member.compress_type}")
    return [member for member in members if member.filename.endswith(".npy")]


def _choose(archive: zipfile.ZipFile, members: list[zipfile.ZipInfo]) -> zipfile.ZipInfo:
    fitting = {_key(member): member for member in members if _can_be_positions(archive, member)}
    if named := _called(fitting):
        return fitting[named[0]]
    by_name = {_key(member): member for member in members}
    called = [key for key in _called(by_name) if not fitting or _has_rows(archive, by_name[key])]
    if called:
        return by_name[called[0]]  # reading it says what is wrong with it
    if len(fitting) == 1:
        return next(iter(fitting.values()))
    if not members:
        held = ", ".join(archive.namelist())[:200]
        raise UnsupportedCloud(
            f"the zip archive holds no arrays, as NPZ does, but {held or 'nothing'}: unpack it first"
        )
    raise UnsupportedCloud(
        f"the NPZ archive has {len(fitting)} arrays of shape (N, >= 3), and none named {', '.join(KEYS)}: "
        f"{', '.join(fitting or by_name)[:200]}"
    )


def _called(names: Collection[str]) -> list[str]:
    """Return which of these are names of positions: in the order of KEYS those so written, then those in any case."""
    known = (name for name in names if name.lower() in KEYS)
    return sorted(known, key=lambda name: (name not in KEYS, KEYS.index(name.lower())))


def _can_be_positions(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bool:
    head = _head(archive, member)
    if not head.startswith(MAGIC) or _key(member).lower().startswith(_NO_POSITIONS):
        return False
    return read_header(head, where=f"array {member.filename[:80]}").is_positions


def _has_rows(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bool:
    """Tell whether positions may be what this array holds, of whatever type: beside it, others are none (features)."""
    head = _head(archive, member)
    shape = read_header(head, where=f"array {member.filename[:80]}").shape if head.startswith(MAGIC) else ()
    return len(shape) == 2 and shape[1] >= 3


def _head(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    with archive.open(member) as file:
        return file.read(HEADER_BYTES)


def _unpacked(archive: zipfile.ZipFile, member: zipfile.ZipInfo, header: NpyHeader) -> bytes:
    """Unpack an array whose shape and declared size agree."""
    where, size = f"array {member.filename[:80]}", header.size + header.data_bytes
    if size != member.file_size:
        raise MalformedFile(f"{where} of shape {header.shape} needs {size} bytes, it has {member.file_size}")
    with archive.open(member) as file:
        array = file.read(size + 1)
    if len(array) != size:
        raise MalformedFile(f"{where} unpacks to {len(array)} bytes, {size} are declared")
    return array


def _key(member: zipfile.ZipInfo) -> str:
    return member.filename.removesuffix(".npy")


def _rewrite(source: NpzSource, xyz: npt.NDArray[np.float64], path: Path) -> None:
    with _opened(source.raw) as old, zipfile.ZipFile(path, "w") as new:
        new.comment = old.comment
        for member in old.infolist():
            info = zipfile.ZipInfo(member.filename, member.date_time)
            info.compress_type, info.external_attr = member.compress_type, member.external_attr
            info.comment, info.create_system = member.comment, member.create_system
            info.file_size = member.file_size
            with new.open(info, "w") as target:
                if member.filename == source.member:
                    target.write(patched(source.array, source.header, xyz, source.xyz))
                    continue
                with old.open(member) as kept:
                    while block := kept.read(_COPY_BYTES):
                        target.write(block)


def _is_array(name: str, values: npt.NDArray[Any]) -> bool:
    return name != KEYS[0] and "/" not in name and not values.dtype.hasobject


def _write_new(cloud: PointCloud, path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        arrays = {"points": np.ascontiguousarray(cloud.xyz)}
        for name, values in cloud.attributes.items():
            if _is_array(name, values):
                arrays[name] = np.ascontiguousarray(values)
        for name, values in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy")  # dated 1980: the same cloud gives the same bytes
            info.compress_type, info.file_size = zipfile.ZIP_DEFLATED, values.nbytes + HEADER_BYTES
            with archive.open(info, "w") as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
