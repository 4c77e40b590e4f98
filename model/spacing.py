"""How a cloud's points lie on their surface: evenly, or as chance or a scanner has it, and how near it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from straightpcf.model.neighbourhoods import Nearest, inner_points
from straightpcf.model.patches import Patches
from straightpcf.model.processor import Each, Floats
from straightpcf.model.quiet import noise_in_neighbourhoods, quietness
from straightpcf.model.walls import between_walls, has_walls

__all__ = ["Lie"]

# The ratio of the areas that a point's nearest 8 and nearest 32 others take varies, as a logarithm, with a std of
# 0.3 where points fall by chance (a beta distribution's 0.32, less what counting leaves out), and of 0.12 to 0.17 where
# they were spread evenly. Noise brings the two together: at 0.6 of the spacing to 0.27 and 0.23 (docs/training-log.md).
_FEW, _MANY = 8, 32
_SCATTERED, _TELLING = 0.25, 0.6
# The nearest other's area beside a 32nd of that of 32: 1.4 to 2 where points are even, 0.5 to 1 in lines, in grids of
# cells of 1 : 2.5 and more, and by chance.
_LINED = 1.3
_LEAST = 100  # points of a patch; of fewer a third have the nearest 32 in common
_NEAREST = 64  # what the looks ask for
_SAMPLES, _SAMPLES_OF_ALL = 128, 2000  # points of a patch that are looked at, at most, and of all where they are few


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
    def of(cls, xyz: Floats, patches: Patches, noise_std: float, *, each: Each = map) -> Lie:
        """Look at an object's points (N, 3), with noise of some std, in some of its patches.

        each: calls a function with the patches' rows, on threads if it has some.
        """
        samples = max(_SAMPLES, _SAMPLES_OF_ALL // len(patches.index))
        size, look = patches.index.shape[1], partial(_Look.at, xyz, samples, len(patches.index) == 1)
        looks = list(each(look, patches.index))
        scattered = size >= _LEAST and _is_scattered(np.concatenate([look.areas for look in looks]), noise_std)
        walls = has_walls([look.between_walls for look in looks])
        return cls(scattered, quietness([look.noise for look in looks]), walls)


@dataclass(frozen=True)
class _Look:
    """What n points of a patch have around them.

    areas: (n, 3), squared distances to the nearest other, the 8th and the 32nd; noise, between_walls: as of
    `noise_in_neighbourhoods` and `between_walls`.
    """

    areas: Floats
    noise: float
    between_walls: list[bool]

    @classmethod
    def at(cls, xyz: Floats, samples: int, whole: bool, rows: npt.NDArray[np.int32]) -> _Look:
        points = xyz[rows]
        inner = inner_points(points, whole=whole)
        near = Nearest.of(inner[:: math.ceil(len(inner) / samples)], points, _NEAREST)
        last = near.distances.shape[1] - 1
        areas = np.square(near.distances[:, [1, min(_FEW, last), min(_MANY, last)]])
        return cls(areas, noise_in_neighbourhoods(near), between_walls(near))


def _is_scattered(areas: Floats, noise_std: float) -> bool:
    """Say whether points with noise of some std lie by chance, or in lines; areas: (n, 3), as of `_Look`.

    Where noise is as large as the distance between points nothing tells, and they are taken for even.
    """
    nearest, few, many = np.maximum(areas.T, 1e-300)
    if noise_std >= _TELLING * np.sqrt(np.pi / _MANY * np.median(many)):
        return False
    low, high = np.quantile(np.log(few / many), (0.16, 0.84))
    return bool(high - low > 2 * _SCATTERED or _MANY * np.median(nearest / many) < _LINED)
