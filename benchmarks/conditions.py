"""Filter clouds unlike those of training: noise that differs from place to place, grids, outliers, points that are few.

python -m benchmarks.conditions [half-1-3 ramp voxels ...] [--shapes torus plate] [--archive unseen.npz] [--seeds 0 1]
    [--weights runs/weights.safetensors]

CD and mean squared height over the surface, x1e-4, in radii of the bounding sphere, of each cloud as it came and as it
ends (`auto`), of analytic shapes, or of an archive's, whose 50K points stand for their surface. Of noise in two halves
the louder one's height is told, too. A line that ends in WORSE ends farther off than it came.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.command import errors_in_one_line, positive, seed_number
from benchmarks.passes import Truth
from benchmarks.shapes import ANALYTIC, analytic
from straightpcf.model.filter import Filter, load_filter
from straightpcf.model.normalize import CloudFrame
from straightpcf.model.train.archive import opened

__all__ = ["CONDITIONS", "Condition"]

Floats = npt.NDArray[np.float64]
SURFACE = 50_000  # points that stand for an analytic surface, as for an archive's
_BEAM = np.array([0.3, 0.5, 0.81])  # where a scanner looks from


@dataclass(frozen=True)
class Condition:
    """A cloud as it should be and as it comes, both (N, 3); loud: which points have more noise, where only some do."""

    clean: Floats
    noisy: Floats
    loud: npt.NDArray[np.bool_] | None = None


Make = Callable[[np.random.Generator, Floats], Condition]


@errors_in_one_line()
def main() -> None:
    """Print a line for each shape, condition and seed, then each condition's means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("conditions", nargs="*", metavar="CONDITION", help=f"of {', '.join(CONDITIONS)}; default: all")
    parser.add_argument("--shapes", nargs="+", help=f"default: all of the archive, or {', '.join(ANALYTIC)}")
    parser.add_argument("--archive", type=Path, help="an .npz as training takes it")
    parser.add_argument("--resolution", type=positive, default=10_000)
    parser.add_argument("--seeds", type=seed_number, nargs="+", default=[0])
    parser.add_argument("--weights", type=Path, help="default: the shipped ones")
    parser.add_argument("--threads", type=positive)
    arguments = parser.parse_args()
    if unknown := set(arguments.conditions) - set(CONDITIONS):
        parser.error(f"no condition {', '.join(sorted(unknown))}; there are {', '.join(CONDITIONS)}")
    model = load_filter(arguments.weights, device="cpu", threads=arguments.threads)
    truths = dict(_truths(arguments.archive, arguments.shapes, arguments.resolution))
    for name in arguments.conditions or CONDITIONS:
        rows = []
        for shape, truth in truths.items():
            for seed in arguments.seeds:
                condition = CONDITIONS[name](np.random.default_rng([seed, *name.encode()]), truth.clean)
                rows.append(row := _measured(model, condition, truth))
                print(f"{name:12} {shape:14} seed {seed}  {_said(row)}", flush=True)
        print(f"{name:12} {'mean':14}         {_said(np.exp(np.log(rows).mean(axis=0)))}", flush=True)


def _said(row: Floats) -> str:
    before, after, louder = row.reshape(3, 2)
    worse = "  WORSE" if (after > before).any() else ""
    loud = f", louder {louder[0]:.3f} -> {louder[1]:.3f}" if np.isfinite(louder).all() else ""
    return f"{before[0]:.3f} / {before[1]:.3f} -> {after[0]:.3f} / {after[1]:.3f}{loud}{worse}"


def _measured(model: Filter, condition: Condition, truth: Truth) -> Floats:
    """Return CD and squared height before, both after, and the louder points' height before and after, (6,)."""
    truth, loud = replace(truth, clean=condition.clean), condition.loud
    clouds = [condition.noisy, model.denoise(condition.noisy).xyz]
    found = [value for xyz in clouds for value in truth.measures(xyz)[:2]]
    louder = [np.nan if loud is None else 1e4 * np.square(truth.heights(xyz[loud])[0]).mean() for xyz in clouds]
    return np.array([*found, *louder])


def _truths(archive: Path | None, shapes: list[str] | None, resolution: int) -> Iterator[tuple[str, Truth]]:
    """Yield each shape, in the unit-ball frame of the points that stand for its surface."""
    if archive is None:
        for coarse, fine in zip(analytic(resolution, shapes), analytic(SURFACE, shapes), strict=True):
            frame = CloudFrame.of(fine.clean)
            yield coarse.name, Truth.of(frame.enter(coarse.clean), frame.enter(fine.clean))
        return
    with opened(archive) as file:
        for shape in sorted(shapes or {name.split("/")[0] for name in file.files}):
            yield shape, Truth.read(file, shape, resolution)


