"""How a surface was sampled: evenly, or as chance or a scanner has it, and how near to it its points lie."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from straightpcf.model.arrays import on_host
from straightpcf.model.low_noise import EXACT_PLANE_RATIO, HIGH_NOISE_RATIO, NeighbourhoodNoise, low_noise_weight
from straightpcf.model.neighbourhoods import Nearest
from straightpcf.model.normalize import HIGH_NOISE
from straightpcf.model.openness import is_of_open_place
from straightpcf.model.patches import Patches
from straightpcf.model.processor import Floats
from straightpcf.model.spread import ROUNDS
from straightpcf.model.survey import Survey, survey
from straightpcf.model.walls import WALL_PATCHES_SHARE, has_walls, hiding_share, midway_shares, showing_share

__all__ = ["Sampling"]

# The ratio of the areas that a point's nearest 8 and nearest 32 others take varies, as a logarithm, with a std of
# 0.3 where points fall by chance (a beta distribution's 0.32, less what counting leaves out), and of 0.12 to 0.17 where
# they were spread evenly. Noise brings the two together: at 0.6 of the spacing to 0.27 and 0.23 (docs/training-log.md).
_FEW_NEIGHBOURS, _MANY_NEIGHBOURS = 8, 32
_IRREGULAR_STD, _TELLING_NOISE = 0.25, 0.6
# Of walls close together half of the 32 are on the other one: 0.13 to 0.18 where points are even, with 1 % of noise,
# and 0.22 to 0.33 by chance. The noise that is read there is the walls.
_IRREGULAR_STD_OF_WALLS = 0.2
# The nearest other's area beside a 32nd of that of 32: 1.4 to 2 where points are even, 0.5 to 1 in lines, in grids of
# cells of 1 : 2.5 and more, and by chance.
_LINES_AREA_RATIO = 1.3
# Where so many points are far off their neighbours' surface, and what was read is so many times the noise of the
# others, it is the noise of those few.
_LOUD_SHARE, _LOUD_RATIO = 0.005, 1.7
# Few neighbours show less noise than there is, and some points of a place have more than most.
_BELIEVED_RATIO = 1.5
# The more evenly points lie, the more the network believes in layers of them: in two walls or, where noise is more than
# it was trained on (HIGH_NOISE), in two of one surface. So where that is and hardly any patch may hide walls, points
# are spread in fewer rounds; in more where noise (its std in the unit ball) is strong, many patches may hide walls, and
# many show them after the first pass: the first share and twice the second are 0.84 and less of bodies and lattices,
# 1.06 and more of thin walls.
_STRONG_NOISE, _HARDLY_HIDING_SHARE, _HIDING_AND_SHOWING = 0.025, 0.18, 0.95
_ROUNDS_OF_ONE_SURFACE, _ROUNDS_OF_WALLS = 1, 4
# Where the nearest 16 are of one line of a scanner's, in the plane of its beams, they are 0.02 to 0.65 times as broad
# as long, on surfaces 0.72 and more; and 16 of the 64 nearest that lie in all directions show 3 times their noise and
# more, both in radii, of other clouds 0.7 to 1.7 times, but for walls close together.
_LINES_BREADTH, _LINES_NOISE_RATIO = 0.7, 2.5
_LEAST_PATCH_POINTS = 100  # points of a patch; of fewer a third have the nearest 32 in common


@dataclass(frozen=True)
class Sampling:
    """How points lie before a pass; all but thin_walls and uncovered as before the first.

    irregular: on their surface by chance, or in lines, as a scene's do; in_lines: whether the nearest of most are of
    one line, in the plane of whose beams they lie whatever their noise; low_noise: how little noise an object's have
    beside the distances between them, 0 to 1; thin_walls: whether they may be on walls closer together than these;
    hiding_share: of their patches, in which noise may hide such; uncovered: whether a pass has taken most of it, and
    walls that it hid were looked for; noise_of_most: the noise std of most points, where a few have so much more that
    theirs is what is read of all, else infinite; of_place: whether these few are leaves, poles and what else
    is scattered over a place of which few points are left.
    """

    irregular: bool = False
    in_lines: bool = False
    low_noise: float = 0.0
    thin_walls: bool = False
    hiding_share: float = 0.0
    uncovered: bool = False
    noise_of_most: float = np.inf
    of_place: bool = False

    @property
    def restrains(self) -> bool:
        """Whether a step of an object is not made as the network asks for it."""
        return self.irregular or self.thin_walls or self.low_noise > 0

    @property
    def noise_of_place(self) -> float | None:
        """The noise std that is believed of all points of a place, as of a scene's; None of an object."""
        return _BELIEVED_RATIO * self.noise_of_most if self.of_place else None

    @classmethod
    def of(cls, xyz: Floats, patches: Patches, noise_std: float, *, survey: Survey = survey) -> Sampling:
        """Look at an object's points (N, 3), with noise of some std, in some of its patches."""
        found = list(survey(xyz, patches, _PatchStatistics.of))
        shares = np.concatenate([s.midway_shares for s in found])
        thin_walls = has_walls(shares)
        areas = np.concatenate([s.areas for s in found])
        noise, in_lines = [s.noise for s in found], False
        nearest, breadth = _in_radii(noise), np.median(np.concatenate([n.breadths for n in noise]))
        if nearest < HIGH_NOISE_RATIO and breadth < _LINES_BREADTH:
            of_lines = list(survey(xyz, patches, NeighbourhoodNoise.of_lines))
            in_lines = _in_radii(of_lines) > max(EXACT_PLANE_RATIO, _LINES_NOISE_RATIO * nearest)
            noise = of_lines if in_lines else noise
        noise_of_most = _noise_of_most(noise, noise_std)
        noise_std = min(noise_std, noise_of_most)
        enough = patches.index.shape[1] >= _LEAST_PATCH_POINTS
        irregular = enough and _is_irregular(areas, noise_std, thin_walls=thin_walls)
        low_noise = low_noise_weight(np.concatenate([n.in_radii for n in noise]))
        return cls(
            irregular,
            in_lines,
            low_noise,
            thin_walls,
            hiding_share=hiding_share(shares),
            noise_of_most=noise_of_most,
            of_place=low_noise > 0 and np.isfinite(noise_of_most) and is_of_open_place(xyz),
        )

    def after_pass(self, xyz: Floats, patches: Patches, *, survey: Survey = survey) -> Sampling:
        """Return the same of the points (N, 3) that a pass has left: walls that noise had hidden may show now."""
        thin_walls = self.thin_walls
        if self.hiding_share > WALL_PATCHES_SHARE and not thin_walls:
            thin_walls = has_walls(np.concatenate(list(survey(xyz, patches, midway_shares))), uncovered=True)
        return replace(self, thin_walls=thin_walls, uncovered=True)

    def spread_rounds(self, xyz: Floats, patches: Patches, noise_std: float, *, survey: Survey = survey) -> int:
        """Return in how many rounds points with noise of some std in the unit ball are spread (`model.spread`).

        xyz: (N, 3), as the first pass has left them.
        """
        if noise_std < _STRONG_NOISE:
            return ROUNDS
        if self.hiding_share < _HARDLY_HIDING_SHARE:
            return _ROUNDS_OF_ONE_SURFACE if noise_std > HIGH_NOISE else ROUNDS
        shares = np.concatenate(list(survey(xyz, patches, midway_shares)))
        walls = self.hiding_share + 2 * showing_share(shares) > _HIDING_AND_SHOWING
        return _ROUNDS_OF_WALLS if walls else ROUNDS


