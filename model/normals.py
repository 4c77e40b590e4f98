"""Normals of a filtered cloud: the plane through each point's neighbours, on the side of the old normal."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

__all__ = ["recompute_normals"]

NEIGHBOURS = 16
_CHUNK = 50_000


def recompute_normals(
    xyz: npt.NDArray[np.float64], old: npt.NDArray[np.float64], *, workers: int = 1
) -> npt.NDArray[np.float64]:
    """Return unit normals (N, 3) float64 of points (N, 3): the direction in which their neighbours spread least.

    old: (N, 3), says which of the two directions is meant; where it is zero or not finite the choice is arbitrary.
    Rows whose position is not finite keep the old one. workers: threads that look up neighbours.
    """
    out = old.copy()
    rows = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    if len(rows) < 3:
        return out
    here = xyz[rows]
    tree = cKDTree(here)
    for start in range(0, len(rows), _CHUNK):
        some = slice(start, start + _CHUNK)
        _, index = tree.query(here[some], k=min(NEIGHBOURS, len(rows)), workers=workers)
        spread = here[index] - here[index].mean(axis=1, keepdims=True)  # (n, k, 3)
        largest = np.abs(spread).max(axis=(1, 2), keepdims=True)
        spread /= np.where(largest > 0, largest, 1.0)
        _, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
        normals = directions[:, :, 0]
        before = np.nan_to_num(old[rows[some]], nan=0.0, posinf=0.0, neginf=0.0)
        against = np.einsum("ni,ni->n", normals, before) < 0
        out[rows[some]] = np.where(against[:, None], -normals, normals)
    return out
