"""E57: the scans of a terrestrial scanner, each in the place that its pose gives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import UnsupportedCloud
from straightpcf.points.formats.base import Format, check_count, check_unpacked
from straightpcf.points.formats.e57_file import MAGIC, E57File, E57Points, child, scans_of
from straightpcf.points.formats.e57_new import TYPES, check_new, lost, new_e57
from straightpcf.points.formats.e57_scan import CALLED, CARTESIAN, SPHERICAL, STATES, Columns, E57Scan
from straightpcf.points.formats.e57_write import check_changeable, with_changes
from straightpcf.points.formats.positions import changes, moved

__all__ = ["E57"]

_SCAN = "scan"


class E57(Format):
    """Read all scans of an E57 file as one cloud, in the file's common frame.

    What a scanner has no distance for is no point. With several scans `scan` says which one a point is of, 0 and up.
    """

    name = "e57"
    suffixes = (".e57",)
    media_type = "model/e57"
    writes_normals = True
    types = TYPES

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
        found = scans_of(file.root)
        if not found:
            raise UnsupportedCloud("the E57 file holds no scan of points")
        packed = [E57Points.of(scan) for scan in found]
        check_count(sum(points.count for points in packed), max_points, where="the E57 file")
        size = sum(points.count * points.row_bytes for points in packed)
        check_unpacked(size, len(raw), what="the E57 file's points")
        scans, read = [], []
        for element, points in zip(found, packed, strict=True):
            scan, columns = E57Scan.read(file, element, points)
            scans.append(scan)
            read.append(columns)
        columns = _together(read)
        xyz = np.stack([columns.pop(axis) for axis in CARTESIAN], axis=1)
        if len(scans) > 1:
            columns[_SCAN] = np.repeat(np.arange(len(scans), dtype=np.uint32), [scan.size for scan in scans])
        attributes = {CALLED.get(name, name): values for name, values in columns.items()}
        source = E57Source(file, tuple(scans), xyz.copy())
        return PointCloud(xyz, attributes, source, beside=_beside(file, packed, columns))

    def left_behind(self, cloud: PointCloud) -> list[str]:
        """Name what a new file has no place or another name for; nothing of a file that was one."""
        return [] if isinstance(cloud.source, E57Source) else lost(cloud)

    def check(self, cloud: PointCloud) -> None:
        """Raise UnsupportedCloud where no file can be written."""
        source = cloud.source
        if isinstance(source, E57Source):
            check_changeable(source.file, [scan.points for scan in source.scans])
        else:
            check_new(cloud)

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the file that was read, what moved in its scan's own frame; or a new one."""
        source = cloud.source
        if not isinstance(source, E57Source):
            path.write_bytes(new_e57(cloud))
            return
        _, new, old = changes(cloud, source.xyz, CARTESIAN)
        changed = moved(new, old)
        ends = np.cumsum([scan.size for scan in source.scans]).tolist()
        parts = [(scan, slice(end - scan.size, end)) for scan, end in zip(source.scans, ends, strict=True)]
        made = [
            scan.change(source.file, new[part], old[part], changed[part]) for scan, part in parts if changed[part].any()
        ]
        path.write_bytes(with_changes(source.file, made) if made else source.file.raw)


@dataclass(frozen=True)
class E57Source:
    """Hold the file, its scans that have points, and the positions (N, 3) that were read of them."""

    file: E57File
    scans: tuple[E57Scan, ...]
    xyz: npt.NDArray[np.float64]


def _together(scans: list[Columns]) -> Columns:
    """Return what all scans have that are of any points, scan after scan."""
    filled = [scan for scan in scans if len(scan[CARTESIAN[0]])] or scans
    common = [name for name in filled[0] if all(name in scan for scan in filled)]
    return {name: np.concatenate([scan[name] for scan in filled]) for name in common}


def _beside(file: E57File, packed: list[E57Points], columns: Columns) -> tuple[str, ...]:
    """Name what else the file holds: fields that are no numbers or that a scan lacks, and pictures."""
    known = {*columns, *CARTESIAN, *SPHERICAL, *STATES}
    others = dict.fromkeys(field.name for points in packed for field in points.fields if field.name not in known)
    pictures = child(file.root, "images2D")
    return (*others, *(["images2D"] if pictures is not None and len(pictures) else []))
