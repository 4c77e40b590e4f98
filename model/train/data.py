"""Training patches: clean and noisy versions of the same points, cut as the filter will cut them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from straightpcf.model.normalize import CloudFrame
from straightpcf.points.errors import InvalidOptions

__all__ = [
    "CANDIDATES",
    "NEAR_SHARE",
    "NEAR_WEIGHT",
    "NOISE_STD",
    "PATCH_SIZE",
    "SCALES",
    "VALIDATION_EVERY",
    "Batch",
    "PatchSource",
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


@dataclass(frozen=True)
class Batch:
    """B patches, in the frame of the seed's noisy position at time t, points near the seed likely to come first.

    noisy: (B, P, 3) float32 x_0, clean: (B, P, 3) float32 y, time: (B, 1, 1) float32 in [0, 1).
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


def held_out_shapes(names: Iterable[str]) -> set[str]:
    """Choose the validation shapes among keys `<shape>/<resolution>`: every tenth by name."""
    shapes = sorted({name.split("/")[0] for name in names})
    return set(shapes[VALIDATION_EVERY // 2 :: VALIDATION_EVERY])


class PatchSource:
    """Draw patches from clean clouds, each in the frame where its bounding sphere has radius 1."""

    def __init__(self, clouds: list[npt.NDArray[np.float32]]) -> None:
        if not clouds:
            raise InvalidOptions("no training cloud is left after the validation shapes are taken out")
        wide = [cloud.astype(np.float64) for cloud in clouds]
        self.clouds = [CloudFrame.of(cloud).enter(cloud) for cloud in wide]
        self._trees = [cKDTree(cloud) for cloud in self.clouds]

    @classmethod
    def read(cls, path: Path, *, validation: bool = False) -> PatchSource:
        """Read an .npz of clean clouds named `<shape>/<resolution>`: the training shapes, or the held-out ones."""
        with np.load(path, allow_pickle=False) as archive:
            held_out = held_out_shapes(archive.files)
            return cls([archive[name] for name in archive.files if (name.split("/")[0] in held_out) == validation])

    def draw(self, rng: np.random.Generator, batch_size: int, *, augment: bool = True) -> Batch:
        """Draw a batch; all randomness comes from `rng`."""
        pairs = [self._patch(rng, augment=augment) for _ in range(batch_size)]
        noisy, clean, time = (np.stack(part).astype(np.float32) for part in zip(*pairs, strict=True))
        return Batch(torch.from_numpy(noisy), torch.from_numpy(clean), torch.from_numpy(time).view(-1, 1, 1))

    def _patch(self, rng: np.random.Generator, *, augment: bool) -> tuple[npt.NDArray[np.float64], ...]:
        which = int(rng.integers(len(self.clouds)))
        cloud, tree = self.clouds[which], self._trees[which]
        seed = cloud[rng.integers(len(cloud))]
        _, near = tree.query(seed, k=min(CANDIDATES, len(cloud)))
        clean = cloud[near]  # row 0 is the seed
        noisy = clean + NOISE_STD * rng.standard_normal(clean.shape)
        time = rng.random()
        here = (1 - time) * noisy + time * clean
        origin = here[0]
        # Cut at x_t, as the filter cuts: a patch cut at x_0 has a rim as ragged as that noise, which tells the time.
        distance = np.square(here - origin).sum(axis=1)
        inside = np.argsort(distance)[:PATCH_SIZE]
        transform = np.eye(3)
        if augment:
            transform = Rotation.random(random_state=rng).as_matrix() * rng.uniform(*SCALES)
        # A weighted draw without replacement: the smallest of exponential variables (Efraimidis and Spirakis 2006).
        turn = rng.exponential(size=PATCH_SIZE)
        turn[: int(NEAR_SHARE * PATCH_SIZE)] /= NEAR_WEIGHT
        inside = inside[np.argsort(turn)]
        return (noisy[inside] - origin) @ transform, (clean[inside] - origin) @ transform, np.array(time)
