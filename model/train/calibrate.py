"""Find out what the DistanceModule's number means: run known noise through the filter and compare."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from straightpcf.model.calibration import Calibration
from straightpcf.model.filter import Filter, Run
from straightpcf.model.metrics import chamfer_distance
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.points.options import DenoiseOptions

__all__ = ["NOISE_LEVELS", "Trace", "calibrate", "trace"]

NOISE_LEVELS = (0.0, 0.0025, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03)
_MOST_PASSES = 4
# Between passes that serve a cloud equally well the rule takes fewer: a pass more costs time and detail.
_PASS_PENALTY = 0.003


@dataclass(frozen=True)
class Trace:
    """One noisy cloud on its way: d before each pass and after the last, CD after 0, 1, ... passes."""

    cloud: str
    noise_std: float
    distances: tuple[float, ...]
    chamfer: tuple[float, ...]


def trace(filter_: Filter, name: str, clean: npt.NDArray[np.float64], noise_std: float, *, seed: int = 0) -> Trace:
    """Add Gaussian noise of `noise_std` radii to a clean unit-sphere cloud (N, 3) and filter it pass by pass."""
    noisy = clean + noise_std * np.random.default_rng(seed).standard_normal(clean.shape)
    run = Run(filter_, noisy, DenoiseOptions(iterations=_MOST_PASSES))
    states = {0: noisy.copy()}
    for patch in run.patches():
        states.setdefault(patch.iteration, states[0].copy())[patch.indices] = patch.xyz
    return Trace(name, noise_std, tuple(run.distances), tuple(chamfer_distance(x, clean) for x in states.values()))


def calibrate(
    network: StraightPCF,
    clouds: Mapping[str, npt.NDArray[np.float64]],
    *,
    noise_stds: Sequence[float] = NOISE_LEVELS,
    threads: int | None = None,
) -> tuple[Calibration, list[Trace]]:
    """Return the calibration for one network and the traces it was read off."""
    filter_ = Filter(network, threads=threads)
    traces = [trace(filter_, name, clean, std) for name, clean in clouds.items() for std in noise_stds]
    table = _rising([(np.median([t.distances[0] for t in traces if t.noise_std == s]), s) for s in sorted(noise_stds)])
    base = Calibration(distances=tuple(d for d, _ in table), noise=tuple(s for _, s in table), most=_MOST_PASSES)
    limits = np.round(np.arange(0.02, 1.0, 0.02), 2)
    pairs = [(one, stop) for one, stop in itertools.product(limits, limits) if stop <= one]
    one_pass, stop = min(pairs, key=lambda pair: _regret(replace(base, one_pass=pair[0], stop=pair[1]), traces))
    return replace(base, one_pass=float(one_pass), stop=float(stop)), traces


def passes(calibration: Calibration, distances: Sequence[float]) -> int:
    """Replay the rule of the filter on a recorded trace: how many passes `auto` would have made."""
    done = 0
    while left := calibration.passes_left(distances[done], done=done):
        done += 1
        if left == 1:
            break
    return done


def _regret(calibration: Calibration, traces: Sequence[Trace]) -> float:
    """Mean log of CD over the best CD; clean clouds have no best, and count by what they lose absolutely."""
    total = 0.0
    for t in traces:
        done = passes(calibration, t.distances)
        if t.noise_std > 0:
            total += float(np.log(t.chamfer[done] / min(t.chamfer[1:]))) + _PASS_PENALTY * done
    return total


def _rising(pairs: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Keep the pairs whose distance is above all before it, so that the table can be looked up in."""
    kept: list[tuple[float, float]] = []
    for distance, std in pairs:
        if not kept or distance > kept[-1][0] + 1e-4:
            kept.append((float(distance), float(std)))
    return kept if len(kept) > 1 else [(0.0, 0.0), (1.0, 0.02)]
