"""Whether a pass takes noise or shape: noise differs from point to point, shape does not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.neighbourhoods import Nearest, Neighbourhoods, neighbourhoods

__all__ = ["share_of_noise", "summed_coherence"]

Floats = npt.NDArray[np.float64]

_NEIGHBOURS = 16  # whose plane a point moves across, and whose moves its own is compared with, itself among them
# A later pass of a scene makes the whole step of a point up to the first, nothing of it from the second on: how
# coherent it is among these; how thick so many nearest are, beside their width; how wide more of them are, beside their
# length (from the first on, and up to the second).
_NOISE, _SHAPE = 0.2, 0.5
_PLANE_NEIGHBOURS, _PLANE_RATIO, _VOLUME_RATIO = 24, 0.4, 0.7
_ROD_NEIGHBOURS, _WIDE_RATIO, _ROD_RATIO = 48, 0.6, 0.3


def summed_coherence(step: Floats, moved: Floats, points: Floats, patch: Floats) -> tuple[float, float, float]:
    """Return three sums over n points that make a step (n, 3): the first by the second is how coherent it is.

    moved: (n, 3), how far they are from where they came; points: (n, 3); patch: (P, 3), these and others around. Of
    moves along the normals, the products of each point's with the mean of its neighbours', its squares, and those of
    what it has moved: the first is 0 where neighbours move independently, and the second where they all move alike.
    """
    if len(points) < 2:
        return 0.0, 0.0, 0.0
    near = neighbourhoods(points, patch, _NEIGHBOURS)
    moves = _moves(step, points, near)
    own, others = moves[:, 0], moves[:, 1:].mean(axis=1)
    before = (moved * near.normals).sum(axis=1)
    return float((own * others).sum()), float(np.square(own).sum()), float(np.square(before).sum())


def share_of_noise(step: Floats, points: Floats, patch: Floats) -> Floats:
    """Return what share of its step (n, 3) each of n points of a scene is to make once a pass has taken the noise.

    points: (n, 3); patch: (P, 3), these and others around. What is left on surfaces is noise, and the network takes it;
    rods, wires and leaves it draws to their middle, pass after pass, and bends flat, all points alike.
    """
    if len(points) < 2:
        return np.ones(len(points))
    nearest = Nearest.of(points, patch, _ROD_NEIGHBOURS)
    moves = _moves(step, points, nearest.first(_NEIGHBOURS))
    count, squares = moves.shape[1], np.square(moves).mean(axis=1)
    # 1 where neighbours move independently, as many as they are where alike.
    alike = count * np.square(moves.mean(axis=1)) / np.maximum(squares, 1e-300)
    least, less, _ = _stds(nearest.first(_PLANE_NEIGHBOURS))
    _, wide, long = _stds(nearest.first(_ROD_NEIGHBOURS))
    share: Floats = np.clip((_SHAPE - (alike - 1) / (count - 1)) / (_SHAPE - _NOISE), 0, 1)
    share *= np.clip((_VOLUME_RATIO - least / less) / (_VOLUME_RATIO - _PLANE_RATIO), 0, 1)
    share *= np.clip((wide / long - _ROD_RATIO) / (_WIDE_RATIO - _ROD_RATIO), 0, 1)
    return share


def _moves(step: Floats, points: Floats, near: Neighbourhoods) -> Floats:
    """Return how far each of n points' nearest of them, itself first, move along its normal: (n, k)."""
    _, beside = cKDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    moves: Floats = (step[beside] * near.normals[:, None]).sum(axis=2)
    return moves


def _stds(near: Neighbourhoods) -> Floats:
    """Return what is as the stds of n neighbourhoods along their axes, rising: (3, n), all above 0."""
    stds: Floats = np.sqrt(np.maximum(near.variances, 1e-300)).T
    return stds
