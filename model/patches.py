"""Cut a cloud into overlapping kNN patches and give every point one owner among them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

__all__ = ["PATCH_SIZE", "Patches", "cut_patches", "patches_around"]

PATCH_SIZE = 1000
_TREE_HEIGHT = 7  # of the sampler's buckets; their number may not pass the number of points


@dataclass(frozen=True)
class Patches:
    """M patches of P points of one cloud.

    seeds: (M,) int64 rows; index: (M, P) int32 rows, the points that the patch owns first, then the others, each
    part nearest to the seed first; owned: (M,) int64, how many it owns: on these the patch has the last word;
    radii: (M,) float64 distance to the farthest.
    """

    seeds: npt.NDArray[np.int64]
    index: npt.NDArray[np.int32]
    owned: npt.NDArray[np.int64]
    radii: npt.NDArray[np.float64]

    def owned_points(self, patch: int) -> npt.NDArray[np.int32]:
        """Return the rows of the cloud that a patch owns."""
        return self.index[patch, : self.owned[patch]]

    def every(self, step: int) -> Patches:
        """Return each step-th patch."""
        return self[slice(None, None, step)]

    def __getitem__(self, some: slice | npt.NDArray[np.bool_ | np.int64]) -> Patches:
        """Return some of the patches, in their order, or in that of the numbers given."""
        return Patches(self.seeds[some], self.index[some], self.owned[some], self.radii[some])

    def of_rows(self, rows: npt.NDArray[np.int64]) -> Patches:
        """Return the same patches for a cloud of which this one is xyz[rows]."""
        return Patches(rows[self.seeds], rows[self.index].astype(np.int32), self.owned, self.radii)

    def owning_below(self, count: int) -> Patches:
        """Return the patches that own any of the first `count` rows, owning nothing else."""
        owns = (np.arange(self.index.shape[1]) < self.owned[:, None]) & (self.index < count)
        some = owns.any(axis=1)
        return Patches(self.seeds[some], _first(self.index[some], owns[some]), owns[some].sum(axis=1), self.radii[some])

    @classmethod
    def joined(cls, parts: list[Patches]) -> Patches:
        """Return the patches of several cuts of one cloud, all of one size."""
        fields = zip(*((part.seeds, part.index, part.owned, part.radii) for part in parts), strict=True)
        return cls(*(np.concatenate(field) for field in fields))


def cut_patches(
    xyz: npt.NDArray[np.float64], *, coverage: float, seed: int, patch_size: int = PATCH_SIZE, workers: int = 1
) -> Patches:
    """Cut (N, 3) float64 points into patches that cover every one of them.

    coverage: how many patches a point is in on average, at the start; farthest-point seeds are added in what
    is left uncovered until nothing is. A point's owner is the patch to whose seed it is nearest in units of
    that patch's radius (the first of equals). `seed` picks the first seed. workers: threads that look up
    neighbours. Memory is O(coverage N).
    """
    count = len(xyz)
    size = min(patch_size, count)
    first = seed % count
    tree = cKDTree(xyz)
    wanted = 1 if count <= patch_size else max(1, int(np.ceil(coverage * count / size)))
    seeds = _farthest(xyz, wanted, first)
    distance, index = _nearest(tree, xyz[seeds], size, workers)
    covered = np.zeros(count, dtype=bool)
    covered[index] = True
    while not covered.all():
        left = np.flatnonzero(~covered)
        more = left[_farthest(xyz[left], max(1, int(np.ceil(2 * len(left) / size))), 0)]
        more_distance, more_index = _nearest(tree, xyz[more], size, workers)
        # Among equal points the tree may leave out the seed itself; it must be in its own patch.
        absent = ~(more_index == more[:, None]).any(axis=1)
        more_index[absent, -1] = more[absent]
        covered[more_index] = True
        seeds = np.concatenate([seeds, more])
        distance, index = np.concatenate([distance, more_distance]), np.concatenate([index, more_index])
    owner = _owners(distance, index, count)
    owns = owner[index] == np.arange(len(seeds), dtype=np.int32)[:, None]
    return Patches(seeds, _first(index, owns), owns.sum(axis=1), distance[:, -1].astype(np.float64))


def patches_around(tree: cKDTree, seeds: npt.NDArray[np.float64], patch_size: int, *, workers: int = 1) -> Patches:
    """Return the `patch_size` nearest points of a tree to each of (M, 3) seeds, as patches that own nothing."""
    distance, index = _nearest(tree, seeds, patch_size, workers)
    radii = distance[:, -1].astype(np.float64)
    return Patches(index[:, 0].astype(np.int64), index, np.zeros(len(seeds), dtype=np.int64), radii)


def _first(index: npt.NDArray[np.int32], chosen: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Return each row of index (M, P) with the chosen entries before the others, both in their order."""
    return np.take_along_axis(index, np.argsort(~chosen, axis=1, kind="stable"), axis=1)


def _farthest(xyz: npt.NDArray[np.float64], wanted: int, first: int) -> npt.NDArray[np.int64]:
    if wanted >= len(xyz):
        return np.arange(len(xyz), dtype=np.int64)
    if wanted == 1:
        return np.array([first], dtype=np.int64)
    import fpsample  # a device samples by itself

    height = min(_TREE_HEIGHT, len(xyz).bit_length() - 1)
    seeds = fpsample.bucket_fps_kdline_sampling(xyz.astype(np.float32), wanted, height, first)
    return np.asarray(seeds, dtype=np.int64)


def _nearest(
    tree: cKDTree, queries: npt.NDArray[np.float64], size: int, workers: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    distance, index = tree.query(queries, k=np.arange(1, size + 1), workers=workers)
    return distance.astype(np.float32), index.astype(np.int32)


def _owners(distance: npt.NDArray[np.float32], index: npt.NDArray[np.int32], count: int) -> npt.NDArray[np.int32]:
    radius = distance[:, -1:]
    relative = distance / np.where(radius > 0, radius, 1)
    best = np.full(count, np.inf, dtype=np.float32)
    owner = np.zeros(count, dtype=np.int32)
    for patch, (rows, ratios) in enumerate(zip(index, relative, strict=True)):
        nearer = ratios < best[rows]
        best[rows[nearer]] = ratios[nearer]
        owner[rows[nearer]] = patch
    return owner
