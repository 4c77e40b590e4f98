"""What each pass of a training state leaves: CD, the error across the surface, and how much of that is shrinkage.

python -m benchmarks.passes runs/cvm/state.safetensors [--distance runs/dm/state.safetensors] [--noise 0.01 0.02]

On the held-out shapes at 10K points, their 50K points standing for the surface; means over the shapes, x1e-4, in radii
of the bounding sphere. `across` is the mean squared height over the surface. `sunk` is the part of it that goes with
the surface's curvature: the squared mean height of each tenth of the points by mean curvature, heights counted
towards the inside of the bend; noise alone would leave some 0.001 of it.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from benchmarks.command import errors_in_one_line, noise_level, positive
from benchmarks.quality import SHARED
from benchmarks.shapes import make_noise
from straightpcf.model.filter import Filter
from straightpcf.model.metrics import chamfer_distance
from straightpcf.model.normalize import CloudFrame
from straightpcf.model.normals import recompute_normals
from straightpcf.model.train.archive import opened
from straightpcf.model.train.data import held_out_shapes
from straightpcf.model.train.state import read_network, take_distance_module
from straightpcf.points.errors import InvalidOptions
from straightpcf.points.options import DenoiseOptions

_AROUND = 150  # points of the 50K over which curvature is taken
_TENTHS = 10
_RESOLUTION = 10_000


@dataclass(frozen=True)
class Truth:
    """A clean cloud (N, 3) and its surface: a tree of points, normals towards the inside of the bend, curvature."""

    clean: npt.NDArray[np.float64]
    tree: cKDTree
    normals: npt.NDArray[np.float64]
    curvature: npt.NDArray[np.float64]

    @classmethod
    def of(cls, clean: npt.NDArray[np.float64], surface: npt.NDArray[np.float64]) -> Truth:
        """Measure the surface."""
        tree = cKDTree(surface)
        normals = recompute_normals(surface, np.zeros_like(surface))
        reach, around = tree.query(surface, k=_AROUND)
        sag = ((surface[around].mean(axis=1) - surface) * normals).sum(axis=1)  # H r^2 / 4 over a disc
        normals *= np.where(sag < 0, -1.0, 1.0)[:, None]
        return cls(clean, tree, normals, 4 * np.abs(sag) / reach[:, -1] ** 2)

    @classmethod
    def read(cls, archive: Mapping[str, npt.NDArray[np.float32]], shape: str, resolution: int) -> Truth:
        """Read a shape of an archive that training takes, in the unit-ball frame of the 50K points of its surface."""
        surface = archive[f"{shape}/50000"].astype(np.float64)
        frame = CloudFrame.of(surface)
        return cls.of(frame.enter(archive[f"{shape}/{resolution}"].astype(np.float64)), frame.enter(surface))

    @classmethod
    def drawn(cls, archive: Mapping[str, npt.NDArray[np.float32]], shape: str, count: int, seed: int) -> Truth:
        """Draw `count` of the 50K points of a shape by chance, in the unit-ball frame of all of them.

        Raises InvalidOptions where that is more than there are.
        """
        surface = archive[f"{shape}/50000"].astype(np.float64)
        if count > len(surface):
            raise InvalidOptions(f"no {shape}/{count} can be drawn of {len(surface)} points")
        surface = CloudFrame.of(surface).enter(surface)
        chosen = np.random.default_rng(seed).choice(len(surface), size=count, replace=False)
        return cls.of(surface[chosen], surface)

    def heights(self, xyz: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Return how high over the surface points (N, 3) are, and the surface's points below them, both (N,)."""
        _, foot = self.tree.query(xyz)
        return ((xyz - self.tree.data[foot]) * self.normals[foot]).sum(axis=1), foot

    def measures(self, xyz: npt.NDArray[np.float64]) -> tuple[float, float, float]:
        """Return CD, across and sunk of a filtered cloud (N, 3), x1e4."""
        height, foot = self.heights(xyz)
        order = np.argsort(self.curvature[foot], kind="stable")
        sunk = np.mean([part.mean() ** 2 for part in np.array_split(height[order], _TENTHS)])
        return 1e4 * chamfer_distance(xyz, self.clean), float(1e4 * np.mean(height**2)), float(1e4 * sunk)


@errors_in_one_line()
def main() -> None:
    """Print a row for each state, noise and pass."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("states", type=Path, nargs="+")
    parser.add_argument("--distance", type=Path, help="the state whose DistanceModule to take")
    parser.add_argument("--noise", type=noise_level, nargs="+", default=[0.01, 0.02])
    parser.add_argument("--passes", type=positive, default=4)
    parser.add_argument("--data", type=Path, default=SHARED / "data" / "punet_train.npz")
    parser.add_argument("--threads", type=positive)
    arguments = parser.parse_args()
    networks = [(state, read_network(state)[0]) for state in arguments.states]  # one that is none is found out first
    with opened(arguments.data) as archive:
        truths = [Truth.read(archive, shape, _RESOLUTION) for shape in sorted(held_out_shapes(archive.files))]
    print(f"{'velocities':40} noise  pass     CD  across   sunk")
    for state, network in networks:
        if arguments.distance is not None:
            take_distance_module(network, arguments.distance)
        if len(network.velocity_modules) == 1:  # as a stack of copies
            network.velocity_modules.append(copy.deepcopy(network.velocity_modules[0]))
        model = Filter(network, threads=arguments.threads, zoom=False)  # every pass here is a first one
        for noise in arguments.noise:
            rows = np.zeros((arguments.passes, 3))
            for truth in truths:
                xyz = make_noise("gaussian", truth.clean, noise, seed=0)
                for row in rows:
                    xyz = model.denoise(xyz, DenoiseOptions(iterations=1)).xyz
                    row += np.array(truth.measures(xyz)) / len(truths)
            for number, (cd, across, sunk) in enumerate(rows, start=1):
                print(f"{state!s:40} {noise:5.3f} {number:5d} {cd:6.3f} {across:7.3f} {sunk:6.3f}", flush=True)


if __name__ == "__main__":
    main()
