"""Compare weights and training states on shapes that were held out of training: what candidates are chosen by.

python -m benchmarks.held_out model/weights/straightpcf.safetensors runs/cvm/state.safetensors [--unseen solids1.npz]
    [--shapes boy02 solid001] [--resolution 10000] [--random] [--noise 0.02 0.03] [--noise-type gaussian]
    [--iterations 4] [--device cuda]

CD / mean squared height over the surface, x1e-4, in radii of the bounding sphere, of each shape, and their geometric
and arithmetic means over shapes and seeds: the one weighs all shapes alike, the other shows walls that are joined. The
50K points of a shape stand for its surface; `--random` draws any number of them by chance. All candidates get the
DistanceModule and the calibration of the weights that ship, so only their velocities differ. `--unseen` names an
archive of which nothing was trained on, like solids made with a seed of their own.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.command import device, errors_in_one_line, noise_level, positive, seed_number
from benchmarks.passes import Truth
from benchmarks.quality import SHARED
from benchmarks.shapes import NOISE_TYPES, make_noise
from straightpcf.model.calibration import Calibration
from straightpcf.model.checkpoint import read_checkpoint
from straightpcf.model.filter import DEFAULT_WEIGHTS, Filter
from straightpcf.model.train.archive import opened
from straightpcf.model.train.data import held_out_shapes
from straightpcf.model.train.state import read_network, take_distance_module
from straightpcf.points.errors import InvalidOptions
from straightpcf.points.options import DenoiseOptions

_DRAW_SEED = 5  # of --random: all candidates get the same points


@errors_in_one_line()
def main() -> None:
    """Print a line for each candidate, level and seed, then its means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("candidates", type=Path, nargs="+", help="weights, or the state.safetensors of a run")
    parser.add_argument("--data", type=Path, default=SHARED / "data" / "punet_train.npz")
    parser.add_argument("--unseen", type=Path, action="append", default=[])
    parser.add_argument("--shapes", nargs="+", help="default: all that are held out or unseen")
    parser.add_argument(
        "--resolution", type=positive, default=10000, help="one that the archives have, or see --random"
    )
    parser.add_argument("--random", action="store_true", help="points by chance, as from a mesh, instead of even ones")
    parser.add_argument("--noise", type=noise_level, nargs="+", default=[0.02, 0.03])
    parser.add_argument("--noise-type", choices=tuple(NOISE_TYPES), default="gaussian")
    parser.add_argument(
        "--seeds", type=seed_number, nargs="+", default=[0, 1], help="of the noise; one is too little to judge by"
    )
    parser.add_argument("--iterations", default="4", help='of all candidates, "auto" or 1..10')
    parser.add_argument("--device", type=device, default="cpu", help='"cpu" (the default), "cuda" or "cuda:N"')
    parser.add_argument("--threads", type=positive)
    arguments = parser.parse_args()
    options = DenoiseOptions.parse(iterations=arguments.iterations)
    truths: dict[str, Truth] = {}
    for shape, truth in _truths(arguments):
        if shape in truths:
            raise InvalidOptions(f"two of the archives have a shape {shape}, by which figures are named")
        truths[shape] = truth
    if not truths:
        parser.error("no shape of these names is held out")
    candidates = {path: _filter(path, arguments.device, arguments.threads) for path in arguments.candidates}
    print("CD / height of", " | ".join(truths))
    for noise in arguments.noise:
        for path, model in candidates.items():
            rows = np.array(
                [_measured(model, truths, arguments.noise_type, noise, s, options) for s in arguments.seeds]
            )
            for seed, row in zip(arguments.seeds, rows, strict=True):
                print(f"{path!s:40} {noise:.3f} seed {seed}  " + " | ".join(f"{c:.3f} / {h:.3f}" for c, h in row))
            means = {"geometric": np.exp(np.log(rows).mean(axis=(0, 1))), "arithmetic": rows.mean(axis=(0, 1))}
            said = ", ".join(f"{kind} {cd:.3f} / {height:.3f}" for kind, (cd, height) in means.items())
            print(f"{path!s:40} {noise:.3f} mean    {said}", flush=True)


def _truths(arguments: argparse.Namespace) -> Iterator[tuple[str, Truth]]:
    """Yield the shapes asked for, in their unit-ball frames."""
    for path in [arguments.data, *arguments.unseen]:
        with opened(path) as archive:
            every = {name.split("/")[0] for name in archive.files}
            held_out = held_out_shapes(archive.files) if path == arguments.data else every
            for shape in sorted(held_out if arguments.shapes is None else held_out.intersection(arguments.shapes)):
                if arguments.random:
                    yield shape, Truth.drawn(archive, shape, arguments.resolution, _DRAW_SEED)
                elif f"{shape}/{arguments.resolution}" in archive:
                    yield shape, Truth.read(archive, shape, arguments.resolution)
                else:
                    raise InvalidOptions(f"{path} has no {shape}/{arguments.resolution}; --random draws any number")


def _filter(path: Path, device: str, threads: int | None) -> Filter:
    """Put a candidate's velocities beside the rest of what ships."""
    network, _ = read_network(path)
    take_distance_module(network, DEFAULT_WEIGHTS)
    calibration = Calibration.from_metadata(read_checkpoint(DEFAULT_WEIGHTS)[1])
    return Filter(network.to(device), calibration=calibration, device=device, threads=threads)


def _measured(
    model: Filter, truths: dict[str, Truth], kind: str, noise: float, seed: int, options: DenoiseOptions
) -> npt.NDArray[np.float64]:
    """Return CD and squared height of each shape, (S, 2)."""
    clouds = (make_noise(kind, truth.clean, noise, seed) for truth in truths.values())
    left = [truth.measures(model.denoise(xyz, options).xyz) for xyz, truth in zip(clouds, truths.values(), strict=True)]
    return np.array(left)[:, :2]


if __name__ == "__main__":
    main()
