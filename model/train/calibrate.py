"""Find out what the DistanceModule's number means: run known noise through the filter and compare."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.model.calibration import FEW_POINTS, Calibration
from straightpcf.model.filter import Filter, Run
from straightpcf.model.metrics import chamfer_distance
from straightpcf.model.reading import Reading
from straightpcf.points.options import DenoiseOptions

__all__ = ["NOISE_LEVELS", "Trace", "calibrate", "every_pass", "loss", "noise_table", "passes", "trace"]

# What `calibrate` chooses from: every combination.
_LIMITS: dict[str, tuple[Any, ...]] = {
    "starts": tuple(product((0.21, 0.28, 0.45, 0.73), (0.75, 0.815, 0.85), (0.9, 0.945))),
    "polish": tuple(product((0.22, 0.35, 0.45), (0.62,), (0.74, 0.78, 0.82, 0.86), (0.9, 0.92))),
    # Before the second pass, the third, the fourth and fifth.
    "settled": tuple(
        (little, few, many, many)
        for little, few, many in product((0.18, 0.14), (0.18, 0.2, 0.22, 0.26, 0.3), (0.18, 0.2, 0.22, 0.26))
    ),
    "stuck": (0.61, 0.64),
    "stirred": (0.5,),
    "most": (5,),
}
_WORTH = 0.005  # of CD is what one more pass has to gain on the mean, for it takes as long as those before
# Levels at which d is read for the table; above, d hardly rises.
_TABLE_LEVELS = (0.0, 0.0025, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03)
NOISE_LEVELS = (0.0, 0.0025, 0.005, 0.0075, 0.01, 0.0125, 0.015, 0.0175, 0.02, 0.025, 0.03, 0.04, 0.05)


@dataclass(frozen=True)
class Trace:
    """One noisy cloud on its way: d before each pass and after the last, CD from 0 passes on.

    noise_std: in radii, the std, or what else is the size of the noise; noise_type: as `benchmarks.shapes` names it;
    noise_in_radii, thin_walls, irregular: of a patch, and of the cloud, what was read at the start; thicknesses: of the
    surface before each pass and after the last, where it was read (`Reading`); points: how many, as far as it matters.
    """

    cloud: str
    noise_std: float
    distances: tuple[float, ...]
    chamfer: tuple[float, ...]
    noise_type: str = "gaussian"
    noise_in_radii: float = 0.0
    thin_walls: bool = False
    thicknesses: tuple[float, ...] = ()
    points: int = FEW_POINTS
    irregular: bool = False

    @classmethod
    def of(
        cls,
        readings: Sequence[Reading],
        chamfer: Sequence[float],
        *,
        cloud: str,
        noise_std: float,
        noise_type: str,
        points: int,
    ) -> Trace:
        """Keep what was read before each pass and after the last, and CD from 0 passes on."""
        first = readings[0]
        return cls(
            cloud,
            noise_std,
            tuple(reading.distance for reading in readings),
            tuple(chamfer),
            noise_type,
            first.noise_in_radii,
            first.sampling.thin_walls,
            tuple(reading.thickness for reading in readings),
            points,
            first.sampling.irregular,
        )

    @property
    def level(self) -> tuple[str, str, float]:
        """The cell of a table: resolution (what follows the slash in the cloud's name), type and size of noise."""
        return self.cloud.partition("/")[2], self.noise_type, self.noise_std


def trace(
    filter_: Filter,
    name: str,
    clean: npt.NDArray[np.float64],
    noisy: npt.NDArray[np.float64],
    noise_std: float,
    noise_type: str = "gaussian",
) -> Trace:
    """Filter a noisy unit-sphere cloud (N, 3) pass by pass; clean: the same points without their noise."""
    states, readings = every_pass(filter_, noisy)
    chamfer = [chamfer_distance(x, clean) for x in states]
    return Trace.of(readings, chamfer, cloud=name, noise_std=noise_std, noise_type=noise_type, points=len(noisy))


def every_pass(
    filter_: Filter, noisy: npt.NDArray[np.float64], *, seed: int = 0
) -> tuple[list[npt.NDArray[np.float64]], list[Reading]]:
    """Return what the filter makes of a cloud (N, 3) with 0, 1, ... passes, and what it reads before each and last.

    As many passes as `calibrate` knows of; all points are taken for one object.
    """
    run = Run(filter_, noisy, DenoiseOptions(iterations=max(_LIMITS["most"]), seed=seed))
    states = {0: noisy}
    for patch in run.patches():
        states.setdefault(patch.iteration, noisy.copy())[patch.indices] = patch.xyz
    return list(states.values()), run.readings


def noise_table(filter_: Filter, clouds: Mapping[str, npt.NDArray[np.float64]], *, seed: int = 0) -> Calibration:
    """Read d of clean unit-sphere clouds (N, 3) with known noise: what a filter must know before it can be traced."""
    readings = []
    for clean in clouds.values():
        for std in _TABLE_LEVELS:
            run = Run(filter_, clean + std * np.random.default_rng(seed).standard_normal(clean.shape), DenoiseOptions())
            next(run.patches())  # d is read before the first patch is done
            readings.append((std, run.distances[0]))
    return _with_table(readings)


def calibrate(traces: Sequence[Trace], table: Calibration | None = None) -> Calibration:
    """Choose the limits of `auto` by replaying recorded traces: by `loss`, and what further passes are worth.

    table: whose table of noise levels to keep; without one it is read off the traces.
    """
    known = table or _with_table([(t.noise_std, t.distances[0]) for t in traces if t.noise_type == "gaussian"])
    choices = [replace(known, **dict(zip(_LIMITS, limits, strict=True))) for limits in product(*_LIMITS.values())]
    return min(choices, key=lambda choice: loss(choice, traces, worth=_WORTH))


def _with_table(readings: Sequence[tuple[float, float]]) -> Calibration:
    """Take the median d of each noise std."""
    levels = sorted({std for std, _ in readings})
    table = _rising([(float(np.median([d for s, d in readings if s == std])), std) for std in levels])
    return Calibration(distances=tuple(d for d, _ in table), noise=tuple(s for _, s in table))


def loss(calibration: Calibration, traces: Sequence[Trace], *, worth: float = 0.0) -> float:
    """Rate `auto` on recorded traces: the mean log ratio of its CD to that of each cloud's best number of passes.

    Every level (`Trace.level`) weighs the same. A cloud that is worse than its input weighs its log ratio to it ten
    times more. Clean clouds, whose best is no pass at all, count by their CD in units of 1e-5. Each pass adds `worth`.
    """
    by_level: dict[tuple[str, str, float], list[float]] = {}
    for t in traces:
        made = passes(calibration, t)
        reached = t.chamfer[made]
        if t.chamfer[0] > 0:
            rating = math.log(reached / min(t.chamfer[1:])) + 10 * max(0.0, math.log(reached / t.chamfer[0]))
        else:
            rating = reached / 1e-5
        by_level.setdefault(t.level, []).append(rating + worth * made)
    return float(np.mean([np.mean(ratings) for ratings in by_level.values()]))


def passes(calibration: Calibration, recorded: Trace) -> int:
    """Replay the rule of the filter on a recorded trace: how many passes `auto` would have made."""
    done = 0
    while done + 1 < len(recorded.distances):
        left = calibration.passes_left(
            recorded.distances[: done + 1],
            recorded.noise_in_radii,
            points=recorded.points,
            irregular=recorded.irregular,
            thin_walls=recorded.thin_walls,
            thicknesses=recorded.thicknesses[: done + 1],
        )
        if left == 0:
            break
        done += 1
    return done


def _rising(pairs: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Keep the pairs whose distance is above all before it, so that the table can be looked up in."""
    kept: list[tuple[float, float]] = []
    for distance, std in pairs:
        if not kept or distance > kept[-1][0] + 1e-4:
            kept.append((float(distance), float(std)))
    return kept if len(kept) > 1 else [(0.0, 0.0), (1.0, 0.02)]
