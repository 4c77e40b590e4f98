"""The point cloud in memory: positions to change, everything else to carry; and what is taken for positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import InvalidCloud

__all__ = ["NORMALS", "PointCloud", "as_positions"]

# What files call them: PLY, PCD, PDAL; CloudCompare's text, and others'.
NORMALS = (
    *(("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("NormalX", "NormalY", "NormalZ")),
    *(("Nx", "Ny", "Nz"), ("NX", "NY", "NZ")),
)
_NORMAL_ARRAYS = ("normals", "normal")  # (N, 3), in NumPy's archives


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Hold N points; row i is the same point everywhere.

    xyz: (N, 3) float64, the cloud's own unit and frame; rows may be NaN or infinite.
    attributes: name -> (N,) or (N, M) array, carried and never changed.
    source: what its format needs to write the file again (header, other elements, VLRs); opaque to others.
    normals: (N, 3) float64 to write in the place of the file's own; None: as they are.
    beside: names of what else the file holds (faces, columns of text, a reference system), kept by its own format only.
    """

    xyz: npt.NDArray[np.float64]
    attributes: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    source: Any = None
    normals: npt.NDArray[np.float64] | None = None
    beside: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse positions that are not (N, 3) float64 and attributes of another length."""
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3 or self.xyz.dtype != np.float64:
            raise ValueError(f"xyz must be (N, 3) float64, got {self.xyz.shape} {self.xyz.dtype}")
        for name, values in self.attributes.items():
            if len(values) != len(self.xyz):
                raise ValueError(f"attribute {name!r} has {len(values)} rows for {len(self.xyz)} points")

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def normal_names(self) -> tuple[str, ...]:
        """Name the three attributes that are the points' normals; empty if there are none."""
        for names in NORMALS:
            found = [self.attributes[name] for name in names if name in self.attributes]
            if len(found) == 3 and all(values.ndim == 1 and values.dtype.kind == "f" for values in found):
                return names
        return ()

    def old_normals(self) -> npt.NDArray[np.float64]:
        """Return the normals that were read, (N, 3) float64; the cloud must have some."""
        with np.errstate(invalid="ignore"):
            return np.stack([self.attributes[name].astype(np.float64) for name in self.normal_names], axis=1)

    def new_attributes(self, normals: tuple[str, ...]) -> dict[str, npt.NDArray[Any]]:
        """Return the attributes as a new file is to have them: with the new normals, if there are any.

        normals: what its format calls them; others would be columns of numbers to its readers.
        """
        new = dict(self.attributes)
        if self.normals is not None:
            columns = zip(self.normal_names, self.normals.T, strict=True)
            new |= {name: values.astype(self.attributes[name].dtype) for name, values in columns}
        if {*normals} & {*new}:
            return new
        if names := self.normal_names:
            called = dict(zip(names, normals, strict=True))
            return {called.get(name, name): values for name, values in new.items()}
        return self._apart(new, normals)

    def in_columns(self) -> dict[str, npt.NDArray[Any]]:
        """Return the attributes as tables and LAS are to have them: an array of normals as nx, ny and nz."""
        own, names = dict(self.attributes), NORMALS[0]
        return own if self.normal_names or {*names} & {*own} else self._apart(own, names)

    def _apart(self, new: dict[str, npt.NDArray[Any]], normals: tuple[str, ...]) -> dict[str, npt.NDArray[Any]]:
        """Put three columns of these names in the place of an array of normals, if there is one."""
        for name in _NORMAL_ARRAYS:
            if name in new and new[name].shape == (len(self), 3) and new[name].dtype.kind == "f":
                together = new.pop(name)
                return {**new, **dict(zip(normals, together.T, strict=True))}
        return new

    def with_normals(self, normals: npt.NDArray[np.float64]) -> PointCloud:
        """Return the same cloud with other normals, (N, 3) float64; it must have some."""
        if normals.shape != self.xyz.shape or not self.normal_names:
            raise ValueError(f"normals {normals.shape} for {len(self)} points with {self.normal_names or 'no normals'}")
        return replace(self, normals=normals)

    def with_xyz(self, xyz: npt.NDArray[np.float64]) -> PointCloud:
        """Return the same cloud at new positions, (N, 3) float64 in the same order."""
        if xyz.shape != self.xyz.shape:
            raise ValueError(f"positions for {len(self)} points must be {self.xyz.shape}, got {xyz.shape}")
        return replace(self, xyz=xyz)


def as_positions(points: Any) -> npt.NDArray[np.floating[Any]]:
    """Return (N, 3) numbers of any kind, lists and tensors among them, as floats of 16, 32 or 64 bits.

    What is masked is no point: it becomes NaN, and passes through as such. Raises InvalidCloud.
    """
    try:
        array = np.ma.asanyarray(points)
    except (TypeError, ValueError, RuntimeError) as exc:  # rows of several lengths, and torch's own reasons
        raise InvalidCloud(f"points must be (N, 3) numbers: {exc}") from exc
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        got = f"{array.shape} {array.dtype}" if array.ndim else f"a {type(points).__name__}"
        hint = "; transpose them" if array.ndim == 2 and len(array) == 3 else ""
        raise InvalidCloud(f"points must be (N, 3) numbers, got {got}{hint}")
    xyz: npt.NDArray[Any] = np.asarray(array)
    if xyz.dtype.kind != "f" or xyz.dtype.itemsize > 8:
        xyz = xyz.astype(np.float64)
    return np.where(np.ma.getmaskarray(array), np.nan, xyz) if np.ma.is_masked(array) else xyz