@dataclass(frozen=True)
class _PatchStatistics:
    """What points of some patches have around them, n in all.

    areas: (n, 3), squared distances to the nearest other, the 8th and the 32nd; midway_shares: (M, 2), as of
    `midway_shares`.
    """

    areas: Floats
    noise: NeighbourhoodNoise
    midway_shares: Floats

    @classmethod
    def of(cls, near: Nearest, patches: int) -> _PatchStatistics:
        """Look at the nearest points of some, as many of each patch, patch after patch."""
        last = near.distances.shape[1] - 1
        areas = near.distances[:, [1, min(_FEW_NEIGHBOURS, last), min(_MANY_NEIGHBOURS, last)]] ** 2
        return cls(on_host(areas), NeighbourhoodNoise.of(near, patches), midway_shares(near, patches))


def _in_radii(found: list[NeighbourhoodNoise]) -> float:
    return float(np.median(np.concatenate([noise.in_radii for noise in found])))


def _noise_of_most(found: list[NeighbourhoodNoise], noise_std: float) -> float:
    """Return the noise std that most points have, where a few loud ones are what was read as noise_std; else inf.

    found: of some patches, of which half say. Where noise is as large as the distance between points, none is loud.
    """
    noise_of_most = float(np.median(np.concatenate([noise.stds for noise in found])))
    loud = np.concatenate([noise.loud_shares for noise in found]).mean() > _LOUD_SHARE
    return noise_of_most if loud and noise_std > _LOUD_RATIO * noise_of_most else np.inf


def _is_irregular(areas: Floats, noise_std: float, *, thin_walls: bool) -> bool:
    """Say whether points with noise of some std lie by chance, or in lines; areas: (n, 3), as of `_PatchStatistics`.

    Where noise is as large as the distance between points nothing tells, and they are taken for even.
    """
    nearest, few, many = np.maximum(areas.T, 1e-300)
    if not thin_walls and noise_std >= _TELLING_NOISE * np.sqrt(np.pi / _MANY_NEIGHBOURS * np.median(many)):
        return False
    low, high = np.quantile(np.log(few / many), (0.16, 0.84))
    limit = _IRREGULAR_STD_OF_WALLS if thin_walls else _IRREGULAR_STD
    return bool(high - low > 2 * limit or _MANY_NEIGHBOURS * np.median(nearest / many) < _LINES_AREA_RATIO)
