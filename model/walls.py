"""Walls closer together than their points are to each other: what the network takes for one surface with noise.

Two walls have few points midway between them, and a noisy surface has most there. Where the network would join them,
nothing moves (docs/filter.md, "Two walls or one").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from straightpcf.model.arrays import Array, namespace, on_host
from straightpcf.model.neighbourhoods import INNER_SHARE, Nearest, Neighbourhoods, surface_terms

__all__ = [
    "WALL_PATCHES_SHARE",
    "LocalFit",
    "has_walls",
    "hiding_share",
    "midway_shares",
    "share_between_walls",
    "showing_share",
]

Floats = npt.NDArray[np.float64]

# Of 24 the plane lies along walls that are up to 1.2 times as far apart as points, of 64 up to twice as far. So many
# reach where walls bend, and have a quadric instead; of 100 it lies along walls where of 64 it may lie between them.
_NEIGHBOUR_COUNTS = (24, 64, 100)
_QUADRIC_FROM = 64
# The share of neighbours nearer to their plane than half of their std: 0.31 and more of one surface with noise,
# 0.29 where that is uniform along one axis, 0.02 to 0.28 of walls. A sharp rim with noise has few, too, in some of a
# cloud's patches, so it has walls where that is so of a fifth of them.
_MIDWAY_STDS = 0.5
_WALLS_MIDWAY_SHARE, _MAYBE_WALLS_MIDWAY_SHARE = 0.27, 0.28
WALL_PATCHES_SHARE = 0.2
# Where a pass has taken the noise of one surface, what still has height has walls: more neighbours may lie midway. Of
# noise without tails, as uniform noise is, it leaves layers: 0.29 to 0.31 are midway in all but a fifth of the patches,
# of walls that noise hid 0.13 to 0.28. So the first says whether a cloud has walls, the second where.
_UNCOVERED_WALLS_MIDWAY_SHARE, _UNCOVERED_MIDWAY_SHARE = 0.285, 0.33
# A pass may leave one surface, a flat sheet, in two layers, which look so, too. Before it of the nearest 64 of a sheet
# 0.37 were midway in all but a fifth of the patches, of walls that noise hides 0.30 to 0.354.
_HIDDEN_MIDWAY_SHARE = 0.36
_THICK_RATIO = 0.1  # of the neighbourhood's radius, the std of the heights: what is thinner is one surface with an edge
# Moves across, in stds of the points about the wall that each is on: up to the first all is made of them, from the
# second on nothing. What the network tells apart it moves by 0.4 to 1.0 of that, what it joins or blurs by 1.2 to 1.8.
_FULL_STEP_STDS, _NO_STEP_STDS = 1.1, 1.3
# Of points that lie by chance the nearest 24 tell, in a patch where fewer than that share are midway: what the network
# tells apart it moves by 0.25 to 0.65, what it joins by 0.7 to 1.5.
_MIDWAY_SHARE_BY_CHANCE, _FULL_STEP_STDS_BY_CHANCE, _NO_STEP_STDS_BY_CHANCE = 0.3, 0.65, 0.75
_SAMPLES = 128  # points of a patch that are looked at


@dataclass(frozen=True)
class _Heights:
    """What the neighbours of n points have as heights over their planes, or quadrics.

    thick: (n,) bool, whether the neighbours have more height than an edge; midway: (n,), how many of them are;
    heights: (n, k); fit: those planes or quadrics; normals: (n, 3), the planes'.
    """

    thick: Array
    midway: Array
    heights: Array
    fit: LocalFit
    normals: Array

    @classmethod
    def of(cls, near: Neighbourhoods) -> _Heights:
        """Look at the neighbourhoods of n points."""
        along = near.along_axes()
        fit = LocalFit.of(along, near.radii)
        heights = fit.residuals(along[:, :, 0])
        xp = namespace(heights)
        stds = xp.sqrt(xp.square(heights).mean(1))
        midway = xp.count_nonzero(abs(heights) < _MIDWAY_STDS * stds[:, None], 1)
        return cls(stds > _THICK_RATIO * near.radii, midway, heights, fit, near.normals)

    def midway_shares(self, patches: int = 1) -> Floats:
        """Return the share of neighbours that are midway, (patches,), of as many points of each, patch after patch.

        1 where most points have no more height than an edge.
        """
        thick, midway = self.thick.reshape(patches, -1), self.midway.reshape(patches, -1)
        count = thick.sum(1)
        share = (thick * midway).sum(1) / (count * self.heights.shape[1]).clip(min=1)
        return np.where(on_host(count / thick.shape[1] > 0.5), on_host(share), 1.0)

    def share_left(self, step: Floats, few: float, full: float = _FULL_STEP_STDS, none: float = _NO_STEP_STDS) -> float:
        """Say how much is made of (n, 3), the first of the points' step, if it brings walls together.

        full, none: moves across, in stds of the noise, up to which all is made of it, and from which on nothing.
        """
        thick = self.thick[: len(step)]
        if self.midway_shares().item() >= few or not thick.any():
            return 1.0
        rise = (step * self.normals[: len(step)]).sum(axis=1)[thick]
        noise = float(np.median(self.fit.noise_about_walls(self.heights)[self.thick]))
        beside_noise = np.sqrt(np.square(rise).mean()) / max(noise, 1e-300)
        return float(np.clip((none - beside_noise) / (none - full), 0.0, 1.0))


@dataclass(frozen=True)
class LocalFit:
    """Planes or quadrics over the neighbourhoods of n points, for least squares.

    terms: (n, k, m), those of each neighbour; inverse: (n, m, m), of the normal equations.
    """

    terms: Array
    inverse: Array

    @classmethod
    def of(cls, along: Array, radii: Array) -> LocalFit:
        """Take quadrics where there are as many neighbours as _QUADRIC_FROM; along: (n, k, 3), as `along_axes` says."""
        terms = surface_terms(along / radii[:, None, None], bent=along.shape[1] >= _QUADRIC_FROM)
        equations = terms.mT @ terms
        for term in range(terms.shape[2]):
            equations[:, term, term] += 1e-9  # points in a line leave some of them open
        return cls(terms, namespace(terms).linalg.inv(equations))

    def residuals(self, values: Array) -> Array:
        """Return what the fits leave of values (n, k)."""
        fits = self.inverse @ (self.terms.mT @ values[:, :, None])
        return values - (self.terms @ fits)[:, :, 0]

    def noise_about_walls(self, height: Floats) -> Floats:
        """Return the std (n,) of heights (n, k) about two walls of the same shape, each point on its own side."""
        side = self.residuals(np.where(height > 0, 1.0, -1.0))
        apart = (side * height).sum(axis=1) / np.maximum(np.square(side).sum(axis=1), 1e-300)
        _, count, terms = self.terms.shape
        left: Floats = np.square(height - apart[:, None] * side).sum(axis=1) / max(1, count - terms - 1)
        return np.sqrt(left)


def midway_shares(near: Nearest, patches: int) -> Floats:
    """Return how many neighbours of M patches' points lie half way, by the nearest 24 and 64: (M, 2), 0..1.

    near: of as many points of each patch, patch after patch.
    """
    found = [_Heights.of(near.first(count)).midway_shares(patches) for count in _NEIGHBOUR_COUNTS[:2]]
    return np.stack(found, axis=1)


def has_walls(shares: Floats, *, uncovered: bool = False) -> bool:
    """Say whether a cloud may have walls close together; shares: of its patches, or some, (M, 2), `midway_shares`.

    uncovered: whether a pass has taken the noise of what is one surface.
    """
    few = _UNCOVERED_WALLS_MIDWAY_SHARE if uncovered else _MAYBE_WALLS_MIDWAY_SHARE
    return bool((shares < few).mean(axis=0).max() > WALL_PATCHES_SHARE)


def hiding_share(shares: Floats) -> float:
    """Return the share of a cloud's patches whose noise may hide such walls, 0..1; shares: as of `has_walls`."""
    return float((shares[:, 1] < _HIDDEN_MIDWAY_SHARE).mean())


