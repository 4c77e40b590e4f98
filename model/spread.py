"""Spread points evenly along the surface, between two passes of the filter."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

__all__ = ["spread"]

Floats = npt.NDArray[np.float64]

_ROUNDS = 2
_STEP = 0.2
_PUSHING = 8  # neighbours
_PLANE = 16  # neighbours of which the tangent plane is taken
# The length of the mean direction to a point's neighbours: 0 where they are all around, 0.64 on a straight border.
_BORDER, _INSIDE = 0.5, 0.3
_CHUNK = 50_000
_TINY = np.finfo(np.float64).tiny


def spread(xyz: Floats, limit: float, *, workers: int = 1) -> Floats:
    """Return how far each of the points (N, 3) goes to be farther from its nearest ones: (N, 3), along the surface.

    Noise moves points along a surface as far as across it, and leaves them in clumps and gaps that no clean cloud has;
    where each came from cannot be known, but that they were apart can. A weighted repulsion in the tangent plane, as in
    LOP (Lipman et al. 2007, "Parameterization-free projection for geometry reconstruction"). limit: the farthest that
    any goes, in the unit of xyz. Points of a border, whose neighbours are all on one side, stay.
    """
    moved = np.zeros_like(xyz)
    for _ in range(_ROUNDS):
        here = xyz + moved
        tree = cKDTree(here)
        for start in range(0, len(xyz), _CHUNK):
            some = slice(start, start + _CHUNK)
            moved[some] += _push(here, tree, some, workers)
    length = np.linalg.norm(moved, axis=1, keepdims=True)
    moved *= np.minimum(1, limit / np.maximum(length, _TINY))
    return moved


def _push(xyz: Floats, tree: cKDTree, some: slice, workers: int) -> Floats:
    distance, index = tree.query(xyz[some], k=min(_PLANE, len(xyz) - 1) + 1, workers=workers)
    around = xyz[index[:, 1:]] - xyz[some, None]  # (n, k, 3)
    away = -around / np.maximum(distance[:, 1:, None], _TINY)
    one_sided = np.linalg.norm(away.mean(axis=1), axis=1, keepdims=True)
    far = distance[:, 1 : _PUSHING + 1, None]
    push: Floats = (away[:, :_PUSHING] * (1 - far / np.maximum(far[:, -1:], _TINY))).sum(axis=1)
    push *= _STEP * far.mean(axis=1) * np.clip((_BORDER - one_sided) / (_BORDER - _INSIDE), 0, 1)
    offset = around - around.mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    push -= (push * normal).sum(axis=1, keepdims=True) * normal
    return push
