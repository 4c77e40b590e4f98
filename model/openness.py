"""Whether points are of a place, a street or a field, and of no object: it is open at its borders, and wide."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from straightpcf.model.neighbourhoods import Nearest

__all__ = ["is_of_open_place"]

Floats = npt.NDArray[np.float64]

_ASKED, _NEIGHBOURS = 3000, 24  # points, evenly among all in their order, and of how many nearest each is
# A point is at a border where its neighbours leave out a third of the directions in their plane: at the rim of what was
# scanned, of a shadow, of a leaf. 0.05 to 0.3 of a place's points are, 0.05 of an object's and less.
_BORDER_DEGREES, _BORDER_SHARE = 120, 0.04
# Of a place such a share of planes and more are within so many degrees of one, the ground's or a wall's, and half of
# its extent along their normal, in the unit ball, is no more than the last. Of whole objects with borders 0.25 are, of
# those that are seen from one side 0.5 to 0.75, but most of these reach 0.5 and more.
_ALIKE_DEGREES, _ALIKE_SHARE, _LARGEST_EXTENT = 15, 0.35, 0.4
_CANDIDATES = 200  # planes with which all others are compared
_OUTSIDE_SHARE = 0.01  # of the points on either side, which may be strays and do not count for the extent


def is_of_open_place(xyz: Floats) -> bool:
    """Say whether points (N, 3) of the unit ball are few of a place rather than an object; noise must be little."""
    rows = np.linspace(0, len(xyz) - 1, min(_ASKED, len(xyz))).astype(np.int64)
    nearest = Nearest.of(xyz[rows], xyz, _NEIGHBOURS)
    near = nearest.first(_NEIGHBOURS)
    others = nearest.points[:, 1:] - nearest.points[:, :1]
    if np.mean(_widest_gaps(others @ near.axes[:, :, 1:]) > np.deg2rad(_BORDER_DEGREES)) < _BORDER_SHARE:
        return False
    normals = near.normals
    candidates = normals[:: max(1, len(normals) // _CANDIDATES)]
    alike = (np.abs(normals @ candidates.T) > np.cos(np.deg2rad(_ALIKE_DEGREES))).mean(axis=0)
    if alike.max() < _ALIKE_SHARE:
        return False
    low, high = np.quantile(xyz @ candidates[np.argmax(alike)], (_OUTSIDE_SHARE, 1 - _OUTSIDE_SHARE))
    return bool(high - low < 2 * _LARGEST_EXTENT)


def _widest_gaps(across: Floats) -> Floats:
    """Return the widest angle between directions (n, k, 2) that follow one another: (n,)."""
    turns = np.sort(np.arctan2(across[:, :, 1], across[:, :, 0]), axis=1)
    gaps: Floats = np.diff(turns, axis=1, append=turns[:, :1] + 2 * np.pi).max(axis=1)
    return gaps
