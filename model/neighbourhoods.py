"""What a few neighbours of points say: their plane, and how far they lie from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.arrays import Array, namespace

__all__ = ["INNER_SHARE", "Nearest", "Neighbourhoods", "neighbourhoods", "surface_terms"]

Floats = npt.NDArray[np.float64]

_LEAST_RADIUS = 1e-12  # of a cloud in the unit ball; where points are in one place, rounding is what is left
_SECTORS = 8  # two neighbours in each are what a surface of second order is fitted to
INNER_SHARE = 1 / 3  # of a patch's points, those whose neighbours are in the patch, too


@dataclass(frozen=True)
class Neighbourhoods:
    """The k nearest points of each of n, themselves first.

    local: (n, k, 3), from their mean; radii: (n,), how far the farthest is, above 0; axes: (n, 3, 3), columns of length
    1, the first the normal of the plane that fits them best; variances: (n, 3), k times those along the axes, rising.
    """

    local: Array
    radii: Array
    variances: Array
    axes: Array

    @property
    def normals(self) -> Array:
        """The planes' normals, (n, 3)."""
        return self.axes[:, :, 0]

    def along_axes(self) -> Array:
        """Return the points as distances along the axes, (n, k, 3): the first is the height over the plane."""
        return self.local @ self.axes


@dataclass(frozen=True)
class Nearest:
    """The k nearest points of each of n, itself first. distances: (n, k), rising; points: (n, k, 3)."""

    distances: Array
    points: Array

    @classmethod
    def of(cls, points: Floats, around: Floats, count: int) -> Nearest:
        """Look up the `count` nearest of `around` (P, 3), or as many as there are, of each of its points (n, 3)."""
        distances, index = cKDTree(around).query(points, k=np.arange(1, min(count, len(around)) + 1))
        return cls(distances, around.take(index, axis=0))

    @classmethod
    def joined(cls, parts: Sequence[Nearest]) -> Nearest:
        """Return those of several lookups as of one; k is the same in all."""
        return cls(np.concatenate([p.distances for p in parts]), np.concatenate([p.points for p in parts]))

    def first(self, count: int) -> Neighbourhoods:
        """Return the neighbourhoods of the `count` nearest, or of as many as there are."""
        xp, some = namespace(self.points), self.points[:, :count]
        # Their mean, to the bit, in a quarter of the time that `mean` takes.
        local = some - xp.einsum("nkc->nc", some)[:, None] / some.shape[1]
        variances, axes = xp.linalg.eigh(local.mT @ local)
        radii = self.distances[:, :count][:, -1].clip(min=_LEAST_RADIUS)
        return Neighbourhoods(local, radii, variances, axes)

    def in_all_directions(self, count: int) -> Nearest:
        """Return `count` of them, or as many as there are, that lie around each point; where all are arrays of NumPy.

        The nearest of each of eight sectors of their plane come first, then the second, and so on: of a scanner's rings
        the nearest alone are often all of one, which lies on a cone however noisy it is.
        """
        across = (self.points - self.points[:, :1]) @ self.first(self.points.shape[1]).axes[:, :, 1:]
        turn = np.arctan2(across[:, :, 1], across[:, :, 0]) / (2 * np.pi) + 0.5
        sector = np.minimum((turn * _SECTORS).astype(np.int64), _SECTORS - 1)
        rank = np.zeros(sector.shape, dtype=np.int64)  # in its own sector, from 1; the point itself comes before all
        for number in range(_SECTORS):
            here = sector == number
            here[:, 0] = False
            rank += np.cumsum(here, axis=1) * here
        chosen = np.sort(np.argsort(rank, axis=1, kind="stable")[:, :count], axis=1)
        points = np.take_along_axis(self.points, chosen[:, :, None], axis=1)
        return Nearest(np.take_along_axis(self.distances, chosen, axis=1), points)


def neighbourhoods(points: Floats, around: Floats, count: int) -> Neighbourhoods:
    """Look up the `count` nearest of `around` (P, 3), or as many as there are, of each of its points (n, 3)."""
    return Nearest.of(points, around, count).first(count)


def surface_terms(along: Array, *, bent: bool) -> Array:
    """Return what a plane's heights over n neighbourhoods are made of, (n, k, 3), or a quadric's if bent, (n, k, 6).

    along: (n, k, 3), as of `Neighbourhoods.along_axes`, in radii: heights, then x and y.
    """
    xp, x, y = namespace(along), along[:, :, 1], along[:, :, 2]
    terms = [xp.ones_like(x), x, y]
    if bent:
        terms += [x * x, x * y, y * y]
    return xp.stack(terms, -1)
