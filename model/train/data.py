"""Training patches: clean and noisy versions of the same points, cut as the filter will cut them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from straightpcf.model.normalize import CloudFrame
from straightpcf.model.normals import recompute_normals
from straightpcf.points.errors import InvalidOptions

__all__ = [
    "CANDIDATES",
    "NEAR_SHARE",
    "NEAR_WEIGHT",
    "NOISE_STD",
    "PATCH_SIZE",
    "SCALES",
    "TOUCH_UNTIL",
    "VALIDATION_EVERY",
    "Batch",
    "PatchSource",
    "Surface",
    "held_out_shapes",
]

PATCH_SIZE = 1000
NOISE_STD = 0.02  # of x_0, in radii of the cloud's bounding sphere
SCALES = (0.8, 1.2)  # augmentation
# Every tenth shape by name stays out of training, so that there is something honest to choose by.
VALIDATION_EVERY = 10
# Noise moves points in and out of a patch: the noisy patch is chosen among this many clean neighbours. Of a patch of
# the filter at 50K points and 2 %, 1300 lack 4 % (at most 18 %), 2600 lack 0.04 % (2 %).
CANDIDATES = 2600
# The filter keeps of a patch what lies near its seed (a third, at 3-fold coverage): of the points that come first in a
# batch, and so into the loss, nine of ten are of the nearer half.
NEAR_SHARE, NEAR_WEIGHT = 0.5, 9.0


# Until then what is across the surface is aimed at the surface itself; later it is known no better than the points are.
TOUCH_UNTIL = 0.98
_CARRIED_SHARE = 0.75  # of the patches of a cloud that has carried versions


@dataclass(frozen=True)
class Batch:
    """B patches, in the frame of the seed's noisy position at time t, points near the seed likely to come first.

    noisy: (B, P, 3) float32 x_0, clean: (B, P, 3) float32 y, time: (B, 1, 1) float32 in [0, 1); or NaN for a carried
    patch, of a cloud that has been through a pass already: noisy is then where that left the points, and what time it
    is, is for the DistanceModule to say.
    """

    noisy: torch.Tensor
    clean: torch.Tensor
    time: torch.Tensor

    def at(self, time: torch.Tensor) -> torch.Tensor:
        """Return x_t = (1 - t) x_0 + t y, (B, P, 3)."""
        return torch.lerp(self.noisy, self.clean, time)

    def to(self, device: torch.device) -> Batch:
        """Return the same batch on another device."""
        return Batch(self.noisy.to(device), self.clean.to(device), self.time.to(device))


@dataclass(frozen=True)
class Surface:
    """A cloud dense enough to stand for its surface: points xyz (M, 3), their unit normals (M, 3), float64."""

    xyz: npt.NDArray[np.float64]
    normals: npt.NDArray[np.float64]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.xyz)

    def touching(self, here: npt.NDArray[np.float64], clean: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Shift clean points (P, 3) along normals, onto the planes that touch the surface nearest to `here` (P, 3).

        A noisy point comes from anywhere around its foot, and on average from beneath the surface's tangent plane
        (by H s^2 for mean curvature H and noise s): a network trained to lead it back there shrinks what is curved.
        """
        _, foot = self._tree.query(here)
        normal = self.normals[foot]
        shifted: npt.NDArray[np.float64] = (
            clean + ((self.xyz[foot] - clean) * normal).sum(axis=1, keepdims=True) * normal
        )
        return shifted


