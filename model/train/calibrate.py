"""Find out what the DistanceModule's number means: run known noise through the filter and compare."""

from __future__ import annotations

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
    limits = [n / 4000 for n in range(8, 81)]  # 0.002 to 0.02
    best = [_regret(replace(base, settled=limit), traces) for limit in limits]
    ties = [limit for limit, regret in zip(limits, best, strict=True) if regret <= min(best) + 1e-9]
    return replace(base, settled=ties[len(ties) // 2]), traces  # the middle of what serves equally well


def passes(calibration: Calibration, recorded: Trace) -> int:
    """Replay the rule of the filter on a recorded trace: how many passes `auto` would have made."""
    done = 0
    while calibration.passes_left(recorded.moves[:done], recorded.distances[: done + 1]):
        done += 1
    return done


def _regret(calibration: Calibration, traces: Sequence[Trace]) -> float:
    """Mean log of CD over the best CD, on the noisy clouds."""
    total = 0.0
    for t in traces:
        done = passes(calibration, t)
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
