"""Clouds as the filter's later passes see them: what is left of noise there is smooth, which drawn noise never is."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import nn

from straightpcf.model.filter import Filter, Run, load_filter
from straightpcf.model.normalize import CloudFrame
from straightpcf.model.tiles import Tiling
from straightpcf.model.train.data import (
    PATCH_SIZE,
    REACH,
    SCALES,
    TOUCH_UNTIL,
    Patch,
    PatchSource,
    Surface,
    drawn_noise,
    held_out_shapes,
    near_first,
)
from straightpcf.model.train.state import read_network
from straightpcf.points.errors import InvalidOptions
from straightpcf.points.options import DenoiseOptions

__all__ = ["PassedClouds", "training_patches", "write_passed"]

LEVELS = (0.005, 0.01, 0.015, 0.02, 0.025, 0.03)  # noise std, in radii of the bounding sphere
COARSEST_SHARE = 0.75  # of the clouds; a finer one takes several times as long
_LEAST = 2 * (1 - TOUCH_UNTIL)  # d below which a patch is as good as clean


@dataclass(frozen=True)
class _Cloud:
    """Hold a cloud (N, 3) in the frame that a later pass shows it in, and the surface, in the clean cloud's own."""

    xyz: npt.NDArray[np.float64]
    tree: cKDTree
    frame: CloudFrame
    surface: Surface


def training_patches(data: Sequence[Path], passed: Sequence[Path], distance: nn.Module) -> PatchSource:
    """Read the training clouds of the archives `data`, and those after passes of the archives `passed`."""
    source = PatchSource.read(*data)
    if passed:
        source.passed = PassedClouds(passed, data, distance)
    return source


class PassedClouds:
    """Draw patches of recorded clouds, each led to the surface by the way that the DistanceModule says it has to go."""

    def __init__(self, paths: Sequence[Path], data: Sequence[Path], distance: nn.Module) -> None:
        """Read what `write_passed` wrote of the shapes of the archives `data`; raises InvalidOptions where one lacks.

        distance: (B, PATCH_SIZE, 3) float32 patches -> (B, 1); it is asked without a gradient.
        """
        archives = {path.stem: path for path in data}
        surfaces: dict[tuple[str, str], Surface] = {}
        self._clouds: list[_Cloud] = []
        for path in paths:
            with np.load(path, allow_pickle=False) as recorded:
                for name in recorded.files:
                    archive, shape, _, what = name.split("/")
                    if what == "frame":
                        continue
                    if archive not in archives:
                        raise InvalidOptions(f"{path} has clouds of {archive}.npz, which is not among the data")
                    if (archive, shape) not in surfaces:
                        surfaces[archive, shape] = _surface(archives[archive], shape)
                    xyz = recorded[name].astype(np.float64)
                    *centre, radius = recorded[f"{name.rpartition('/')[0]}/frame"].tolist()
                    frame = CloudFrame(np.array(centre), radius)
                    self._clouds.append(_Cloud(xyz, cKDTree(xyz), frame, surfaces[archive, shape]))
        if not self._clouds:
            raise InvalidOptions(f"no cloud after a pass is in {', '.join(map(str, paths)) or 'no file'}")
        self._distance = distance

    def __len__(self) -> int:
        return len(self._clouds)

    @torch.no_grad()
    def patch(self, rng: np.random.Generator) -> Patch:
        """Draw a patch as `PatchSource` does: its points are to go straight to the surface, nowhere along it.

        Where along the surface a point came from is not to be seen any more, and the loss does not ask for it.
        """
        cloud = self._clouds[rng.integers(len(self._clouds))]
        origin = cloud.xyz[rng.integers(len(cloud.xyz))]
        _, near = cloud.tree.query(origin, k=PATCH_SIZE)
        scale = rng.uniform(*SCALES)
        transform = scale * np.asarray(Rotation.random(random_state=rng).as_matrix())
        here = cloud.xyz[near]
        shown = torch.from_numpy(((here - origin) @ transform).astype(np.float32))
        time = 1 - max(float(self._distance(shown[None])), _LEAST)
        here = here[near_first(rng)]
        places = here * cloud.frame.radius + cloud.frame.centre
        clean = cloud.frame.enter(cloud.surface.touching(places, places))
        seed = origin * cloud.frame.radius + cloud.frame.centre
        around, normals = cloud.surface.around(seed, REACH * PATCH_SIZE / len(cloud.xyz))
        noisy = (here - time * clean) / (1 - time)
        parts = [(points - origin) @ transform for points in (noisy, clean, here, cloud.frame.enter(around))]
        when, passed = np.array([[time]]), np.array([[1.0]])
        return parts[0], parts[1], when, parts[2], parts[3], normals @ transform / scale, passed


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
        clouds = shapes[archive][shape]
        finer = clouds[1:] if rng.random() >= COARSEST_SHARE else []
        clean = (finer or clouds[:1])[int(rng.integers(len(finer or clouds[:1])))]
        own = CloudFrame.of(clean)
        noise = LEVELS[int(rng.integers(len(LEVELS)))] * drawn_noise(rng, len(clean))
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

    seen: tuple[npt.NDArray[np.float64], ...] = ()

    def _pass(self, here: npt.NDArray[np.float64], tiling: Tiling, left: int) -> Iterator[object]:  # type: ignore[override]
        if self.iterations > 1 and self.readings[-1].zoom == 1.0:
            self.seen = (*self.seen, here.copy())
        yield from super()._pass(here, tiling, left)


def _training_clouds(archive: Path) -> dict[str, list[npt.NDArray[np.float64]]]:
    """Return the clean clouds of each shape that is not held out, the coarsest first."""
    with np.load(archive, allow_pickle=False) as file:
        held_out = held_out_shapes(file.files)
        names = [name.split("/") for name in file.files]
        found: dict[str, list[npt.NDArray[np.float64]]] = {}
        for shape, points in sorted((s, int(what)) for s, what in names if what.isdigit() and s not in held_out):
            found.setdefault(shape, []).append(file[f"{shape}/{points}"].astype(np.float64))
        return found


def _surface(archive: Path, shape: str) -> Surface:
    """Return the finest cloud of a shape with its normals, in its own coordinates."""
    with np.load(archive, allow_pickle=False) as file:
        clouds = {name.split("/")[1]: file[name] for name in file.files if name.startswith(f"{shape}/")}
    normals, surface = clouds.pop("normals", None), clouds.pop("surface", None)
    if not clouds:
        raise InvalidOptions(f"{archive} has no shape {shape}, of which there are clouds after a pass")
    return Surface.of(clouds.values(), normals, surface)


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
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
