"""Find out what the DistanceModule's number means: run known noise through the filter and compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import differential_evolution

from straightpcf.model.calibration import Calibration, signs
from straightpcf.model.filter import Filter, Run
from straightpcf.model.metrics import chamfer_distance
from straightpcf.points.options import DenoiseOptions

__all__ = ["NOISE_LEVELS", "Trace", "calibrate", "passes", "trace"]

NOISE_LEVELS = (0.0, 0.0025, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03)
_MOST_PASSES = 4
# Between passes that serve a cloud equally well the rule takes fewer: a pass more costs time and detail.
_PASS_PENALTY = 0.003
_COPIES, _BLUR = 8, np.array([0.02, 0.02, 0.03, 0.02])  # noise put onto the signs, so that no cloud sits on the limit


@dataclass(frozen=True)
class Trace:
    """One noisy cloud on its way: d before each pass and after the last, each pass's move, CD from 0 passes on."""

    cloud: str
    noise_std: float
    distances: tuple[float, ...]
    moves: tuple[float, ...]
    chamfer: tuple[float, ...]


def trace(filter_: Filter, name: str, clean: npt.NDArray[np.float64], noise_std: float, *, seed: int = 0) -> Trace:
    """Add Gaussian noise of `noise_std` radii to a clean unit-sphere cloud (N, 3) and filter it pass by pass."""
    noisy = clean + noise_std * np.random.default_rng(seed).standard_normal(clean.shape)
    run = Run(filter_, noisy, DenoiseOptions(iterations=_MOST_PASSES))
    states = {0: noisy}
    for patch in run.patches():
        states.setdefault(patch.iteration, noisy.copy())[patch.indices] = patch.xyz
    chamfer = tuple(chamfer_distance(x, clean) for x in states.values())
    return Trace(name, noise_std, tuple(run.distances), tuple(run.moves), chamfer)


def calibrate(traces: Sequence[Trace]) -> Calibration:
    """Read the table of noise levels and the rule for another pass off recorded traces."""
    levels = sorted({t.noise_std for t in traces})
    table = _rising([(np.median([t.distances[0] for t in traces if t.noise_std == s]), s) for s in levels])
    base = Calibration(distances=tuple(d for d, _ in table), noise=tuple(s for _, s in table), most=_MOST_PASSES)
    return replace(base, rule=_fit(traces))


def _fit(traces: Sequence[Trace]) -> tuple[float, ...]:
    """Find the rule whose passes cost least: mean and spread of log(CD / best CD), also if the signs were a bit off."""
    most = len(traces[0].moves)
    seen = np.array([[signs(t.moves[:n], t.distances[: n + 1]) for n in range(1, most)] for t in traces])  # (T, n, 4)
    regret = np.array([np.log(np.array(t.chamfer[1:]) / min(t.chamfer[1:])) for t in traces])
    regret += _PASS_PENALTY * np.arange(most)
    jitter = np.random.default_rng(0).normal(size=(_COPIES, *seen.shape)) * _BLUR
    jitter[0] = 0.0

    def cost(rule: npt.NDArray[np.float64]) -> float:
        on = (seen + jitter) @ rule[:4] + rule[4] > 0  # (copies, T, n)
        done = np.logical_and.accumulate(on, axis=2).sum(axis=2)
        lost = np.take_along_axis(np.broadcast_to(regret, (_COPIES, *regret.shape)), done[..., None], axis=2)
        return float(lost.mean() + 0.1 * np.sqrt((lost**2).mean()))

    found = differential_evolution(cost, [(-1.0, 1.0)] * 5, rng=0, maxiter=300, popsize=20, tol=1e-10)
    return tuple(round(float(weight), 4) for weight in found.x)


def passes(calibration: Calibration, recorded: Trace) -> int:
    """Replay the rule of the filter on a recorded trace: how many passes `auto` would have made."""
    done = 0
    while calibration.passes_left(recorded.moves[:done], recorded.distances[: done + 1]):
        done += 1
    return done


def _rising(pairs: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Keep the pairs whose distance is above all before it, so that the table can be looked up in."""
    kept: list[tuple[float, float]] = []
    for distance, std in pairs:
        if not kept or distance > kept[-1][0] + 1e-4:
            kept.append((float(distance), float(std)))
    return kept if len(kept) > 1 else [(0.0, 0.0), (1.0, 0.02)]
