"""The distinct positions of a cloud, and which of its points lie at each."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["Distinct"]


class Distinct:
    """The distinct positions of a cloud; points in one place (a depth camera's zeros) move together.

    xyz: (U, 3) float64; inverse: (N,) the distinct row of each point. Without duplicates both keep the order.
    """

    def __init__(self, xyz: npt.NDArray[np.float64]) -> None:
        self.xyz, self.inverse, self.repeated = xyz, np.arange(len(xyz)), False
        if not _may_repeat(xyz):
            return
        unique, inverse = np.unique(xyz, axis=0, return_inverse=True)
        if len(unique) == len(xyz):
            return
        self.xyz, self.inverse, self.repeated = unique, inverse.reshape(-1), True
        self._order = np.argsort(self.inverse, kind="stable")
        self._starts = np.searchsorted(self.inverse[self._order], np.arange(len(unique) + 1))

    def copies(self, distinct: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
        """Return the points that lie at some distinct rows."""
        if not self.repeated:
            return distinct.astype(np.int64)
        groups = [self._order[self._starts[d] : self._starts[d + 1]] for d in distinct]
        return np.concatenate(groups) if groups else distinct.astype(np.int64)


def _may_repeat(xyz: npt.NDArray[np.float64]) -> bool:
    """Say whether any two rows may be equal: by hashes, which are sorted in a third of the memory of rows."""
    hashed = np.zeros(len(xyz), dtype=np.uint64)
    for axis in range(3):
        hashed *= np.uint64(0x9E3779B97F4A7C15)  # odd, the golden ratio's bits
        hashed ^= (xyz[:, axis] + 0.0).view(np.uint64)  # -0.0 + 0.0 is 0.0
    hashed.sort()
    return bool((hashed[1:] == hashed[:-1]).any())
