"""Training clouds made in code: solids or places as a scanner sees them, from one side, along the beams of a raster.

python -m straightpcf.model.train.scanned scanned.npz --count 36
python -m straightpcf.model.train.scanned places.npz --places --count 36

A depth camera, a laser scanner or a height raster measures along beams: its points lie on rows and columns, and its
noise along the beams only. A denoiser that has never seen that takes such noise for two sheets of a thin wall.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import fpsample
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from straightpcf.model.normalize import CloudFrame
from straightpcf.model.train.archive import write_archive
from straightpcf.model.train.command import archive_to_write, errors_in_one_line, positive, seed_number
from straightpcf.model.train.level_set import LevelSet
from straightpcf.model.train.places import PLACES, Place
from straightpcf.model.train.primitives import Solid, log_uniform
from straightpcf.model.train.solids import FAMILIES

__all__ = ["COUNTS", "SCANNED_PLACES", "SCANNED_SOLIDS", "Scanned", "Scanner", "write_scanned"]

Floats = npt.NDArray[np.float64]

COUNTS = (5_000, 12_000, 30_000)  # points of a shape's clouds, about; one side of a solid has half of its surface
_ASPECT = (1.0, 5.0)  # of the steps from row to row and along a row
_SLANTED = 0.25  # cosine below which a surface returns nothing
_PILOT = 128  # beams a side of the raster that tells how fine it has to be
# Around a beam the nearest sample within a mean spacing is on the surface that it meets, unless another within 2.5
# lies in front; where surfaces are steep, what is in front by less than the slant allows is the same one.
_NEAR, _FRONT = 1.0, 2.5


@dataclass(frozen=True)
class Scanned:
    """What is scanned, and how finely.

    name: what its arrays are called; families: made in turn, with the way (3,) to the scanner where not all will do;
    dense: samples that a scan is made from, of which `surface` are kept as its surface; distance: how far the scanner
    is from the centre, in radii; stream: of random numbers.
    """

    name: str
    families: Sequence[Callable[[np.random.Generator], Solid | LevelSet | Place]]
    dense: int
    surface: int
    distance: tuple[float, float]
    stream: int


SCANNED_SOLIDS = Scanned("scanned", FAMILIES, 500_000, 50_000, (2.5, 40.0), stream=1)
# What is thin in places asks for more samples.
SCANNED_PLACES = Scanned("place", PLACES, 1_000_000, 80_000, (1.3, 15.0), stream=2)


class Scanner:
    """A solid's samples, (M, 3) with their unit normals, seen from the place `eye` (3,), turned about the view."""

    def __init__(self, xyz: Floats, normals: Floats, eye: Floats, roll: float) -> None:
        """Sort out what faces the eye; xyz is in the frame where its bounding sphere has radius 1."""
        view = -eye / np.linalg.norm(eye)
        across = np.linalg.svd(view[None])[2][1:]  # two more axes
        turn = Rotation.from_rotvec(roll * view).as_matrix()
        self.eye = eye
        self.axes = np.stack([*(across @ turn.T), view])  # rows: along a row, from row to row, away
        away = xyz - eye
        facing = (away * normals).sum(axis=1) < 0
        self._away, self._normals = away[facing], normals[facing]
        seen = self._away @ self.axes.T
        self._depth = seen[:, 2]
        self._tree = cKDTree(seen[:, :2] / seen[:, 2:])
        self._spacing = 1 / (np.sqrt(len(xyz) / (4 * np.pi)) * np.linalg.norm(eye))
        self._half = np.abs(self._tree.data).max()  # of the image, which is square

    def raster(self, rng: np.random.Generator, count: int, aspect: float, *, shifted: bool) -> Floats:
        """Scan about `count` points (N, 3), rows `aspect` times as far apart as the points of a row.

        shifted: each row begins at a place of its own, as a spinning mirror's do; else there are columns too.
        """
        pilot = self._beams(rng, 2 * self._half / _PILOT, 1.0, shifted=False)
        share = len(self._met(pilot)) / len(pilot)
        step = 2 * self._half * np.sqrt(share / (count * aspect))
        return self._met(self._beams(rng, step, aspect, shifted=shifted))

    def _beams(self, rng: np.random.Generator, step: float, aspect: float, *, shifted: bool) -> Floats:
        """Return the places (n, 2) in the image, at depth 1, that the beams go through."""
        row = np.arange(-self._half, self._half, step)
        rows = np.arange(-self._half, self._half, step * aspect)
        phase = rng.random(len(rows)) * step if shifted else np.zeros(len(rows))
        return np.stack([(row + phase[:, None]).ravel(), np.repeat(rows, len(row))], axis=1)

    def _met(self, beams: Floats) -> Floats:
        """Return where beams (n, 2) meet the surface, (N, 3): each on the plane of the sample that is nearest to it."""
        _, near = self._tree.query(beams, k=32, distance_upper_bound=_FRONT * self._spacing)
        off = np.linalg.norm(self._tree.data[np.minimum(near, self._tree.n - 1)] - beams[:, None], axis=2)
        depth = np.append(self._depth, np.inf)[near]
        front = depth.min(axis=1, keepdims=True)
        slack = _FRONT * self._spacing * self._depth.max() / _SLANTED
        off = np.where(depth <= front + slack, off, np.inf)
        best = off.argmin(axis=1)[:, None]
        hit = np.take_along_axis(off, best, axis=1)[:, 0] < _NEAR * self._spacing
        sample = np.take_along_axis(near, best, axis=1)[hit, 0]
        ways = np.column_stack([beams[hit], np.ones(hit.sum())]) @ self.axes
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        slant = (ways * self._normals[sample]).sum(axis=1)
        steep = slant > -_SLANTED
        length = (self._away[sample] * self._normals[sample]).sum(axis=1)[~steep] / slant[~steep]
        met: Floats = self.eye + length[:, None] * ways[~steep]
        return met


