"""What the filter asks of the CPU or a device: `OnHost` and `OnDevice` answer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from straightpcf.model.neighbourhoods import Nearest
from straightpcf.model.patches import Patches
from straightpcf.model.tiles import Tiling

__all__ = ["Finish", "First", "Floats", "Mapper", "Measure", "Network", "Processor", "cut_out"]

_T = TypeVar("_T")
_Item = TypeVar("_Item")
Floats = npt.NDArray[np.float64]
# Velocities of the first evaluation, of as many points as are asked for or more, and what takes their place, (B, P, 3).
First = tuple[torch.Tensor, torch.Tensor]
Measure = Callable[[Nearest, int], _T]  # the nearest points of some points of patches, and how many -> what they say
Finish = Callable[[int, Floats], _T]  # a patch's number and how far its points move -> what is made of it


class Mapper(Protocol):
    """What calls a function with each of some items: `map`, or that on threads."""

    def __call__(self, function: Callable[[_Item], _T], items: Iterable[_Item], /) -> Iterable[_T]:
        """Yield what the calls return, in the items' order; they are made in any."""


class Network(Protocol):
    """What a Processor runs on patches; all tensors are float32 but owned, (B,), int64."""

    def distance(self, x: torch.Tensor) -> torch.Tensor:
        """Return what the DistanceModule says of patches x (B, P, 3): (B, 1)."""

    def begin(self, x: torch.Tensor) -> torch.Tensor:
        """Return the velocities of the first evaluation: (B, P, 3)."""

    def forward(
        self, x: torch.Tensor, owned: torch.Tensor, distance: torch.Tensor | None, first: First | None, rows: int
    ) -> torch.Tensor:
        """Return how far the first `rows` points of patches move in a pass, (B, rows, 3); right for those owned.

        distance: (B, 1), where the DistanceModule has been asked; first: the velocities of the first evaluation, where
        that was made, and what takes their place.
        """


class Processor(Protocol):
    """Where patches are evaluated. positions: (N, 3), in the unit ball; scales: (M,), one for each patch of cut."""

    def displacements(
        self,
        positions: Floats,
        cut: Patches,
        scales: Floats,
        known_distances: Mapping[int, float],
        finish: Finish[_T],
        *,
        agree: bool,
    ) -> Iterator[_T | None]:
        """Yield patch after patch what `finish` returns of its number and of how far its points move, in its own scale.

        The points that it owns, (owned, 3). known_distances: what the DistanceModule said of patches before, by number.
        finish is called on threads, in any order. agree: what overlapping patches say of a point in the first
        evaluation is joined (`Agreement`); for each patch that has been heard, None is yielded before all others.
        """

    def distances(self, positions: Floats, cut: Patches, scales: Floats) -> Floats:
        """Return what the DistanceModule says of each patch: (M,)."""

    def spacings(self, positions: Floats, tiling: Tiling, count: int) -> tuple[Floats, Floats] | None:
        """Return how far the last of each point's `count` neighbours is, and the median of what that is of these.

        (N,) each; None where a tree is as quick. tiling: of these positions.
        """

    def mapper(self, function: Callable[[_Item], _T], items: Iterable[_Item], /) -> Iterable[_T]:
        """Do what a `Mapper` does; what torch does on the CPU it does there with one thread for each item."""

    def survey(self, positions: Floats, patches: Patches, measure: Measure[_T], /) -> Iterable[_T]:
        """Do what a `model.survey.Survey` does."""

    def spread(self, positions: Floats, tiling: Tiling, limit: float, rounds: int) -> Floats:
        """Return what `model.spread.spread` does; tiling: of the pass before."""


def cut_out(points: torch.Tensor, index: torch.Tensor, seeds: torch.Tensor, scales: torch.Tensor) -> torch.Tensor:
    """Cut patches out of the points (N, 3), centred on their seeds: (B, P, 3) float32.

    index: (B, P) rows; seeds: (B,) rows; scales: (B,) float64; all where the points are.
    """
    local = points[index.long()] - points[seeds][:, None]
    return (local * scales[:, None, None]).float()
