"""Record training clouds as the filter's later passes see them, for `straightpcf train cvm --passed`.

python -m straightpcf.model.train.record passed.npz --data punet_train.npz
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from straightpcf.model.filter import Filter, Run, load_filter
from straightpcf.model.normalize import CloudFrame
from straightpcf.model.tiles import Tiling
from straightpcf.model.train.data import drawn_noise, held_out_shapes
from straightpcf.model.train.state import read_network
from straightpcf.points.options import DenoiseOptions

__all__ = ["write_passed"]

Floats = npt.NDArray[np.float64]

LEVELS = (0.005, 0.01, 0.015, 0.02, 0.025, 0.03)  # noise std, in radii of the bounding sphere
COARSEST_SHARE = 0.75  # of the clouds; a finer one takes several times as long


def write_passed(path: Path, denoiser: Filter, data: Sequence[Path], count: int, *, seed: int = 0) -> None:
    """Filter `count` noisy training clouds of the archives `data`, and write them as they were before each later pass.

    Shapes that are held out stay out. A cloud is named `<archive>/<shape>/<number>/xyz`, (N, 3) float32 in the
    frame in which the filter has it; `<archive>/<shape>/<number>/frame` is that one's centre and radius among the clean
    points.
    """
    rng = np.random.default_rng(seed)
    shapes = {archive: _training_clouds(archive) for archive in data}
    written: dict[str, npt.NDArray[np.generic]] = {}
    while len(written) < 2 * count:
        archive = data[int(rng.integers(len(data)))]
        names = list(shapes[archive])
        shape = names[int(rng.integers(len(names)))]
        clouds, eye = shapes[archive][shape]
        finer = clouds[1:] if rng.random() >= COARSEST_SHARE else []
        clean = (finer or clouds[:1])[int(rng.integers(len(finer or clouds[:1])))]
        own = CloudFrame.of(clean)
        noise = LEVELS[int(rng.integers(len(LEVELS)))] * drawn_noise(rng, clean, eye)
        run = _Recording(denoiser, own.enter(clean) + noise, DenoiseOptions(iterations=3 if finer else 4))
        for _ in run.patches():
            pass
        for xyz in run.seen:
            key = f"{archive.stem}/{shape}/{len(written) // 2}"
            centre = own.centre + own.radius * run.frame.centre
            written[f"{key}/xyz"] = xyz.astype(np.float32)
            written[f"{key}/frame"] = np.array([*centre, own.radius * run.frame.radius])
    np.savez(path, **written)  # type: ignore[arg-type]


class _Recording(Run):
    """Keep what each pass but the first is given, as long as it is shown in the usual size."""

    seen: tuple[Floats, ...] = ()

    def _pass(self, here: Floats, tiling: Tiling, left: int) -> Iterator[object]:  # type: ignore[override]
        if self.iterations > 1 and self.readings[-1].zoom == 1.0:
            self.seen = (*self.seen, here.copy())
        yield from super()._pass(here, tiling, left)


def _training_clouds(archive: Path) -> dict[str, tuple[list[Floats], Floats | None]]:
    """Return the clean clouds of each shape that is not held out, the coarsest first, and where its beams came from."""
    with np.load(archive, allow_pickle=False) as file:
        held_out = held_out_shapes(file.files)
        names = [name.split("/") for name in file.files]
        found: dict[str, tuple[list[Floats], Floats | None]] = {}
        for shape, points in sorted((s, int(what)) for s, what in names if what.isdigit() and s not in held_out):
            if shape not in found:
                found[shape] = [], file[f"{shape}/eye"].astype(np.float64) if f"{shape}/eye" in file else None
            found[shape][0].append(file[f"{shape}/{points}"].astype(np.float64))
        return found


def _main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("path", type=Path, help="the .npz to write")
    parser.add_argument("--data", type=Path, action="append", required=True, help="clean clouds; may be given again")
    parser.add_argument("--weights", type=Path, help="a checkpoint or a training state; the shipped weights by default")
    parser.add_argument("--count", type=int, default=500, help="clouds to record, three of each filtered one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    denoiser = load_filter(device="cpu", threads=options.threads)
    if options.weights is not None:
        denoiser.network.velocity_modules.load_state_dict(
            read_network(options.weights)[0].velocity_modules.state_dict()
        )
    write_passed(options.path, denoiser, options.data, options.count, seed=options.seed)


if __name__ == "__main__":
    _main()
