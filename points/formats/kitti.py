"""KITTI Velodyne frames: bare float32 rows of x, y, z, intensity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import HEAD_BYTES, Format, check_count
from straightpcf.points.formats.positions import AXES, narrowed, put_positions, rounding, widened
from straightpcf.points.formats.scalars import with_intensity

__all__ = ["Kitti"]

ROW_BYTES = 16
_TEXT = bytes(range(32, 127)) + b"\t\r\n"
_MOST_LOST = 1e-4  # of the cloud's extent, by rounding; a frame's own is 1e-7, a town's in UTM coordinates 1e-3


@dataclass(frozen=True)
class KittiSource:
    """Hold the frame's bytes and the positions that were read from them."""

    raw: bytes
    xyz: npt.NDArray[np.float64]


class Kitti(Format):
    """Read and write .bin frames; any 16 bytes are a row, so the name decides."""

    name = "kitti"
    suffixes = (".bin",)
    media_type = "application/octet-stream"
    has_magic = False

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read rows of four float32; the fourth is the attribute `intensity`.

        Raises UnsupportedCloud where it cannot be one: the rows are of three, five or six numbers then.
        """
        size = path.stat().st_size
        check_count(size // ROW_BYTES, max_points, where=f"a KITTI frame of {size} bytes")
        if size % ROW_BYTES:
            raise MalformedFile(
                f"a KITTI frame has {ROW_BYTES} bytes a point; of {size} bytes the last {size % ROW_BYTES} are none"
            )
        raw = path.read_bytes()
        if raw and not raw[:HEAD_BYTES].translate(None, _TEXT):  # which reads as small numbers, none below 0
            raise UnsupportedCloud("a KITTI frame has four float32 a point, and this is text: call it .xyz or .csv")
        rows = np.frombuffer(raw, "<f4").reshape(-1, 4)
        _check_intensity(rows[:, 3])
        xyz = widened([rows[:, axis] for axis in range(3)])
        return PointCloud(xyz, {"intensity": rows[:, 3]}, KittiSource(raw, xyz.copy()))

    def left_behind(self, cloud: PointCloud) -> list[str]:
        """Name everything but positions and an intensity that a frame can have, float32 as in every frame."""
        called = with_intensity(cloud.attributes)  # the same attributes, in the same order
        held = "intensity" if _has_intensity(called) else None
        return [*cloud.beside, *(was for was, name in zip(cloud.attributes, called, strict=True) if name != held)]

    def check(self, cloud: PointCloud) -> None:
        """Raise UnsupportedCloud where float32 does not hold the cloud."""
        _new_rows(cloud)

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the rows with their positions replaced; a cloud of another format as float32, intensity or 0."""
        source = cloud.source
        if isinstance(source, KittiSource):
            out = bytearray(source.raw)
            rows = np.frombuffer(out, "<f4").reshape(-1, 4)
            put_positions({name: rows[:, axis] for axis, name in enumerate(AXES)}, cloud.xyz, source.xyz)
            path.write_bytes(out)
            return
        path.write_bytes(_new_rows(cloud).tobytes())


def _new_rows(cloud: PointCloud) -> npt.NDArray[np.float32]:
    table = np.zeros((len(cloud), 4), "<f4")
    table[:, :3] = narrowed(cloud.xyz, table.dtype, what="a position")
    _check_rounding(cloud.xyz, table[:, :3])
    if _has_intensity(attributes := with_intensity(cloud.attributes)):
        with np.errstate(invalid="ignore"):  # a signalling NaN is no warning
            wide = attributes["intensity"].astype(np.float64)
        table[:, 3] = narrowed(wide, table.dtype, what="an intensity")
    return table


def _has_intensity(attributes: Mapping[str, npt.NDArray[Any]]) -> bool:
    values = attributes.get("intensity")
    is_column = values is not None and values.ndim == 1 and values.dtype.kind in "biuf"
    return is_column and bool(_are_intensities(attributes["intensity"]).all())


def _check_intensity(values: npt.NDArray[np.float32]) -> None:
    """Refuse the fourth numbers (N,) of what only divides into rows of four: it would be scrambled."""
    are = _are_intensities(values)
    if not are.all():
        row = int(np.argmin(are))
        raise UnsupportedCloud(
            "a KITTI frame has four float32 a point, x, y, z and an intensity of 0..1 or 0..255; the fourth of "
            f"point {row} is {values[row]:g}: rows of another length can be taken as (N, M) float32 in a .npy file"
        )


def _are_intensities(values: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Say of each of (N,) numbers whether it is finite and none below 0; tools disagree on how large it may be."""
    with np.errstate(invalid="ignore"):  # a signalling NaN is no warning
        are: npt.NDArray[np.bool_] = np.isfinite(values) & (values >= 0)
    return are


def _check_rounding(xyz: npt.NDArray[np.float64], stored: npt.NDArray[np.float32]) -> None:
    """Refuse positions (N, 3) that lie so far out beside their extent that float32 tells neighbours no more apart."""
    lost, half = rounding(xyz, stored)
    if lost / 2 > _MOST_LOST * half:
        raise UnsupportedCloud(
            f"rounded to float32, as a KITTI frame has them, positions would be up to {lost:.3g} off, more than "
            f"{_MOST_LOST:g} of the cloud's extent ({2 * half:.6g}): take another format, or move it to its origin"
        )
