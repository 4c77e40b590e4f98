"""Find out what the DistanceModule's number means: run known noise through the filter and compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from straightpcf.model.calibration import Calibration
from straightpcf.model.filter import Filter, Run
from straightpcf.model.metrics import chamfer_distance
from straightpcf.points.options import DenoiseOptions

__all__ = ["NOISE_LEVELS", "Trace", "calibrate", "passes", "trace"]

NOISE_LEVELS = (0.0, 0.0025, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03)


@dataclass(frozen=True)
class Trace:
    """One noisy cloud on its way: d before each pass and after the last, CD from 0 passes on."""

    cloud: str
    noise_std: float
    distances: tuple[float, ...]
    chamfer: tuple[float, ...]


def trace(filter_: Filter, name: str, clean: npt.NDArray[np.float64], noise_std: float, *, seed: int = 0) -> Trace:
    """Add Gaussian noise of `noise_std` radii to a clean unit-sphere cloud (N, 3) and filter it pass by pass."""
    noisy = clean + noise_std * np.random.default_rng(seed).standard_normal(clean.shape)
    run = Run(filter_, noisy, DenoiseOptions(iterations=filter_.calibration.most))
    states = {0: noisy}
    for patch in run.patches():
        states.setdefault(patch.iteration, noisy.copy())[patch.indices] = patch.xyz
    chamfer = tuple(chamfer_distance(x, clean) for x in states.values())
    return Trace(name, noise_std, tuple(run.distances), chamfer)


def calibrate(traces: Sequence[Trace]) -> Calibration:
    """Read the table of noise levels off recorded traces."""
    levels = sorted({t.noise_std for t in traces})
    table = _rising([(np.median([t.distances[0] for t in traces if t.noise_std == s]), s) for s in levels])
    return Calibration(distances=tuple(d for d, _ in table), noise=tuple(s for _, s in table))


def passes(calibration: Calibration, recorded: Trace) -> int:
    """Replay the rule of the filter on a recorded trace: how many passes `auto` would have made."""
    done = 0
    while calibration.passes_left(recorded.distances[: done + 1]):
        done += 1
    return done


def _rising(pairs: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Keep the pairs whose distance is above all before it, so that the table can be looked up in."""
    kept: list[tuple[float, float]] = []
    for distance, std in pairs:
        if not kept or distance > kept[-1][0] + 1e-4:
            kept.append((float(distance), float(std)))
    return kept if len(kept) > 1 else [(0.0, 0.0), (1.0, 0.02)]
