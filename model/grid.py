"""Points on a grid: which cell each is in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["OFF_GRID", "cells_of"]

Floats = npt.NDArray[np.float64]

OFF_GRID = 0.05  # cells: what rounding to float32 may do, and much less than a cell


def cells_of(coordinates: Floats, first: Floats | float, edge: float) -> npt.NDArray[np.int64] | None:
    """Return in which cells of a grid of some edge, counted from `first`, coordinates lie: their shape.

    None where any is off the middle of its cell.
    """
    cells = (coordinates - first) / edge
    nearest = np.round(cells)
    return nearest.astype(np.int64) if np.abs(cells - nearest).max() < OFF_GRID else None