def write_scanned(path: Path, count: int, *, seed: int = 0, what: Scanned = SCANNED_SOLIDS) -> None:
    """Write an .npz of `count` solids or places, each scanned at `COUNTS`: `<name><number>/<points>`, float32.

    With them `<name><number>/eye`, (3,), the place that the beams come from, and the whole surface with its normals,
    `<name><number>/surface` and `/normals`, (M, 3). All in the frame where the bounding sphere has radius 1.
    """
    arrays: dict[str, npt.NDArray[np.generic]] = {}
    for number in range(count):
        name = f"{what.name}{number:03d}"
        rng = np.random.default_rng([seed, number, what.stream])
        made = what.families[number % len(what.families)](rng)
        solid, way = made if isinstance(made, tuple) else (made, None)
        xyz, normals = solid.sample(rng, what.dense)
        xyz = CloudFrame.of(xyz).enter(xyz)
        if way is None:
            way = rng.standard_normal(3)
        eye = way / np.linalg.norm(way) * log_uniform(rng, what.distance)
        scanner = Scanner(xyz, normals, eye, rng.uniform(0, 2 * np.pi))
        for wanted in COUNTS:
            aspect = log_uniform(rng, _ASPECT) if rng.random() < 0.5 else 1.0
            points = scanner.raster(rng, wanted, aspect, shifted=bool(rng.random() < 0.3))
            arrays[f"{name}/{len(points)}"] = points.astype(np.float32)
        kept = fpsample.bucket_fps_kdline_sampling(xyz.astype(np.float32), what.surface, 7, 0)
        arrays[f"{name}/surface"] = xyz[kept].astype(np.float32)
        arrays[f"{name}/normals"] = normals[kept].astype(np.float32)
        arrays[f"{name}/eye"] = eye.astype(np.float32)
    write_archive(path, arrays, save=np.savez_compressed)


@errors_in_one_line()
def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=archive_to_write)
    parser.add_argument("--count", type=positive, default=36)
    parser.add_argument("--seed", type=seed_number, default=0)
    parser.add_argument("--places", action="store_true", help="pieces of streets, rooms, roofs, trees and masts")
    options = parser.parse_args()
    what = SCANNED_PLACES if options.places else SCANNED_SOLIDS
    write_scanned(options.path, options.count, seed=options.seed, what=what)


if __name__ == "__main__":
    _main()
