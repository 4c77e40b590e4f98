"""Clouds of voxels: a point for every cell of a grid that a surface meets, in the middle of the cell."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.grid import OFF_GRID, cells_of

__all__ = ["are_steps", "edge_of_voxels", "within_voxels"]

Floats = npt.NDArray[np.float64]

_BESIDE = 4  # of a surface's voxels half have as many face to face, whatever its slope
_FEWEST_A_LAYER = 4  # points that share a coordinate, at least, as the mean of an axis
_SOME = 2000  # points whose neighbours are looked up
# Noise read beside a cell: 0.21 to 0.38 of what bends, 0.02 to 0.15 of what is flat along the axes, and exact.
_STEPS_NOISE = 0.2


def edge_of_voxels(xyz: Floats) -> float:
    """Return the edge of a cell of a cloud (N, 3) of voxels, 0 where it is none, or most cells have none beside them.

    Coordinates that are merely rounded leave most cells of a surface empty: noise, which the network knows.
    """
    if any(_FEWEST_A_LAYER * len(np.unique(xyz[:, axis])) > len(xyz) for axis in range(3)):
        return 0.0
    some = xyz[:: max(1, len(xyz) // _SOME)]
    distances, _ = cKDTree(xyz).query(some, k=[2, _BESIDE + 1])
    edge, beside = np.median(distances, axis=0)
    if edge <= 0.0 or beside > (1 + OFF_GRID) * edge:
        return 0.0
    return 0.0 if cells_of(xyz, xyz[0], edge) is None else float(edge)


def are_steps(edge: float, noise_std: float) -> bool:
    """Say of voxels whose cells have an edge, and in which so much noise is read, whether their surface bends."""
    return 0.0 < _STEPS_NOISE * edge < noise_std


def within_voxels(count: int, edge: float, seed: int) -> Floats:
    """Return how far points (count, 3) go from the middle of their cells to anywhere in them.

    To the network layers of cells are surfaces with steps, which it flattens; anywhere in their cells points are a
    surface with noise. The cell says no more of where a point was.
    """
    return np.random.default_rng(seed).uniform(-edge / 2, edge / 2, (count, 3))