def _along(clean: Floats) -> Floats:
    """Return 0 to 1 for each point, from one end of the cloud to the other: (N, 1)."""
    low, high = clean[:, 0].min(), clean[:, 0].max()
    along: Floats = (clean[:, :1] - low) / (high - low)
    return along


def _gaussian(std: Callable[[Floats], Floats]) -> Make:
    """Make Gaussian noise of a std (N, 1), or (1,), that differs along the cloud; twice as much is loud."""

    def make(rng: np.random.Generator, clean: Floats) -> Condition:
        stds = np.broadcast_to(std(_along(clean)), (len(clean), 1))
        loud = stds[:, 0] > 2 * stds.min()
        return Condition(clean, clean + stds * rng.normal(size=clean.shape), loud if loud.any() else None)

    return make


def _rounded(cell: float, std: float) -> Make:
    """Make what a voxel grid of some cell leaves of a cloud with noise."""
    return lambda rng, clean: Condition(clean, cell * np.round((clean + std * rng.normal(size=clean.shape)) / cell))


def _some(share: float, std: float, others: float) -> Make:
    """Make noise of one std in some of the points, of another one in the others."""

    def make(rng: np.random.Generator, clean: Floats) -> Condition:
        stds = np.where(rng.random((len(clean), 1)) < share, std, others)
        return Condition(clean, clean + stds * rng.normal(size=clean.shape))

    return make


def _heavy(std: float) -> Make:
    """Make noise of Student's t with three degrees of freedom, times std."""
    return lambda rng, clean: Condition(clean, clean + std * rng.standard_t(3, size=clean.shape))


def _beams(std: float) -> Make:
    """Make noise along one direction only."""
    beam = _BEAM / np.linalg.norm(_BEAM)
    return lambda rng, clean: Condition(clean, clean + std * rng.normal(size=(len(clean), 1)) * beam)


def _discrete(std: float) -> Make:
    """Move six points in ten by std along one of the axes, forth or back."""

    def make(rng: np.random.Generator, clean: Floats) -> Condition:
        ways = np.concatenate([np.eye(3), -np.eye(3), np.zeros((4, 3))])
        return Condition(clean, clean + std * ways[rng.integers(len(ways), size=len(clean))])

    return make


def _merged(first: float, second: float, apart: float) -> Make:
    """Make two scans of one surface, each of half of the points, with noise of a std each, that do not quite fit."""

    def make(rng: np.random.Generator, clean: Floats) -> Condition:
        of_second = rng.random((len(clean), 1)) < 0.5
        noisy = clean + np.where(of_second, second, first) * rng.normal(size=clean.shape)
        return Condition(clean, noisy + np.where(of_second, apart, 0.0) * _BEAM / np.linalg.norm(_BEAM))

    return make


def _fewer(keep: Callable[[np.random.Generator, Floats], npt.NDArray[np.bool_]], std: float) -> Make:
    """Make noise in those points that are kept."""

    def make(rng: np.random.Generator, clean: Floats) -> Condition:
        kept = clean[keep(rng, clean)]
        return Condition(kept, kept + std * rng.normal(size=kept.shape))

    return make


CONDITIONS: dict[str, Make] = {
    "half-1-3": _gaussian(lambda along: np.where(along > 0.5, 0.03, 0.01)),
    "half-05-2": _gaussian(lambda along: np.where(along > 0.5, 0.02, 0.005)),
    "half-0-2": _gaussian(lambda along: np.where(along > 0.5, 0.02, 0.0)),
    "ramp": _gaussian(lambda along: 0.003 + 0.027 * along),
    "voxels": _rounded(0.02, 0.0),
    "voxels-05": _rounded(0.01, 0.005),
    "beams": _beams(0.02),
    "discrete": _discrete(0.02),
    "student": _heavy(0.01),
    "outliers": _some(0.05, 0.06, 0.01),
    "clean-fifth": _some(0.2, 0.0, 0.02),
    "merged": _merged(0.005, 0.01, 0.01),
    "thinning": _fewer(lambda rng, clean: rng.random(len(clean)) < (0.05 + 0.95 * _along(clean)[:, 0]) ** 2, 0.01),
    "cut": _fewer(lambda _, clean: _along(clean)[:, 0] > 0.5, 0.02),
    "thousand": _fewer(lambda rng, clean: rng.permutation(len(clean)) < 1000, 0.02),
    "two-thousand": _fewer(lambda rng, clean: rng.permutation(len(clean)) < 2000, 0.01),
    "little": _gaussian(lambda _: np.array([0.0025])),
    "four": _gaussian(lambda _: np.array([0.04])),
}


if __name__ == "__main__":
    main()
