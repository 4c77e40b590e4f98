"""NPY: one (N, >= 3) array of floats, or records with x, y, z; type, memory order and further columns are kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.formats.base import Format, check_room
from straightpcf.points.formats.npy_array import (
    HEADER_BYTES,
    MAGIC,
    NpyHeader,
    columns_of,
    new_array,
    patched,
    positions_header,
)
from straightpcf.points.formats.positions import widened

__all__ = ["Npy"]


@dataclass(frozen=True)
class NpySource:
    """Hold the file, its parsed header and the positions that were read from it."""

    raw: bytes
    header: NpyHeader
    xyz: npt.NDArray[np.float64]


class Npy(Format):
    """Read and write NPY; pickled objects are refused unread."""

    name = "npy"
    suffixes = (".npy",)
    media_type = "application/x-npy"

    def sniff(self, head: bytes) -> bool:
        """Recognise numpy's magic."""
        return head.startswith(MAGIC)

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read the first three columns; further ones become attributes column_4, column_5, ...

        Of records, the fields x, y, z are the positions, and the others attributes.
        """
        with path.open("rb") as file:
            header = positions_header(file.read(HEADER_BYTES), where="the array", max_points=max_points)
            there = path.stat().st_size - header.size
            check_room(header.data_bytes, there, what=f"an array of shape {header.shape}")
            file.seek(0)
            raw = file.read()
        axes, attributes, beside = columns_of(raw, header)
        xyz = widened(axes)
        return PointCloud(xyz, attributes, NpySource(raw, header, xyz.copy()), beside=beside)

    def left_behind(self, cloud: PointCloud) -> list[str]:
        """Name everything but the positions."""
        return [*cloud.beside, *cloud.attributes]

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the array that was read with its positions replaced; a cloud of another format as (N, 3) float64."""
        source = cloud.source
        if isinstance(source, NpySource):
            path.write_bytes(patched(source.raw, source.header, cloud.xyz, source.xyz))
        else:
            path.write_bytes(new_array(cloud.xyz))
