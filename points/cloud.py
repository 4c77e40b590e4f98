"""The point cloud in memory: positions to change, everything else to carry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["NORMALS", "PointCloud"]

NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))  # what files call them


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

    def new_attributes(self) -> dict[str, npt.NDArray[Any]]:
        """Return the attributes as a new file is to have them: with the new normals, if there are any."""
        if self.normals is None:
            return dict(self.attributes)
        columns = zip(self.normal_names, self.normals.T, strict=True)
        new = {name: values.astype(self.attributes[name].dtype) for name, values in columns}
        return {**self.attributes, **new}

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
