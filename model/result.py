"""What comes out of the filter: patch by patch while it runs, and at its end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["DenoiseResult", "FinishedPatch"]


@dataclass(frozen=True)
class FinishedPatch:
    """Points whose position in this pass is settled: no other patch of the pass changes them. There may be none.

    indices: (n,) int64 rows of the cloud; xyz: (n, 3) float64, the cloud's unit; iteration counts from 1;
    final: whether this is known to be the last pass, which `auto` finds out only afterwards;
    progress: 0..1, of the whole job as far as it can be foreseen; it never falls.
    """

    indices: npt.NDArray[np.int64]
    xyz: npt.NDArray[np.float64]
    iteration: int
    final: bool
    progress: float


@dataclass(frozen=True)
class DenoiseResult:
    """The filtered cloud and how it came about.

    xyz: (N, 3) float64 in the order given; noise_before, noise_after: estimated noise std in the cloud's unit;
    distances: the DistanceModule's median before each pass and after the last; untouched: rows that were not finite,
    meant "no data", or were so far out or alone that they belong to nothing, and passed through.
    """

    xyz: npt.NDArray[np.float64]
    iterations: int
    noise_before: float
    noise_after: float
    distances: tuple[float, ...]
    untouched: int
    seconds: float
    warnings: tuple[str, ...]
