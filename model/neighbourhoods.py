"""What a few neighbours of points say: their plane, and how far they lie from it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.patches import Patches

__all__ = ["INNER", "Neighbourhoods", "inner_points", "neighbourhoods", "nested_neighbourhoods"]

Floats = npt.NDArray[np.float64]

INNER = 1 / 3  # of a patch's points, those whose neighbours are in the patch, too


@dataclass(frozen=True)
class Neighbourhoods:
    """The k nearest points of each of n, themselves first.

    local: (n, k, 3), from their mean; radii: (n,), how far the farthest is; axes: (n, 3, 3), columns of length 1, the
    first the normal of the plane that fits them best; variances: (n, 3), k times those along the axes, rising.
    """

    local: Floats
    radii: Floats
    variances: Floats
    axes: Floats

    @property
    def normals(self) -> Floats:
        """The planes' normals, (n, 3)."""
        return self.axes[:, :, 0]

    def along_axes(self) -> Floats:
        """Return the points as distances along the axes, (n, k, 3): the first is the height over the plane."""
        along: Floats = self.local @ self.axes
        return along


def neighbourhoods(points: Floats, around: Floats, count: int) -> Neighbourhoods:
    """Look up the `count` nearest of `around` (P, 3), or as many as there are, of each of its points (n, 3)."""
    return next(nested_neighbourhoods(points, around, (count,)))


def nested_neighbourhoods(points: Floats, around: Floats, counts: Sequence[int]) -> Iterator[Neighbourhoods]:
    """Yield what `neighbourhoods` returns for each of some counts; the nearest are looked up once."""
    most = min(max(counts), len(around))
    distances, nearest = cKDTree(around).query(points, k=np.arange(1, most + 1))
    everyone = around[nearest]
    for count in counts:
        local = everyone[:, :count] - everyone[:, :count].mean(axis=1, keepdims=True)
        variances, axes = np.linalg.eigh(local.mT @ local)
        yield Neighbourhoods(local, distances[:, :count][:, -1], variances, axes)


def inner_points(xyz: Floats, patches: Patches) -> Iterator[tuple[Floats, Floats]]:
    """Yield patches of points (N, 3): their points (P, 3), and (n, 3) of these, from the middle outwards.

    The inner ones are those whose neighbours are in the patch, too: of a cloud that is one patch all.
    """
    size = patches.index.shape[1]
    inner = size if len(patches.seeds) == 1 else round(INNER * size)
    for rows in patches.index:
        points = xyz[rows]
        middle = np.square(points - points.mean(axis=0)).sum(axis=1)
        yield points, points[np.argsort(middle)[:inner]]
