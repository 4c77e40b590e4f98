"""Some points of some patches, each among its nearest: looked up on threads of the CPU, or all at once on a device."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Protocol, TypeVar

import numpy as np
import torch

from straightpcf.model.device import current, enough_memory
from straightpcf.model.neighbourhoods import INNER_SHARE, Nearest
from straightpcf.model.ops import squared_distances
from straightpcf.model.patches import Patches
from straightpcf.model.processor import Floats, Mapper, Measure

__all__ = ["Survey", "survey", "survey_on"]

_T = TypeVar("_T")
_NEIGHBOURS = 64  # what the statistics ask for
_SAMPLES, _SAMPLES_OF_ALL = 128, 2000  # points of a patch that are looked at, at most, and of all where they are few
_TOGETHER = 4  # patches looked at in one go: of one numpy calls are so small that threads wait for the interpreter


class Survey(Protocol):
    """What looks at points (N, 3) in some of their patches."""

    def __call__(self, xyz: Floats, patches: Patches, measure: Measure[_T], /) -> Iterable[_T]:
        """Yield what `measure` makes of the nearest points of some points of the patches, and of how many patches.

        They are as many of each patch, patch after patch, some patches a call, looked up in the patch: of its middle,
        where they have their neighbours in it, or of all of a patch that is the whole cloud.
        """


def survey(xyz: Floats, patches: Patches, measure: Measure[_T], *, mapper: Mapper = map) -> Iterable[_T]:
    """Do what a Survey does in arrays; mapper: calls a function with the patches' rows, on threads if it has some."""
    count, step = _looked_at(patches)

    def look(some: slice) -> _T:
        found = []
        for points in xyz.take(patches.index[some], axis=0):
            middle = np.square(points - points.mean(axis=0)).sum(axis=1)
            found.append(Nearest.of(points[np.argsort(middle)[:count:step]], points, _NEIGHBOURS))
        return measure(Nearest.joined(found), len(found))

    return mapper(look, [slice(first, first + _TOGETHER) for first in range(0, len(patches.index), _TOGETHER)])


@torch.inference_mode()
def survey_on(device: torch.device, xyz: Floats, patches: Patches, measure: Measure[_T]) -> Iterable[_T]:
    """Do what a Survey does in tensors on a device, of all patches in one call.

    Raises TooLarge where the device has no memory for them.
    """
    count, step = _looked_at(patches)
    with current(device), enough_memory(device, patches.index.size):
        points = torch.from_numpy(xyz.take(patches.index, axis=0)).to(device)  # (M, P, 3)
        middle = (points - points.mean(dim=1, keepdim=True)).square().sum(dim=2)
        asked = _taken(points, middle.argsort(dim=1)[:, :count:step])
        distances = squared_distances(asked, points)
        found = distances.topk(min(_NEIGHBOURS, points.shape[1]), dim=2, largest=False)
        near = _taken(points, found.indices.flatten(1)).view(-1, found.indices.shape[2], 3)
        return [measure(Nearest(found.values.sqrt().flatten(0, 1), near), len(points))]


def _looked_at(patches: Patches) -> tuple[int, int]:
    """Return how many of a patch, its middle, have their neighbours in it, and the step from one to the next asked."""
    number, size = patches.index.shape
    count = size if number == 1 else round(INNER_SHARE * size)  # one patch is the whole cloud
    return count, math.ceil(count / max(_SAMPLES, _SAMPLES_OF_ALL // number))


def _taken(points: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Return some rows (M, n) of points (M, P, 3): (M, n, 3)."""
    return points.gather(1, rows[:, :, None].expand(-1, -1, 3))
