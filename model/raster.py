"""Rasters: a height for every cell of a grid, as elevation models and height maps have them."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt

from straightpcf.model.grid import cells_of, repeats

__all__ = ["height_axis"]

Floats = npt.NDArray[np.float64]

_POINTS_A_LINE = 4  # of a row or a column, at least, as a mean
_FILLED_SHARE = 0.25  # of the grid's cells; coordinates that are merely rounded fill hardly any


def height_axis(xyz: Floats) -> int | None:
    """Return the axis of the heights of points (N, 3) that are a raster, None where they are none.

    On a grid along the two other axes, one in a cell. The heights may be rounded, to metres as well.
    """
    cells = {axis: _cells(xyz[:, axis]) for axis in range(3) if repeats(xyz[:, axis], _POINTS_A_LINE)}
    for plane in combinations(cells, 2):
        (up,) = set(range(3)) - set(plane)
        first, second = (cells[axis] for axis in plane)
        if first is None or second is None or np.ptp(xyz[:, up]) == 0.0:
            continue
        rows, columns = int(first.max()) + 1, int(second.max()) + 1
        filled = len(xyz) > _FILLED_SHARE * rows * columns
        if filled and len(np.unique(first * columns + second)) == len(xyz):
            return up
    return None


def _cells(coordinates: Floats) -> npt.NDArray[np.int64] | None:
    """Return which cell of an even grid each of the coordinates (N,) is in, None where they lie on none: (N,)."""
    lines = np.unique(coordinates)
    if len(lines) < 2:
        return None
    return cells_of(coordinates, lines[0], float(np.median(np.diff(lines))))
