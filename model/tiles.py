"""Large clouds are cut tile by tile, so that what cutting needs of memory depends on a tile, not on the cloud."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property, partial

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree

from straightpcf.model.device_patches import cut_patches_on
from straightpcf.model.distinct import box_of
from straightpcf.model.patches import PATCH_SIZE, Patches, cut_patches, patches_around

__all__ = ["Tiling", "split"]

# A point's patch reaches at most two radii beyond it: one to the seed, one from there to the rim.
_HALO_RADII = 2.0
_HALO_PERCENTILE = 90  # percentile of a tile's patch radii that its halo is made for
_PROBES = 48  # patches that are looked at to know a cloud


def split(xyz: npt.NDArray[np.float64], tile_points: int) -> list[npt.NDArray[np.int64]]:
    """Part (N, 3) points into tiles of at most `tile_points` rows, halving along the longest side; rows ascend.

    Neighbouring tiles follow one another, and every row is in one of them.
    """
    tiles: list[npt.NDArray[np.int64]] = []
    left = [np.arange(len(xyz))]
    while left:
        rows = left.pop()
        if len(rows) <= tile_points:
            tiles.append(rows if len(rows) == len(xyz) else np.sort(rows))
            continue
        low, high = box_of(xyz[rows])
        axis = int(np.argmax(high - low))
        middle = len(rows) // 2
        order = np.argpartition(xyz[rows, axis], middle)
        left += [rows[order[middle:]], rows[order[:middle]]]
    return tiles


class Tiling:
    """The patches of one pass over points xyz (N, 3), whose rows were parted into `tiles` by `split`.

    One tile is the whole cloud, cut as `cut_patches` does. Of several, each is cut together with its halo, the
    points around it that its patches reach; a point's owner is always a patch of its own tile's cut.
    For a device the cuts are kept: spreading reads them again. workers: threads of the CPU that look up neighbours.
    """

    def __init__(
        self,
        xyz: npt.NDArray[np.float64],
        tiles: list[npt.NDArray[np.int64]],
        *,
        coverage: float,
        seed: int,
        device: str = "cpu",
        workers: int = 1,
    ) -> None:
        self._xyz, self.tiles, self._workers = xyz, tiles, workers
        on_host = device == "cpu"
        cut = partial(cut_patches, workers=workers) if on_host else partial(cut_patches_on, torch.device(device))
        self._cut: Callable[[npt.NDArray[np.float64]], Patches] = partial(cut, coverage=coverage, seed=seed)
        self._margins: list[float] = []
        self._kept: list[Patches] | None = None if on_host else []
        self._dealt: Future[list[npt.NDArray[np.int64]]] | None = None

    @cached_property
    def whole(self) -> Patches | None:
        """The cut of the whole cloud, where it is one tile."""
        if len(self.tiles) > 1:
            return None
        return self._cut(self._xyz)

    def subsamples(self, parts: int) -> list[npt.NDArray[np.int64]]:
        """Part the pass's points into clouds of N / parts rows, ascending, each as evenly spread as the whole.

        Points are dealt out in the order of a k-d tree's leaves, where neighbours follow one another; tile by tile.
        """
        return [np.sort(np.concatenate([rows[part::parts] for rows in self._by_leaves])) for part in range(parts)]

    def expect_parts(self) -> None:
        """Begin what `subsamples` needs, on a thread, where a device cuts: its host has nothing else to do."""
        if self._kept is not None and self._dealt is None:
            pool = ThreadPoolExecutor(1)
            self._dealt = pool.submit(self._dealt_out)
            pool.shutdown(wait=False)

    @cached_property
    def _by_leaves(self) -> list[npt.NDArray[np.int64]]:
        """The tiles' rows in that order: of one tree, however often a pass is parted."""
        return self._dealt_out() if self._dealt is None else self._dealt.result()

    def _dealt_out(self) -> list[npt.NDArray[np.int64]]:
        return [rows[cKDTree(self._xyz[rows]).indices] for rows in self.tiles]

    def probes(self, count: int = _PROBES) -> tuple[Patches, range]:
        """Return about `count` patches spread over the cloud, to look at, and which of the whole cut they are."""
        if self.whole is not None:
            step = max(1, len(self.whole.seeds) // count)
            return self.whole.every(step), range(0, len(self.whole.seeds), step)
        found, self._margins = [], []
        for core in self.tiles:
            share = max(2, round(count * len(core) / len(self._xyz)))
            seeds = core[np.linspace(0, len(core) - 1, share).astype(np.int64)]
            patches = patches_around(cKDTree(self._xyz[core]), self._xyz[seeds], PATCH_SIZE, workers=self._workers)
            self._margins.append(_HALO_RADII * float(np.percentile(patches.radii, _HALO_PERCENTILE)))
            found.append(patches.of_rows(core))
        return Patches.joined(found), range(0)

    def cuts(self) -> Iterator[Patches]:
        """Cut tile after tile; together the patches own every point once."""
        if self.whole is not None:
            yield self.whole
            return
        if self._kept:
            yield from self._kept
            return
        for rows, own in self.surroundings():
            cut = self._cut(self._xyz[rows]).owning_below(own).of_rows(rows)
            if self._kept is not None:
                self._kept.append(cut)
            yield cut

    def surroundings(self) -> Iterator[tuple[npt.NDArray[np.int64], int]]:
        """Yield each tile's rows, those of its halo behind, and how many are its own."""
        if len(self.tiles) == 1:
            yield self.tiles[0], len(self.tiles[0])
            return
        if not self._margins:
            self.probes()
        for core, margin in zip(self.tiles, self._margins, strict=True):
            yield np.concatenate([core, _halo(self._xyz, core, margin)]), len(core)


def _halo(xyz: npt.NDArray[np.float64], core: npt.NDArray[np.int64], margin: float) -> npt.NDArray[np.int64]:
    """Return the rows outside `core` in its box widened by `margin`; the nearest, where they outnumber the core."""
    low, high = box_of(xyz[core])
    near = np.ones(len(xyz), dtype=bool)
    for axis in range(3):
        column = xyz[:, axis]
        near &= (column >= low[axis] - margin) & (column <= high[axis] + margin)
    near[core] = False
    rows = np.flatnonzero(near)
    if len(rows) > len(core):
        outside = np.maximum(low - xyz[rows], xyz[rows] - high).clip(min=0)
        rows = rows[np.argpartition(np.square(outside).sum(axis=1), len(core))[: len(core)]]
    return rows
