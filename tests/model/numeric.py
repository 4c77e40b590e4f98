"""Gradients of fields by differences, to compare with what is computed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

__all__ = ["numeric_gradient"]

STEP = 1e-7


def numeric_gradient(
    value: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]], xyz: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return (N, 3) forward differences of value, which takes (N, 3) points at once and gives (N,)."""
    here = value(xyz)
    return np.stack([(value(xyz + STEP * axis) - here) / STEP for axis in np.eye(3)], axis=1)
