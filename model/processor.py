"""What the filter asks of the CPU or a device: `OnHost` and `OnDevice` answer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from straightpcf.model.patches import Patches
from straightpcf.model.tiles import Tiling

__all__ = ["Finish", "Floats", "Forward", "Mapper", "Processor", "cut_out"]

_T = TypeVar("_T")
_Item = TypeVar("_Item")
Floats = npt.NDArray[np.float64]
# x (B, P, 3), owned (B,), distance (B, 1) or None, rows -> how far the first `rows` points move, (B, rows, 3)
Forward = Callable[[torch.Tensor, torch.Tensor, torch.Tensor | None, int], torch.Tensor]
Finish = Callable[[int, Floats], _T]  # a patch's number and how far its points move -> what is made of it


class Mapper(Protocol):
    """What calls a function with each of some items: `map`, or that on threads."""

    def __call__(self, function: Callable[[_Item], _T], items: Iterable[_Item], /) -> Iterable[_T]:
        """Yield what the calls return, in the items' order; they are made in any."""


class Processor(Protocol):
    """Where patches are evaluated. positions: (N, 3), in the unit ball; scales: (M,), one for each patch of cut."""

    def displacements(
        self, positions: Floats, cut: Patches, scales: Floats, known_distances: Mapping[int, float], finish: Finish[_T]
    ) -> Iterator[_T]:
        """Yield patch after patch what `finish` returns of its number and of how far its points move, in its own scale.

        The points that it owns, (owned, 3). known_distances: what the DistanceModule said of patches before, by number.
        finish is called on threads, in any order.
        """

    def distances(self, positions: Floats, cut: Patches, scales: Floats) -> Floats:
        """Return what the DistanceModule says of each patch: (M,)."""

    @property
    def mapper(self) -> Mapper:
        """Calls on threads of the CPU."""

    def spread(self, positions: Floats, tiling: Tiling, limit: float) -> Floats:
        """Return what `model.spread.spread` does; tiling: of the pass before."""


def cut_out(points: torch.Tensor, index: torch.Tensor, seeds: torch.Tensor, scales: torch.Tensor) -> torch.Tensor:
    """Cut patches out of the points (N, 3), centred on their seeds: (B, P, 3) float32.

    index: (B, P) rows; seeds: (B,) rows; scales: (B,) float64; all where the points are.
    """
    local = points[index.long()] - points[seeds][:, None]
    return (local * scales[:, None, None]).float()
