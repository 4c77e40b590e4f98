"""Walls closer together than their points are to each other: what the network takes for one surface with noise.

Two walls have few points midway between them, and a noisy surface has most there. Where the network would join them,
nothing moves (docs/training.md, "Two walls or one").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from straightpcf.model.neighbourhoods import INNER, Nearest, Neighbourhoods

__all__ = ["between_walls", "has_walls", "share_between_walls"]

Floats = npt.NDArray[np.float64]

# Of 24 the plane lies along walls that are up to 1.2 times as far apart as points, of 64 up to twice as far.
_AROUND = (24, 64)
# The share of neighbours nearer to their plane than half of their std: 0.31 and more of one surface with noise,
# 0.29 where that is uniform along one axis, 0.02 to 0.28 of walls. A sharp rim with noise has few, too, in some of a
# cloud's patches, so it has walls where that is so of a fifth of them.
_MIDWAY, _FEW, _MAY_BE_FEW, _SOME = 0.5, 0.27, 0.28, 0.2
_THICK = 0.1  # of the neighbourhood's radius, the std of the heights: what is thinner is one surface with an edge
# Moves across, in that std, up to which all is made of them, and nothing from 1.5 times as many on: as many as noise
# asks for, of which the share midway says how much there is.
_MORE, _PER_MIDWAY, _RAMP = 0.14, 1.3, 0.5
_SAMPLES = 128  # points of a patch that are looked at


@dataclass(frozen=True)
class _Heights:
    """What the neighbours of n points have as heights over their planes.

    thick: (n,) bool, whether the neighbours have more height than an edge; midway: the share of those of thick points
    that are; std: of half of the thick points, or less; normals: (n, 3), the planes'.
    """

    thick: npt.NDArray[np.bool_]
    midway: float
    std: float
    normals: Floats

    @classmethod
    def of(cls, near: Neighbourhoods) -> _Heights:
        """Look at the neighbourhoods of n points."""
        height = near.along_axes()[:, :, 0]
        stds = np.sqrt(np.square(height).mean(axis=1))
        thick = stds > _THICK * near.radii
        if not thick.any():
            return cls(thick, 1.0, 0.0, near.normals)
        midway = float(np.mean(np.abs(height[thick]) < _MIDWAY * stds[thick, None]))
        return cls(thick, midway, float(np.median(stds[thick])), near.normals)

    def are_walls(self, few: float) -> bool:
        return self.midway < few and bool(self.thick.mean() > 0.5)

    def share_left(self, step: Floats) -> float:
        """Say how much is made of (n, 3), the first of the points' step, if it brings walls together."""
        thick = self.thick[: len(step)]
        if not self.are_walls(_FEW) or not thick.any():
            return 1.0
        rise = (step * self.normals[: len(step)]).sum(axis=1)[thick]
        most = (_MORE + _PER_MIDWAY * self.midway) * self.std
        return float(np.clip(1.0 - (np.sqrt(np.square(rise).mean()) / most - 1.0) / _RAMP, 0.0, 1.0))


def between_walls(near: Nearest) -> list[bool]:
    """Say whether points of a patch may be on walls close together, by their 24 and by their 64 nearest."""
    return [_Heights.of(near.first(count)).are_walls(_MAY_BE_FEW) for count in _AROUND]


def has_walls(found: Sequence[Sequence[bool]]) -> bool:
    """Say whether a cloud may have walls close together; found: of its patches, or some, as of `between_walls`."""
    return bool(np.mean(found, axis=0).max() > _SOME)


def share_between_walls(step: Floats, around: Floats) -> float:
    """Return the share of a step (n, 3) that leaves walls apart: 0 where it joins them, 1 where there are none.

    around: (P, 3), a patch, of which the first n >= 1 points make the step.
    """
    looked_at = np.arange(0, max(len(step), round(INNER * len(around))))
    looked_at = looked_at[:: max(1, len(looked_at) // _SAMPLES)]
    some, their_step = around[looked_at], step[looked_at[looked_at < len(step)]]
    near = Nearest.of(some, around, max(_AROUND))
    return min(_Heights.of(near.first(count)).share_left(their_step) for count in _AROUND)
