"""How a cloud's points lie on their surface: evenly, or as chance or a scanner has it, and how near it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.neighbourhoods import inner_points
from straightpcf.model.patches import Patches
from straightpcf.model.quiet import quietness
from straightpcf.model.walls import has_walls

__all__ = ["Lie", "is_scattered"]

# The ratio of the areas that a point's nearest 8 and nearest 32 others take varies, as a logarithm, with a std of
# 0.3 where points fall by chance (a beta distribution's 0.32, less what counting leaves out), and of 0.12 to 0.17 where
# they were spread evenly. Noise brings the two together: at 0.6 of the spacing to 0.27 and 0.23 (docs/training.md).
_FEW, _MANY = 8, 32
_SCATTERED, _TELLING = 0.25, 0.6
# The nearest other's area beside a 32nd of that of 32: 1.4 to 2 where points are even, 0.5 to 1 in lines, in grids of
# cells of 1 : 2.5 and more, and by chance.
_LINED = 1.3
_SAMPLES, _LEAST = 2000, 100


@dataclass(frozen=True)
class Lie:
    """How points lie before the first pass.

    scattered: on their surface by chance, or in lines, as a scene's do; quiet: how little noise an object's have beside
    the distances between them, 0 to 1; walls: whether they may be on walls closer together than these.
    """

    scattered: bool = False
    quiet: float = 0.0
    walls: bool = False

    @classmethod
    def of(cls, xyz: npt.NDArray[np.float64], patches: Patches, noise_std: float) -> Lie:
        """Look at an object's points (N, 3), with noise of some std, in some of its patches."""
        return cls(is_scattered(xyz, patches, noise_std), quietness(xyz, patches), has_walls(xyz, patches))


def is_scattered(xyz: npt.NDArray[np.float64], patches: Patches, noise_std: float) -> bool:
    """Say of points (N, 3) with noise of some std whether they lie by chance, or in lines; patches: some of them.

    Where noise is as large as the distance between points nothing tells, and they are taken for even.
    """
    size = patches.index.shape[1]
    if size < _LEAST:
        return False
    inner = list(inner_points(xyz, patches))
    step = max(1, sum(len(some) for _, some in inner) // _SAMPLES)
    areas = np.concatenate([_areas(some[::step], points) for points, some in inner])
    nearest, few, many = np.maximum(areas.T, 1e-300)
    if noise_std >= _TELLING * np.sqrt(np.pi / _MANY * np.median(many)):
        return False
    low, high = np.quantile(np.log(few / many), (0.16, 0.84))
    return bool(high - low > 2 * _SCATTERED or _MANY * np.median(nearest / many) < _LINED)


def _areas(some: npt.NDArray[np.float64], points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the squared distances from some points (n, 3) of a patch (P, 3) to three of its others.

    (n, 3): to the nearest, the 8th and the 32nd.
    """
    distances: npt.NDArray[np.float64] = cKDTree(points).query(some, k=[2, _FEW + 1, _MANY + 1])[0]  # with itself
    return np.square(distances)
