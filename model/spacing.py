"""How a cloud's points lie on their surface: evenly, or as chance or a scanner has it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.patches import Patches

__all__ = ["is_scattered"]

# The ratio of the areas that a point's nearest 8 and nearest 32 others take varies, as a logarithm, with a std of
# 0.3 where points fall by chance (a beta distribution's 0.32, less what counting leaves out), and of 0.12 to 0.17 where
# they were spread evenly. Noise brings the two together: at 0.6 of the spacing to 0.27 and 0.23 (docs/training.md).
_FEW, _MANY = 8, 32
_SCATTERED, _TELLING = 0.25, 0.6
# The nearest other's area beside a 32nd of that of 32: 1.4 to 2 where points are even, 0.5 to 1 in lines, in grids of
# cells of 1 : 2.5 and more, and by chance.
_LINED = 1.3
_SAMPLES, _LEAST = 2000, 100
_INNER = 1 / 3  # of a patch's points, those whose neighbours are in the patch, too


def is_scattered(xyz: npt.NDArray[np.float64], patches: Patches, noise_std: float) -> bool:
    """Say of points (N, 3) with noise of some std whether they lie by chance, or in lines; patches: some of them.

    Where noise is as large as the distance between points nothing tells, and they are taken for even.
    """
    size = patches.index.shape[1]
    if size < _LEAST:
        return False
    inner = size if len(patches.seeds) == 1 else round(_INNER * size)
    step = max(1, inner * len(patches.seeds) // _SAMPLES)
    areas = np.concatenate([_areas(xyz[rows], inner, step) for rows in patches.index])
    nearest, few, many = np.maximum(areas.T, 1e-300)
    if noise_std >= _TELLING * np.sqrt(np.pi / _MANY * np.median(many)):
        return False
    low, high = np.quantile(np.log(few / many), (0.16, 0.84))
    return bool(high - low > 2 * _SCATTERED or _MANY * np.median(nearest / many) < _LINED)


def _areas(points: npt.NDArray[np.float64], inner: int, step: int) -> npt.NDArray[np.float64]:
    """Return the squared distances from every step-th of the inner points of a patch (P, 3) to three of the others.

    (n, 3): to the nearest, the 8th and the 32nd; inner: how many points count as inner, those nearest to the middle.
    """
    middle = np.square(points - points.mean(axis=0)).sum(axis=1)
    some = points[np.argsort(middle)[:inner:step]]
    distances: npt.NDArray[np.float64] = cKDTree(points).query(some, k=[2, _FEW + 1, _MANY + 1])[0]  # with itself
    return np.square(distances)
