"""The places of a cloud, and which of its points lie at each."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

__all__ = ["Distinct", "box_of", "cell_of", "half_reach"]

Floats = npt.NDArray[np.float64]

_Rounding = Callable[..., Floats]  # of cells to whole numbers, `out` like a ufunc's

# How large a cell is beside a cloud, as a power of two: 2^-20 is about 1e-6. No scanner resolves that; a copy that went
# through float32 is off by 3e-8 at most, so that a border parts few pairs; and of a million points drawn at random on a
# sphere one pair in ten clouds is so near. Copies that are not one place leave no point any neighbour but themselves,
# and what is seen in their patches is no noise.
_CELL_EXPONENT = -20
_SOME = 10_000  # positions that tell how large a cloud is
# Where three positions in ten have another within the first ratio of what their 8th is away, there are copies, such as
# one scan by two exports or registrations, and what is within the second is one. Of points drawn at random on a surface
# 0.4 % are within the first and 1.7 % within the second, on a line 16 and 30 %; of six real scans 0.1 %.
_COPY_NEIGHBOURS, _COPY_RATIO, _JOINED_RATIO, _COPIED_SHARE = 8, 0.025, 0.05, 0.3
# A tree of all positions takes longer than all else that is done before a GPU has them: so many of the positions
# nearest to some, of so many nearest to those, tell whether there are copies.
_LOOKED_AT_PLACES, _LOOKED_AT, _AROUND_THEM = 8, 64, 256
_BLOCK = 2**16  # positions whose neighbours are held at once
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # odd, the golden ratio's bits


class Distinct:
    """The places of a cloud; points in one place (a depth camera's zeros, two copies of a scan) move together.

    xyz: (U, 3) float64, the position of one point of each; inverse: (N,) the place of each point. Where no two points
    share one, both keep the order. cell: points that lie in one cell of that edge, in the cloud's unit, are in one
    place, and so are copies (`_copies`); 0 leaves equal points. There are two grids, half a cell apart, and where these
    find any a third between them; pairs that a border of each parts stay two.
    """

    def __init__(self, xyz: Floats, *, cell: float = 0.0) -> None:
        self.xyz, self.inverse, self.repeated = xyz, np.arange(len(xyz)), False
        # One grid after the other, of what the first has left: links through both could chain a whole dense part.
        for rounding in (np.floor, np.rint) if cell else (None,):
            self._join(_grouped(self.xyz, cell, rounding))
        if cell and self.repeated:
            self._join(_grouped(self.xyz, cell, _floor_between))
        if cell:
            self._join(_copies((self.xyz / 2 - self.xyz[0] / 2) / cell))  # halves: else both might overflow
        if not self.repeated:
            return
        by_position = np.lexsort(self.xyz.T[::-1])
        place = np.empty_like(by_position)
        place[by_position] = np.arange(len(place))
        self.xyz, self.inverse = self.xyz[by_position], place[self.inverse]
        self._order = np.argsort(self.inverse, kind="stable")
        self._starts = np.searchsorted(self.inverse[self._order], np.arange(len(place) + 1))

    def _join(self, grouped: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None) -> None:
        """Make one place of each group of places: the first row of each, and each place's group; None joins none."""
        if grouped is not None:
            first, group = grouped
            self.xyz, self.inverse, self.repeated = self.xyz[first], group[self.inverse], True

    def copies(self, distinct: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
        """Return the points that lie at some distinct rows."""
        if not self.repeated:
            return distinct.astype(np.int64)
        groups = [self._order[self._starts[d] : self._starts[d + 1]] for d in distinct]
        return np.concatenate(groups) if groups else distinct.astype(np.int64)


def cell_of(xyz: Floats) -> float:
    """Return the edge of the cells of a finite cloud (N, 3) in which points are one place; 0 where all coincide.

    About 1e-6 of its size, which is half of its positions': far points shall not make one place of all others. A power
    of two: dividing by it rounds nothing.
    """
    _, reach = half_reach(xyz)
    return math.ldexp(1.0, math.frexp(reach)[1] + 1 + _CELL_EXPONENT) if reach > 0 else 0.0


def box_of(xyz: Floats) -> tuple[Floats, Floats]:
    """Return the lowest and the highest x, y and z of a cloud (N, 3): a column at a time, numpy is 20 times as fast."""
    lowest, highest = zip(*((column.min(), column.max()) for column in xyz.T), strict=True)
    return np.array(lowest), np.array(highest)


def half_reach(xyz: Floats) -> tuple[Floats, float]:
    """Return the middle (3,) of a cloud (N, 3) and how far half of its positions reach from it, both halved.

    Of some of its positions, each taken once: where many rows say "no data", all say the same. Whole, they might
    overflow.
    """
    some = Distinct(xyz[:: max(1, len(xyz) // _SOME)]).xyz / 2
    middle = np.median(some, axis=0)
    return middle, float(np.median(np.abs(some - middle).max(axis=1)))


def _grouped(
    xyz: Floats, cell: float, rounding: _Rounding | None
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
    """Return the first row of each group of rows in one cell, and each row's group; None where no two are in one.

    Told by hashes: these are sorted in a third of the memory of rows, and in a tenth of the time.
    """
    hashed = _hashed(xyz, cell, rounding)
    hashed.sort()
    if not (hashed[1:] == hashed[:-1]).any():
        return None
    _, first, group = np.unique(_hashed(xyz, cell, rounding), return_index=True, return_inverse=True)
    for axis in range(3):
        of_rows = _column(xyz, axis, cell, rounding)
        if not np.array_equal(of_rows, of_rows[first][group]):  # two cells have one hash
            cells = np.stack([_column(xyz, each, cell, rounding) for each in range(3)], axis=1)
            _, first, group = np.unique(cells, axis=0, return_index=True, return_inverse=True)
            break
    return None if len(first) == len(xyz) else (first, group.reshape(-1))


def _copies(xyz: Floats) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
    """Do what `_grouped` does for copies farther apart than a cell; None where few positions have any.

    xyz: (U, 3) positions, from one of them, in a unit in which their squares do not overflow. How far is told by each
    one's own neighbours: by one distance for all, dense parts would be one place.
    """
    count = len(xyz)
    if count <= _COPY_NEIGHBOURS or not _are_copied(xyz):
        return None
    tree, links = cKDTree(xyz), []
    for start in range(0, count, _BLOCK):
        near, index = tree.query(xyz[start : start + _BLOCK], k=_COPY_NEIGHBOURS + 1)
        row, column = np.nonzero(near[:, :-1] < _JOINED_RATIO * near[:, -1:])
        links.append((row + start, index[row, column]))
    rows, others = map(np.concatenate, zip(*links, strict=True))
    graph = coo_array((np.ones(len(rows), dtype=bool), (rows, others)), shape=(count, count))
    _, first, group = np.unique(connected_components(graph)[1], return_index=True, return_inverse=True)
    return first, group


def _are_copied(xyz: Floats) -> bool:
    shares = []
    for centre in xyz[:: math.ceil(len(xyz) / _LOOKED_AT_PLACES)]:
        apart = sum(np.square(xyz[:, axis] - centre[axis]) for axis in range(3))
        around = np.argpartition(apart, _AROUND_THEM)[:_AROUND_THEM] if len(xyz) > _AROUND_THEM else np.arange(len(xyz))
        around = around[np.argsort(apart[around])]
        near, _ = cKDTree(xyz[around]).query(xyz[around[:_LOOKED_AT]], k=[2, _COPY_NEIGHBOURS + 1])
        shares.append((near[:, 0] < _COPY_RATIO * near[:, 1]).mean())
    return bool(np.mean(shares) >= _COPIED_SHARE)


def _floor_between(cells: Floats, *, out: Floats) -> Floats:
    """Round to the grid of which no border is within a quarter of a cell of one of the other two."""
    cells += 0.25
    return np.floor(cells, out=out)


def _hashed(xyz: Floats, cell: float, rounding: _Rounding | None) -> npt.NDArray[np.uint64]:
    hashed = np.zeros(len(xyz), dtype=np.uint64)
    for axis in range(3):
        bits = _column(xyz, axis, cell, rounding).view(np.uint64)
        bits ^= bits >> np.uint64(32)  # small whole numbers have theirs up there, and no product moves bits down
        hashed *= _GOLDEN
        hashed ^= bits
    return hashed


def _column(xyz: Floats, axis: int, cell: float, rounding: _Rounding | None) -> Floats:
    """Return a coordinate of each row's cell, or of the row itself; a new array."""
    if rounding is None:
        return xyz[:, axis] + 0.0  # -0.0 + 0.0 is 0.0
    with np.errstate(over="ignore"):  # where rows do not differ, but for less than their last bit
        column: Floats = xyz[:, axis] / cell
    rounding(column, out=column)
    column += 0.0
    return column
