"""The point cloud in memory: positions to change, everything else to carry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["PointCloud"]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Hold N points; row i is the same point everywhere.

    xyz: (N, 3) float64, the cloud's own unit and frame; rows may be NaN or infinite.
    attributes: name -> (N,) or (N, M) array, carried and never changed.
    source: what its format needs to write the file again (header, other elements, VLRs); opaque to others.
    """

    xyz: npt.NDArray[np.float64]
    attributes: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    source: Any = None

    def __post_init__(self) -> None:
        """Refuse positions that are not (N, 3) float64 and attributes of another length."""
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3 or self.xyz.dtype != np.float64:
            raise ValueError(f"xyz must be (N, 3) float64, got {self.xyz.shape} {self.xyz.dtype}")
        for name, values in self.attributes.items():
            if len(values) != len(self.xyz):
                raise ValueError(f"attribute {name!r} has {len(values)} rows for {len(self.xyz)} points")

    def __len__(self) -> int:
        return len(self.xyz)

    def with_xyz(self, xyz: npt.NDArray[np.float64]) -> PointCloud:
        """Return the same cloud at new positions, (N, 3) float64 in the same order."""
        if xyz.shape != self.xyz.shape:
            raise ValueError(f"positions for {len(self)} points must be {self.xyz.shape}, got {xyz.shape}")
        return replace(self, xyz=xyz)
