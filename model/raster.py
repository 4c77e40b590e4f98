"""Rasters: a height for every cell of a grid, as elevation models and height maps have them."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt

from straightpcf.model.grid import cells_of

__all__ = ["height_axis"]

Floats = npt.NDArray[np.float64]

_SOME, _DISTINCT_SHARE = 2000, 0.9  # points that are looked at first, and distinct coordinates of these
_POINTS_A_LINE = 4  # of a row or a column, at least, as a mean
_FILLED_SHARE = 0.25  # of the grid's cells; coordinates that are merely rounded fill hardly any


def height_axis(xyz: Floats) -> int | None:
    """Return the axis of the heights of points (N, 3) that are a raster, None where they are none.

    On a grid along the two other axes, one in a cell, and off any along this.
    """
    # At random: each n-th point of a grid may be all of one column.
    some = xyz if len(xyz) <= _SOME else xyz[np.random.default_rng(0).integers(len(xyz), size=_SOME)]
    gridded = [axis for axis in range(3) if len(np.unique(some[:, axis])) < _DISTINCT_SHARE * len(some)]
    for plane in combinations(gridded, 2):
        (up,) = set(range(3)) - set(plane)
        if _POINTS_A_LINE * len(np.unique(xyz[:, up])) <= len(xyz):
            continue
        first, second = (_cells(xyz[:, axis]) for axis in plane)
        if first is not None and second is not None:
            rows, columns = int(first.max()) + 1, int(second.max()) + 1
            filled = len(xyz) > _FILLED_SHARE * rows * columns
            return up if filled and len(np.unique(first * columns + second)) == len(xyz) else None
    return None


def _cells(coordinates: Floats) -> npt.NDArray[np.int64] | None:
    """Return which cell of an even grid each of the coordinates (N,) is in, None where they lie on none: (N,)."""
    lines = np.unique(coordinates)
    if len(lines) < 2 or _POINTS_A_LINE * len(lines) > len(coordinates):
        return None
    return cells_of(coordinates, lines[0], float(np.median(np.diff(lines))))