def held_out_shapes(names: Iterable[str]) -> set[str]:
    """Choose the validation shapes among keys `<shape>/<resolution>`: every tenth by name."""
    shapes = sorted({name.split("/")[0] for name in names})
    return set(shapes[VALIDATION_EVERY // 2 :: VALIDATION_EVERY])


class PatchSource:
    """Draw patches from clean clouds, each in the frame where its bounding sphere has radius 1."""

    def __init__(
        self,
        shapes: list[list[npt.NDArray[np.float32]]],
        carried: list[list[list[npt.NDArray[np.float32]]]] | None = None,
    ) -> None:
        """Take the clouds of each shape, in one frame; the one of most points is taken for its surface.

        carried: for each of the clouds, any number of versions of it after noise and a pass of the filter, in its frame
        and order; where there are some, they are drawn from as often as fresh noise.
        """
        if not shapes:
            raise InvalidOptions("no training cloud is left after the validation shapes are taken out")
        self.clouds: list[npt.NDArray[np.float64]] = []
        self.surfaces: list[Surface] = []
        self._carried: list[list[cKDTree]] = []
        for number, shape in enumerate(shapes):
            finest = max(shape, key=len).astype(np.float64)
            normals = recompute_normals(finest, np.zeros_like(finest))
            versions = [[] for _ in shape] if carried is None else carried[number]
            for cloud, after in zip(shape, versions, strict=True):
                wide = cloud.astype(np.float64)
                frame = CloudFrame.of(wide)
                self._carried.append([cKDTree(frame.enter(xyz.astype(np.float64))) for xyz in after])
                self.clouds.append(frame.enter(wide))
                self.surfaces.append(Surface(frame.enter(finest), normals))
        self._trees = [cKDTree(cloud) for cloud in self.clouds]

    @classmethod
    def read(cls, path: Path, *, validation: bool = False, carried: Path | None = None) -> PatchSource:
        """Read an .npz of clean clouds named `<shape>/<resolution>`: the training shapes, or the held-out ones.

        carried: an .npz that `carry` wrote, of the same clouds named `<shape>/<resolution>/<number>`.
        """
        after: dict[str, list[npt.NDArray[np.float32]]] = {}
        if carried is not None:
            with np.load(carried, allow_pickle=False) as archive:
                for name in archive.files:
                    after.setdefault(name.rpartition("/")[0], []).append(archive[name])
        with np.load(path, allow_pickle=False) as archive:
            held_out = held_out_shapes(archive.files)
            shapes: dict[str, list[str]] = {}
            for name in archive.files:
                shape = name.split("/")[0]
                if (shape in held_out) == validation:
                    shapes.setdefault(shape, []).append(name)
            clouds = [[archive[name] for name in names] for names in shapes.values()]
            return cls(clouds, [[after.get(name, []) for name in names] for names in shapes.values()])

    def draw(self, rng: np.random.Generator, batch_size: int, *, augment: bool = True) -> Batch:
        """Draw a batch; all randomness comes from `rng`."""
        pairs = [self._patch(rng, augment=augment) for _ in range(batch_size)]
        noisy, clean, time = (np.stack(part).astype(np.float32) for part in zip(*pairs, strict=True))
        return Batch(torch.from_numpy(noisy), torch.from_numpy(clean), torch.from_numpy(time).view(-1, 1, 1))

    def _patch(self, rng: np.random.Generator, *, augment: bool) -> tuple[npt.NDArray[np.float64], ...]:
        which = int(rng.integers(len(self.clouds)))
        carried = self._carried[which]
        if carried and rng.random() < _CARRIED_SHARE:
            here, clean = self._after_a_pass(rng, which, carried[rng.integers(len(carried))])
            time = math.nan
        else:
            here, clean, time = self._fresh(rng, which)
        origin = here[0]
        transform = np.eye(3)
        if augment:
            transform = Rotation.random(random_state=rng).as_matrix() * rng.uniform(*SCALES)
        # A weighted draw without replacement: the smallest of exponential variables (Efraimidis and Spirakis 2006).
        turn = rng.exponential(size=PATCH_SIZE)
        turn[: int(NEAR_SHARE * PATCH_SIZE)] /= NEAR_WEIGHT
        order = np.argsort(turn)
        here, clean = here[order], clean[order]
        if not time >= TOUCH_UNTIL:
            clean = self.surfaces[which].touching(here, clean)
        noisy = here if math.isnan(time) else (here - time * clean) / (1 - time)
        return (noisy - origin) @ transform, (clean - origin) @ transform, np.array(time)

    def _fresh(
        self, rng: np.random.Generator, which: int
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float]:
        """Return a patch at x_t, nearest to its seed first, its clean points, and t."""
        cloud, tree = self.clouds[which], self._trees[which]
        seed = cloud[rng.integers(len(cloud))]
        _, near = tree.query(seed, k=min(CANDIDATES, len(cloud)))
        clean = cloud[near]  # row 0 is the seed
        noisy = clean + NOISE_STD * rng.standard_normal(clean.shape)
        time = rng.random()
        here = (1 - time) * noisy + time * clean
        # Cut at x_t, as the filter cuts: a patch cut at x_0 has a rim as ragged as that noise, which tells the time.
        inside = np.argsort(np.square(here - here[0]).sum(axis=1))[:PATCH_SIZE]
        return here[inside], clean[inside], time

    def _after_a_pass(
        self, rng: np.random.Generator, which: int, tree: cKDTree
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return a patch of a carried cloud, nearest to its seed first, and its clean points."""
        _, inside = tree.query(tree.data[rng.integers(tree.n)], k=PATCH_SIZE)
        return tree.data[inside], self.clouds[which][inside]
