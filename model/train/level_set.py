"""Sample the surface where a function is zero: evenly, with exact normals, and with no mesh in between."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import numpy.typing as npt

__all__ = ["LevelSet"]

Floats = npt.NDArray[np.float64]

# Points are drawn this near to the surface and brought onto it: evenly but for the Gaussian curvature times its square.
_SHELL = 0.015
_CELL = 0.08  # of the grid that tells where to draw, before it is halved
_HALVINGS = 2
_STEPS = 6  # of Newton's method
_DRAWN, _DRAWS = 400_000, 50  # points at once, and no more than so many for each that is wanted


class LevelSet(ABC):
    """A body that is where a function is below zero."""

    @abstractmethod
    def value(self, xyz: Floats) -> tuple[Floats, Floats]:
        """Return the function at points (N, 3), about their distance from the surface, (N,), and its gradient."""

    @abstractmethod
    def box(self) -> tuple[Floats, Floats]:
        """Return the corners, (3,) each, of a box around the surface."""

    @abstractmethod
    def slope(self) -> float:
        """Return the steepest that the function is anywhere, or more."""

    def contains(self, xyz: Floats) -> npt.NDArray[np.bool_]:
        """Say which points (N, 3) are inside: (N,)."""
        return np.asarray(self.value(xyz)[0] < 0)

    def sample(self, rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
        """Sample `count` points of the surface evenly, and their unit normals."""
        cells, size = self._cells()
        found: list[Floats] = []
        draws = min(_DRAWN, _DRAWS * count)
        while sum(map(len, found)) < count:
            drawn = cells[rng.integers(len(cells), size=draws)] + rng.uniform(-size / 2, size / 2, (draws, 3))
            value, gradient = self.value(drawn)
            found.append(self._onto(drawn[np.abs(value) < _SHELL * np.linalg.norm(gradient, axis=1)]))
        xyz = np.concatenate(found)[:count]
        gradient = self.value(xyz)[1]
        return xyz, gradient / np.linalg.norm(gradient, axis=1, keepdims=True)

    def _cells(self) -> tuple[Floats, float]:
        """Return the centres (M, 3) of grid cells that the surface, as thick as it is drawn, may cross; their side."""
        low, high = self.box()
        low, high = low - 2 * _CELL, high + 2 * _CELL
        grid = np.meshgrid(*(np.arange(low[axis], high[axis], _CELL) for axis in range(3)), indexing="ij")
        cells, size = self._crossed(np.stack(grid, axis=-1).reshape(-1, 3), _CELL), _CELL
        for _ in range(_HALVINGS):
            size /= 2
            corners = size / 2 * np.stack(np.meshgrid(*3 * [[-1, 1]]), axis=-1).reshape(-1, 3)
            cells = self._crossed((cells[:, None] + corners).reshape(-1, 3), size)
        return cells, size

    def _crossed(self, centres: Floats, size: float) -> Floats:
        slope = self.slope()  # no cell is missed
        parts = np.array_split(centres, 1 + len(centres) // _DRAWN)
        value = np.concatenate([self.value(part)[0] for part in parts])
        crossed: Floats = centres[np.abs(value) < slope * (np.sqrt(3) / 2 * size + _SHELL)]
        return crossed

    def _onto(self, xyz: Floats) -> Floats:
        """Bring points (N, 3) onto the surface; those that Newton's method takes elsewhere are left out."""
        start = xyz
        for _ in range(_STEPS):
            value, gradient = self.value(xyz)
            xyz = xyz - (value / np.square(gradient).sum(axis=1))[:, None] * gradient
        there = np.abs(self.value(xyz)[0]) < 1e-9
        return np.asarray(xyz[there & (np.linalg.norm(xyz - start, axis=1) < 3 * _SHELL)])
