"""Every file format, in one explicit table, and how a file finds its own.

A new format is one file with a `Format` and one line in FORMATS; the contract tests run over it by themselves.
"""

from __future__ import annotations

import errno
import re
import struct
from pathlib import Path, PurePath

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import (
    MalformedFile,
    StraightPCFError,
    TooManyBytes,
    UnknownFormat,
    UnsupportedCloud,
)
from straightpcf.points.formats.base import DEFAULT_MAX_POINTS, HEAD_BYTES, Format
from straightpcf.points.formats.e57 import E57
from straightpcf.points.formats.kitti import Kitti
from straightpcf.points.formats.las import Las, Laz
from straightpcf.points.formats.npy import Npy
from straightpcf.points.formats.npz import Npz
from straightpcf.points.formats.pcd import Pcd
from straightpcf.points.formats.ply import Ply
from straightpcf.points.formats.ptx import Ptx
from straightpcf.points.formats.xyz import Csv, Pts, Tsv, Xyz

__all__ = [
    "DEFAULT_MAX_POINTS",
    "FORMATS",
    "Format",
    "estimate_points",
    "format_by_suffix",
    "format_for",
    "format_named",
    "format_wanted",
    "read_cloud",
    "recognised",
    "write_cloud",
]

FORMATS: tuple[Format, ...] = (
    Ply(),
    Pcd(),
    Las(),
    Laz(),
    E57(),
    Npy(),
    Npz(),
    Xyz(),
    Csv(),
    Tsv(),
    Pts(),
    Ptx(),
    Kitti(),
)

# Endings of files that would pass for another format's, and be scrambled.
_NOT_OURS = {
    ".pcd.bin": "a nuScenes sweep has five float32 a point, where a KITTI frame (.bin) has four; "
    "as (N, 5) float32 in a .npy file it can be taken"
}

# How files of other programs begin, whatever they are called, and what to do about them.
_FOREIGN = (
    # CloudCompare saves it by default, under the suffix of KITTI's frames: CCB2 and the like.
    (re.compile(rb"CCB[0-?]"), "a BIN file of CloudCompare's own: save it as PLY or LAS there"),
    (re.compile(rb"ncols\s+\d", re.IGNORECASE), "an ESRI grid of heights: turn it into x y z, as GDAL does (XYZ)"),
)

# How files begin that hold another one.
_PACKED = {
    b"\x1f\x8b\x08": "gzip",
    b"BZh": "bzip2",
    b"\xfd7zXZ\0": "xz",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"7z\xbc\xaf\x27\x1c": "7-Zip",
    b"Rar!\x1a\x07": "RAR",
}


def estimate_points(path: Path, *, name: str | None = None) -> int:
    """Guess how many points a file holds without reading it; never more than its bytes could be.

    Raises MalformedFile if it is empty.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    size = path.stat().st_size
    try:
        return min(recognised(head, name or path.name).estimate(head, size), size)
    except (StraightPCFError, ValueError, struct.error):
        if size == 0:
            raise
        return size // 16  # reading it will say what is wrong


def read_cloud(
    path: Path, *, name: str | None = None, max_points: int = DEFAULT_MAX_POINTS
) -> tuple[PointCloud, Format]:
    """Read a file by its magic bytes, or by the suffix of `name` (default: of path) where its format has none.

    Raises UnknownFormat, MalformedFile, UnsupportedCloud, TooManyPoints, TooManyBytes, MissingDependency, OSError.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    called = name or path.name
    format = recognised(head, called)
    try:
        return format.read(path, max_points=max_points), format
    except StraightPCFError:
        raise
    except MemoryError as exc:
        raise TooManyBytes(f"{called} ({path.stat().st_size} bytes) does not fit into this machine's memory") from exc
    except Exception as exc:
        if isinstance(exc, OSError) and exc.errno not in (None, errno.EINVAL):
            raise  # the disk, not the file; EINVAL is a seek to where a broken file pointed
        raise MalformedFile(f"{called} is no readable {format.name} file: {type(exc).__name__}: {exc}"[:500]) from exc


def write_cloud(cloud: PointCloud, path: Path, format: Format) -> None:
    """Write a cloud; a cloud that was read in the same format keeps everything but the positions that moved."""
    format.write(cloud, path)


def format_named(name: str) -> Format:
    """Return the format of that name; raises UnknownFormat."""
    for format in FORMATS:
        if format.name == name.lower():
            return format
    raise UnknownFormat(f"no format is named {name[:40]!r}; there are {_known()}")


def format_for(filename: str) -> Format:
    """Return the format that the suffix names; raises UnknownFormat."""
    if (format := format_by_suffix(filename)) is not None:
        return format
    name = PurePath(filename)
    raise UnknownFormat(
        f"no format has the suffix {name.suffix.lower()[:40]!r} of {name.name[:80]}; there are {_known()}"
    )


def format_by_suffix(filename: str) -> Format | None:
    """Return the format that the suffix names, if one does."""
    suffix = PurePath(filename).suffix.lower()
    return next((format for format in FORMATS if suffix in format.suffixes), None)


def format_wanted(target: str, source: str | None) -> str | None:
    """Return the name of the format that a target's suffix asks for; None for an unknown one that is the source's, too.

    Raises UnknownFormat.
    """
    is_same = PurePath(target).suffix.lower() == PurePath(source or "").suffix.lower()
    return None if is_same and format_by_suffix(target) is None else format_for(target).name


def recognised(head: bytes, called: str | None) -> Format:
    """Return the format of a file by its first bytes, or by the suffix of what it is called.

    Raises UnknownFormat, MalformedFile if it is empty, UnsupportedCloud for what only looks like a format's suffix.
    """
    name = PurePath(called or "the cloud").name
    if not head:
        raise MalformedFile(f"{name[:80]} is empty (0 bytes)")
    for format in FORMATS:
        if format.sniff(head):
            return format
    for magic, packer in _PACKED.items():
        if head.startswith(magic):
            raise UnknownFormat(f"{name[:80]} is packed with {packer}: unpack it first")
    for beginning, what in _FOREIGN:
        if beginning.match(head):
            raise UnknownFormat(f"{name[:80]} is {what}")
    begins, suffix = f"{name[:80]} begins with {head[:8]!r}, which no format does", PurePath(name).suffix.lower()
    for ending, why in _NOT_OURS.items():
        if name.lower().endswith(ending):
            raise UnsupportedCloud(f"{name[:80]}: {why}")
    if (named := format_by_suffix(name)) is not None:
        if not named.has_magic:
            return named
        raise UnknownFormat(f"{begins}: it is no {named.name} file, whatever its suffix says")
    wants = "and its suffix names none" if suffix else "so it needs a name with a suffix that says its format"
    raise UnknownFormat(f"{begins}, {wants}; there are {_known()}")


def _known() -> str:
    return ", ".join(f"{format.name} ({' '.join(format.suffixes)})" for format in FORMATS)
