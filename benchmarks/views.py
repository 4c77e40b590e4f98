"""Filter what a scanner sees from one place, with noise along its beams alone.

python -m straightpcf.model.train.scanned scanned.npz --count 12 --seed 7
python -m benchmarks.views scanned.npz [--noise 0.005 0.01 0.02] [--points 12000] [--shapes scanned003]

Of each scan as it came and as it ends (`auto`): rms distance to the surface and to the truth, which is where each beam
meets the surface, x1e4, and CD to the truth, x1e4, in radii of the bounding sphere; then geometric means. NO VIEW: the
place it was seen from was not found. Seed 0 made what the weights were trained on; others are unseen.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from benchmarks.command import errors_in_one_line, noise_level, positive, seed_number
from straightpcf.model.filter import Filter, load_filter
from straightpcf.model.metrics import chamfer_distance
from straightpcf.model.objects import begin
from straightpcf.model.run import Run
from straightpcf.model.train.archive import opened, read_array
from straightpcf.model.train.data import along_beams
from straightpcf.points.errors import InvalidOptions, MalformedFile
from straightpcf.points.options import DenoiseOptions

Floats = npt.NDArray[np.float64]


@errors_in_one_line()
def main() -> None:
    """Print a line for each scan and noise, then each noise's means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", type=Path, help="an .npz of `model.train.scanned`")
    parser.add_argument("--noise", type=noise_level, nargs="+", default=[0.0025, 0.005, 0.01, 0.02])
    parser.add_argument("--points", type=positive, default=12_000, help="about, 12000 by default")
    parser.add_argument("--shapes", nargs="+", help="only these")
    parser.add_argument("--seed", type=seed_number, default=0)
    parser.add_argument("--weights", type=Path, help="default: the shipped ones")
    parser.add_argument("--threads", type=positive)
    arguments = parser.parse_args()
    model = load_filter(arguments.weights, device="cpu", threads=arguments.threads)
    scans = _scans(arguments.archive, arguments.shapes, arguments.points)
    for noise in arguments.noise:
        rows = []
        for name, scan in scans.items():
            found, row = scan.measured(model, noise, np.random.default_rng([arguments.seed, *name.encode()]))
            rows.append(row)
            print(f"{noise:6g} {name:12} {_said(row)}{'' if found else '  NO VIEW'}", flush=True)
        print(f"{noise:6g} {'mean':12} {_said(np.exp(np.log(rows).mean(axis=0)))}", flush=True)


def _said(row: Floats) -> str:
    (surface, truth, cd), after = row.reshape(2, 3)
    return (
        f"surface {surface:.1f} -> {after[0]:.1f}, truth {truth:.1f} -> {after[1]:.1f}, CD {cd:.3f} -> {after[2]:.3f}"
    )


@dataclass(frozen=True)
class _Scan:
    """A scan without noise: points (N, 3), the eye (3,), and samples (M, 3) of the surface with their normals."""

    points: Floats
    eye: Floats
    surface: cKDTree
    normals: Floats

    def measured(self, model: Filter, noise_std: float, rng: np.random.Generator) -> tuple[bool, Floats]:
        """Say whether the eye was found, and return the three measures before, and after: (6,)."""
        noise = rng.normal(0.0, noise_std, (len(self.points), 1))
        noisy = self.points + along_beams(noise, self.points, self.eye)
        run = begin(model, noisy, DenoiseOptions())
        for _ in run.patches():
            pass
        found = isinstance(run, Run) and run.readings[0].view is not None  # of several objects none is said
        return found, np.array([value for xyz in (noisy, run.result(0.0).xyz) for value in self._measures(xyz)])

    def _measures(self, xyz: Floats) -> tuple[float, float, float]:
        _, foot = self.surface.query(xyz)
        heights = ((xyz - self.surface.data[foot]) * self.normals[foot]).sum(axis=1)
        apart = np.linalg.norm(xyz - self.points, axis=1)
        to_surface, to_truth = (1e4 * float(np.sqrt(np.square(each).mean())) for each in (heights, apart))
        return to_surface, to_truth, 1e4 * chamfer_distance(xyz, self.points)


def _scans(archive: Path, shapes: list[str] | None, points: int) -> dict[str, _Scan]:
    with opened(archive) as file:
        names = sorted({name.partition("/")[0] for name in file.files if name.endswith("/eye")})
        if not names:
            raise InvalidOptions(f"{archive} has no scan with an eye")
        if unknown := sorted(set(shapes or names) - set(names)):
            raise InvalidOptions(f"{archive} has no scan {', '.join(unknown)}; there are {', '.join(names)}")
        return {name: _read(file, archive, name, points) for name in shapes or names}


def _read(file: np.lib.npyio.NpzFile, archive: Path, name: str, points: int) -> _Scan:
    counts = [int(count) for each in file.files if (count := each.removeprefix(f"{name}/")).isdigit()]
    if not counts:
        raise MalformedFile(f"{archive}: {name} has an eye and no points")
    nearest = min(counts, key=lambda count: abs(count - points))
    cloud, eye, surface, normals = (
        read_array(file, f"{name}/{what}", archive).astype(np.float64)
        for what in (str(nearest), "eye", "surface", "normals")
    )
    return _Scan(cloud, eye, cKDTree(surface), normals)


if __name__ == "__main__":
    main()