def showing_share(shares: Floats) -> float:
    """Return the share of a cloud's patches in which a pass has uncovered such walls; shares: as of `has_walls`."""
    return float((shares[:, 1] < _UNCOVERED_MIDWAY_SHARE).mean())


def share_between_walls(step: Floats, patch: Floats, *, uncovered: bool = False, by_chance: bool = False) -> float:
    """Return the share of a step (n, 3) that leaves walls apart: 0 where it joins them, 1 where there are none.

    patch: (P, 3) points, of which the first n >= 1 make the step; uncovered: as of `has_walls`; by_chance: whether
    that is how the points lie on the walls, not evenly.
    """
    few = _UNCOVERED_MIDWAY_SHARE if uncovered else _WALLS_MIDWAY_SHARE
    looked_at = np.arange(0, max(len(step), round(INNER_SHARE * len(patch))))
    looked_at = looked_at[:: max(1, len(looked_at) // _SAMPLES)]
    some, their_step = patch[looked_at], step[looked_at[looked_at < len(step)]]
    near = Nearest.of(some, patch, max(_NEIGHBOUR_COUNTS))
    heights = [_Heights.of(near.first(count)) for count in _NEIGHBOUR_COUNTS]
    shares = [h.share_left(their_step, few) for h in heights]
    if by_chance:
        limits = _MIDWAY_SHARE_BY_CHANCE, _FULL_STEP_STDS_BY_CHANCE, _NO_STEP_STDS_BY_CHANCE
        shares.append(heights[0].share_left(their_step, *limits))
    return min(shares)
