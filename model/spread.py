"""Spread points evenly along the surface, between two passes of the filter."""

from __future__ import annotations

from collections.abc import Iterator

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
_CHUNK = 1 << 14
_TINY = np.finfo(np.float64).tiny


def spread(xyz: Floats, limit: float, *, workers: int = 1) -> Floats:
    """Return how far each of the points (N, 3) goes to be farther from its nearest ones: (N, 3), along the surface.

    Noise moves points along a surface as far as across it, and leaves them in clumps and gaps that no clean cloud has;
    where each came from cannot be known, but that they were apart can. A weighted repulsion in the tangent plane, as in
    LOP (Lipman et al. 2007, "Parameterization-free projection for geometry reconstruction"). limit: the farthest that
    any goes, in the unit of xyz. Points of a border, whose neighbours are all on one side, stay. Takes the whole cloud
    at once, on the host, whatever tiles and device the filter has.
    """
    tree = cKDTree(xyz)
    pushing = np.empty((len(xyz), min(_PUSHING, len(xyz) - 1)), dtype=np.int32)
    normal, free = np.empty_like(xyz), np.empty((len(xyz), 1))
    for some in _chunks(len(xyz)):
        distance, index = tree.query(xyz[some], k=min(_PLANE, len(xyz) - 1) + 1, workers=workers)
        around = xyz[index[:, 1:]] - xyz[some, None]  # (n, k, 3)
        one_sided = _length((around / np.maximum(distance[:, 1:, None], _TINY)).mean(axis=1))
        pushing[some] = index[:, 1 : 1 + _PUSHING]
        normal[some] = _normals(around)
        free[some] = np.clip((_BORDER - one_sided) / (_BORDER - _INSIDE), 0, 1)
    moved = np.zeros_like(xyz)
    for _ in range(_ROUNDS):
        here = xyz + moved
        for some in _chunks(len(xyz)):
            away = here[some, None] - here[pushing[some]]
            far = _length(away)
            reach = np.maximum(far.max(axis=1, keepdims=True), _TINY)
            push = (away * (1 / np.maximum(far, _TINY) - 1 / reach)).sum(axis=1)
            push *= _STEP * far.mean(axis=1) * free[some]
            push -= (push * normal[some]).sum(axis=1, keepdims=True) * normal[some]
            moved[some] += push
    moved *= np.minimum(1, limit / np.maximum(_length(moved), _TINY))
    return moved


def _chunks(count: int) -> Iterator[slice]:
    return (slice(start, start + _CHUNK) for start in range(0, count, _CHUNK))


def _length(vectors: Floats) -> Floats:
    """Return the lengths of (..., 3) vectors, (..., 1)."""
    squared: Floats = (vectors * vectors).sum(axis=-1, keepdims=True)
    return np.sqrt(squared)


def _normals(around: Floats) -> Floats:
    """Return (n, 3) directions in which (n, k, 3) points spread least; of length 0 where they are in a line.

    The inverse of their covariance, taken as its adjugate to the fourth power, is that direction times itself. An
    approximation, unsigned, where `recompute_normals` is exact: eigenvectors took most of a spread's time.
    """
    x, y, z = np.moveaxis(around - around.mean(axis=1, keepdims=True), 2, 0)
    xx, yy, zz, xy, xz, yz = ((a * b).sum(axis=1) for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z)))
    trace = np.maximum(xx + yy + zz, _TINY)
    xx, yy, zz, xy, xz, yz = (m / trace for m in (xx, yy, zz, xy, xz, yz))
    adjugate = np.stack([
        yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
        xz * yz - xy * zz, xx * zz - xz * xz, xy * xz - xx * yz,
        xy * yz - xz * yy, xy * xz - xx * yz, xx * yy - xy * xy,
    ], axis=1).reshape(-1, 3, 3)  # fmt: skip
    for _ in range(2):
        adjugate /= np.maximum(np.abs(adjugate).max(axis=(1, 2), keepdims=True), _TINY)
        adjugate = adjugate @ adjugate
    longest = np.argmax(_length(adjugate)[:, :, 0], axis=1)
    normal = adjugate[np.arange(len(adjugate)), longest]
    return normal / np.maximum(_length(normal), _TINY)  # type: ignore[no-any-return]
