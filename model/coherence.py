"""Whether a pass would take noise or shape: noise differs from point to point, shape does not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.neighbourhoods import neighbourhoods

__all__ = ["summed_coherence"]

Floats = npt.NDArray[np.float64]

_NEIGHBOURS = 16  # whose plane a point moves across, and whose moves its own is compared with, itself among them


def summed_coherence(step: Floats, points: Floats, patch: Floats) -> tuple[float, float]:
    """Return two sums over n points that make a step (n, 3); the first by the second is how coherent it is.

    points: (n, 3); patch: (P, 3), these and others around. Of moves along the normals, the products of each point's
    with the mean of its neighbours', and its squares: 0 in all where neighbours move independently, 1 where alike.
    """
    count = min(_NEIGHBOURS, len(points))
    if count < 2:
        return 0.0, 0.0
    normals = neighbourhoods(points, patch, _NEIGHBOURS).normals
    _, beside = cKDTree(points).query(points, k=count)
    moves = (step[beside] * normals[:, None]).sum(axis=2)  # (n, k), all along the normal of the first
    own, others = moves[:, 0], moves[:, 1:].mean(axis=1)
    return float((own * others).sum()), float(np.square(own).sum())
