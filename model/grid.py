"""Points on a grid: which cell each is in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["OFF_GRID", "cells_of", "repeats"]

Floats = npt.NDArray[np.float64]

_SOME, _DISTINCT_SHARE = 2000, 0.9  # coordinates that are looked at first, and distinct ones among these
OFF_GRID = 0.05  # cells: what rounding to float32 may do, and much less than a cell


def cells_of(coordinates: Floats, first: Floats | float, edge: float) -> npt.NDArray[np.int64] | None:
    """Return in which cells of a grid of some edge, counted from `first`, coordinates lie: their shape.

    None where any is off the middle of its cell.
    """
    cells = (coordinates - first) / edge
    nearest = np.round(cells)
    return nearest.astype(np.int64) if np.abs(cells - nearest).max() < OFF_GRID else None


def repeats(coordinates: Floats, often: int) -> bool:
    """Say of coordinates (N,) whether each is that of some points: of so many, as a mean."""
    # At random: each n-th point of a grid may be all of one column.
    some = coordinates
    if len(some) > _SOME:
        some = coordinates[np.random.default_rng(0).integers(len(coordinates), size=_SOME)]
    if len(np.unique(some)) >= _DISTINCT_SHARE * len(some):
        return False
    return often * len(np.unique(coordinates)) <= len(coordinates)
