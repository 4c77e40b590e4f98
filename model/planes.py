"""How thick a surface is: what its points' planes say."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from straightpcf.model.arrays import on_host
from straightpcf.model.low_noise import EXACT_PLANE_RATIO
from straightpcf.model.neighbourhoods import Nearest

__all__ = ["across_planes", "thickness_of", "thickness_ratios"]

Floats = npt.NDArray[np.float64]

# So many nearest are in a plane where the std across it is below a share of the lesser one along it, and that above one
# of the greater: in no line.
_SEEN_NEIGHBOURS, _SEEN_PLANE_RATIO, _SEEN_LINE_RATIO = 24, 0.3, 0.2
_PLANE_FREEDOM = 3  # that a plane takes of its points
_THICKNESS_NEIGHBOURS = 12


def across_planes(nearest: Nearest, _patches: int) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return the std of each point's neighbours across their plane, and whether that tells noise: (n,) each."""
    near = nearest.first(_SEEN_NEIGHBOURS)
    least, less, most = np.sqrt(np.maximum(on_host(near.variances), 0.0) / (near.local.shape[1] - _PLANE_FREEDOM)).T
    is_plane = (least > EXACT_PLANE_RATIO * less) & (least < _SEEN_PLANE_RATIO * less)
    return least, is_plane & (less > _SEEN_LINE_RATIO * most)


def thickness_ratios(nearest: Nearest, _patches: int) -> Floats:
    """Return the std of each point's nearest across their plane by the lesser one along it: (n,)."""
    across, along, _ = np.sqrt(np.maximum(on_host(nearest.first(_THICKNESS_NEIGHBOURS).variances), 0.0)).T
    ratios: Floats = np.divide(across, along, out=np.zeros_like(across), where=along > 0)
    return ratios


def thickness_of(points: Floats) -> tuple[float, float]:
    """Return the std of points (n, 3) across the plane that fits them best, and the lesser one along it."""
    local = points - points.mean(axis=0)
    across, along, _ = np.sqrt(np.maximum(np.linalg.eigvalsh(local.T @ local), 0.0) / len(points))
    return float(across), float(along)
