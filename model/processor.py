"""What the filter asks of the CPU or a device: `OnHost` and `OnDevice` answer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from straightpcf.model.patches import Patches
from straightpcf.model.tiles import Tiling

__all__ = ["Floats", "Forward", "Processor", "cut_out"]

Floats = npt.NDArray[np.float64]
# x (B, P, 3), owned (B,), distance (B, 1) or None, rows -> how far the first `rows` points move, (B, rows, 3)
Forward = Callable[[torch.Tensor, torch.Tensor, torch.Tensor | None, int], torch.Tensor]


class Processor(Protocol):
    """Where patches are evaluated. here: (N, 3) positions in the unit ball; scales: (M,), one for each patch of cut."""

    def displacements(
        self, here: Floats, cut: Patches, scales: Floats, probed: Mapping[int, float]
    ) -> Iterator[tuple[int, Floats]]:
        """Yield patch after patch, by number, how far the points that it owns move, in its own scale.

        probed: what the DistanceModule said of patches before, by number.
        """

    def distances(self, here: Floats, cut: Patches, scales: Floats) -> Floats:
        """Return what the DistanceModule says of each patch: (M,)."""

    def spread(self, here: Floats, tiling: Tiling, limit: float) -> Floats:
        """Return what `model.spread.spread` does; tiling: of the pass before."""


def cut_out(points: torch.Tensor, index: torch.Tensor, seeds: torch.Tensor, scales: torch.Tensor) -> torch.Tensor:
    """Cut patches out of the points (N, 3), centred on their seeds: (B, P, 3) float32.

    index: (B, P) rows; seeds: (B,) rows; scales: (B,) float64; all where the points are.
    """
    local = points[index.long()] - points[seeds][:, None]
    return (local * scales[:, None, None]).float()
