"""E57: the scans of a terrestrial scanner, each in the place that its pose gives; it is read, and not written."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import NORMALS, PointCloud
from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import Format, check_count, check_unpacked
from straightpcf.points.formats.colours import RGB
from straightpcf.points.formats.e57_file import MAGIC, E57File, E57Points, child, number

__all__ = ["E57"]

_Columns = dict[str, npt.NDArray[Any]]
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_STATES = ("cartesianInvalidState", "sphericalInvalidState")  # 0: valid; 1: a direction alone; 2: nothing
_NORMALS = ("normalX", "normalY", "normalZ")  # of the extension for surface normals
# As other formats call what E57 has a name of its own for.
_CALLED = dict(zip(("colorRed", "colorGreen", "colorBlue", *_NORMALS), (*RGB, *NORMALS[0]), strict=True))
_SCAN = "scan"


class E57(Format):
    """Read all scans of an E57 file as one cloud, in the file's common frame.

    What a scanner has no distance for is no point. With several scans `scan` says which one a point is of, 0 and up.
    """

    name = "e57"
    suffixes = (".e57",)
    media_type = "model/e57"
    is_written = False

    def sniff(self, head: bytes) -> bool:
        """Recognise the signature."""
        return head.startswith(MAGIC)

    def estimate(self, head: bytes, size: int) -> int:
        """Guess from what three packed coordinates take at least."""
        return size // 8

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read every field that is a number; what not all scans have, and what is no number, is left behind."""
        raw = path.read_bytes()
        file = E57File(raw)
        found = [scan for scan in child(file.root, "data3D") or () if child(scan, "points") is not None]
        if not found:
            raise UnsupportedCloud("the E57 file holds no scan of points")
        packed = [E57Points.of(scan) for scan in found]
        check_count(sum(points.count for points in packed), max_points, where="the E57 file")
        size = sum(points.count * points.row_bytes for points in packed)
        check_unpacked(size, len(raw), what="the E57 file's points")
        scans = [_placed(points.read(file), scan) for points, scan in zip(packed, found, strict=True)]
        columns = _together(scans)
        axes = [columns.pop(axis) for axis in _CARTESIAN]
        if len(scans) > 1:
            counts = [len(scan[_CARTESIAN[0]]) for scan in scans]
            columns[_SCAN] = np.repeat(np.arange(len(scans), dtype=np.uint32), counts)
        attributes = {_CALLED.get(name, name): values for name, values in columns.items()}
        return PointCloud(np.stack(axes, axis=1), attributes, beside=_beside(file, packed, columns))

    def check(self, cloud: PointCloud) -> None:
        """Raise UnsupportedCloud: of every cloud."""
        raise UnsupportedCloud("E57 files are read, not written: take another format for the result, as PLY or LAS")

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Raise as `check` does."""
        self.check(cloud)


def _placed(columns: _Columns, scan: ElementTree.Element) -> _Columns:
    """Return a scan's columns, (M,) each, of what is a point, with places and normals in the file's frame."""
    xyz, spherical = _popped(columns, _CARTESIAN), _popped(columns, _SPHERICAL)
    valid = np.logical_and.reduce([columns.pop(name) == 0 for name in _STATES if name in columns])
    if xyz is None and spherical is not None:
        reach, turn, up = spherical.T
        flat = reach * np.cos(up)
        xyz = np.stack([flat * np.cos(turn), flat * np.sin(turn), reach * np.sin(up)], axis=1)
    if xyz is None:
        held = ", ".join(columns)[:200] or "nothing else"
        raise UnsupportedCloud(f"a scan of the E57 file has no positions, cartesian or spherical, but {held}")
    rotation, translation = _pose(scan)
    columns |= zip(_CARTESIAN, (xyz @ rotation.T + translation).T, strict=True)
    if all(name in columns for name in _NORMALS):
        normals = np.stack([columns[name] for name in _NORMALS], axis=1)
        columns |= zip(_NORMALS, (normals @ rotation.T).astype(normals.dtype).T, strict=True)
    return columns if valid.all() else {name: values[valid] for name, values in columns.items()}


def _popped(columns: _Columns, names: tuple[str, ...]) -> npt.NDArray[np.float64] | None:
    """Take three columns out, together (N, 3) float64; None where they are not all there."""
    found = [columns.pop(name, None) for name in names]
    there = [column.astype(np.float64) for column in found if column is not None]
    return np.stack(there, axis=1) if len(there) == len(names) else None


def _pose(scan: ElementTree.Element) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return a scan's rotation (3, 3), of a unit quaternion, and its translation (3,): p' = R p + t (E2807, 8.4.3)."""
    pose = child(scan, "pose")
    turned = np.array([number(pose, "rotation", axis, default=float(axis == "w")) for axis in "wxyz"])
    moved = np.array([number(pose, "translation", axis) for axis in "xyz"])
    length = np.linalg.norm(turned)
    if not (0 < length < np.inf and np.isfinite(moved).all()):
        raise MalformedFile(
            f"a pose of the E57 file has the rotation {turned.tolist()} and the translation {moved.tolist()}"
        )
    w, x, y, z = (turned / length).tolist()
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]), moved  # fmt: skip


def _together(scans: list[_Columns]) -> _Columns:
    """Return what all scans have that are of any points, scan after scan."""
    filled = [scan for scan in scans if len(scan[_CARTESIAN[0]])] or scans
    common = [name for name in filled[0] if all(name in scan for scan in filled)]
    return {name: np.concatenate([scan[name] for scan in filled]) for name in common}


def _beside(file: E57File, packed: list[E57Points], columns: _Columns) -> tuple[str, ...]:
    """Name what else the file holds: fields that are no numbers or that a scan lacks, and pictures."""
    known = {*columns, *_CARTESIAN, *_SPHERICAL, *_STATES}
    others = dict.fromkeys(field.name for points in packed for field in points.fields if field.name not in known)
    return (*others, *(["images2D"] if len(child(file.root, "images2D") or ()) else []))
