"""The neighbours that a step is judged by, as the filter looks them up."""

from __future__ import annotations

import numpy as np

from straightpcf.model.low_noise import SCENE_NEIGHBOURS
from straightpcf.model.neighbourhoods import Nearest

__all__ = ["nearest"]


def nearest(step: np.ndarray, patch: np.ndarray) -> Nearest:
    """Look up those of the first points of a patch (P, 3), which make the step (n, 3)."""
    return Nearest.of(patch[: len(step)], patch, SCENE_NEIGHBOURS)
