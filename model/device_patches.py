"""`cut_patches` in batched torch operations: a GPU cuts a cloud while a CPU would still build its tree.

Tested on the CPU against `cut_patches`.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch

from straightpcf.model.device import current, enough_memory
from straightpcf.model.ops import squared_distances
from straightpcf.model.patches import PATCH_SIZE, Patches

__all__ = ["cut_patches_on", "farthest_torch"]

_DISTANCES = 2**26  # held at once: 256 MiB, and as much again while they are computed


def cut_patches_on(
    device: torch.device, xyz: npt.NDArray[np.float64], *, coverage: float, seed: int, patch_size: int = PATCH_SIZE
) -> Patches:
    """Do what `cut_patches` does, in float32: points (N, 3) in the unit ball, N below 2**31.

    Raises TooLarge where the device has no memory for them.
    """
    with current(device), enough_memory(device, len(xyz)):
        return _cut(device, xyz, coverage, seed, patch_size)


def _cut(device: torch.device, xyz: npt.NDArray[np.float64], coverage: float, seed: int, patch_size: int) -> Patches:
    points = torch.from_numpy(xyz.astype(np.float32)).to(device)
    count = len(points)
    size = min(patch_size, count)
    wanted = 1 if count <= patch_size else max(1, math.ceil(coverage * count / size))
    seeds = _farthest(points, wanted, seed % count)
    distance, index = _nearest(points, seeds, size)
    covered = torch.zeros(count, dtype=torch.bool, device=device)
    covered[index] = True
    while not covered.all():
        left = (~covered).nonzero().flatten()
        more = left[_farthest(points[left], math.ceil(2 * len(left) / size), 0)]
        more_distance, more_index = _nearest(points, more, size)
        more_index[:, -1] = torch.where((more_index == more[:, None]).any(dim=1), more_index[:, -1], more)
        covered[more_index] = True
        seeds = torch.cat([seeds, more])
        distance, index = torch.cat([distance, more_distance]), torch.cat([index, more_index])
    owns = _owners(distance, index, count)[index] == torch.arange(len(seeds), device=device)[:, None]
    index = index.gather(1, owns.logical_not().byte().argsort(dim=1, stable=True))
    return Patches(
        seeds.cpu().numpy(),
        index.int().cpu().numpy(),
        owns.sum(dim=1).cpu().numpy(),
        distance[:, -1].double().cpu().numpy(),
    )


def _farthest(points: torch.Tensor, wanted: int, first: int) -> torch.Tensor:
    """Sample farthest points of (N, 3) float32, beginning with row `first`: (wanted,)."""
    if wanted >= len(points):
        return torch.arange(len(points), device=points.device)
    if points.is_cuda:
        from straightpcf.model.kernels import cuda

        if len(points) <= cuda.MOST_FARTHEST and cuda.load():
            return cuda.farthest(points, wanted, first)
    return farthest_torch(points, wanted, first)


def farthest_torch(points: torch.Tensor, wanted: int, first: int) -> torch.Tensor:
    """Do what `kernels.cuda.farthest` does for any number of points; the loop never waits for the device."""
    seeds = torch.empty(wanted, dtype=torch.int64, device=points.device)
    nearest = torch.full((len(points),), torch.inf, dtype=points.dtype, device=points.device)
    last = torch.tensor([first], device=points.device)
    for n in range(wanted):
        seeds[n : n + 1] = last
        # Not points[last] with a scalar: torch would fetch that from the device.
        torch.minimum(nearest, (points - points.index_select(0, last)).square().sum(dim=1), out=nearest)
        last = nearest.argmax(keepdim=True)
    return seeds


def _nearest(points: torch.Tensor, seeds: torch.Tensor, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return distances and rows, (M, size), of the points nearest to each seed, in that order."""
    found = []
    for some in torch.split(seeds, max(1, _DISTANCES // len(points))):
        # Differences, not products: these keep no digit of a small patch far from the origin.
        found.append(squared_distances(points[some], points).topk(size, dim=1, largest=False))
    return torch.cat([f.values.sqrt() for f in found]), torch.cat([f.indices for f in found])


def _owners(distance: torch.Tensor, index: torch.Tensor, count: int) -> torch.Tensor:
    """Return for each point the first of the patches to whose seed it is nearest in units of the patch's radius."""
    radius = distance[:, -1:]
    ratio = (distance / torch.where(radius > 0, radius, 1)).flatten()
    rows = index.flatten()
    best = torch.full((count,), torch.inf, dtype=ratio.dtype, device=ratio.device).scatter_reduce(
        0, rows, ratio, "amin"
    )
    patch = torch.arange(len(index), device=rows.device).repeat_interleave(index.shape[1])
    patch = torch.where(ratio == best[rows], patch, len(index))
    return torch.full((count,), len(index), device=rows.device).scatter_reduce(0, rows, patch, "amin")
