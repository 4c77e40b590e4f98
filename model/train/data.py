"""Training patches: clean and noisy versions of the same points, cut as the filter will cut them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from straightpcf.model.normalize import CloudFrame, patch_scales, zoom_of
from straightpcf.model.normals import recompute_normals
from straightpcf.model.patches import PATCH_SIZE
from straightpcf.model.train.archive import opened, read_array, split_name
from straightpcf.points.errors import InvalidOptions, MalformedFile

__all__ = [
    "ALONG_BEAMS",
    "AROUND",
    "CANDIDATES",
    "EARLIEST",
    "FIRST_NOISE",
    "FIRST_PASSES",
    "HEAVY_TAILED",
    "NEAR_SHARE",
    "NEAR_WEIGHT",
    "NOISE_STD",
    "ONE_WAY",
    "OTHER_NOISE",
    "PASSED",
    "REACH",
    "SCALES",
    "STRETCH",
    "TAILLESS",
    "TAILS",
    "TOUCH_UNTIL",
    "UNEQUAL",
    "VALIDATION_EVERY",
    "Batch",
    "Patch",
    "PatchSource",
    "Surface",
    "along_beams",
    "drawn_noise",
    "gathered",
    "held_out_shapes",
    "near_first",
    "reach_of",
]

NOISE_STD = 0.02  # of x_0, in the frame in which the network sees a patch
EARLIEST = -0.5  # paths are taken up at times from here to 1: x_t has noise from 3 % down
SCALES = (0.8, 1.2)  # augmentation
# The share of patches shown as the first pass of the filter shows them: with noise of 0 to 3 % of the cloud's radius,
# in the size that goes with it (`zoom_of`). The others are shown as later passes see them, with t in [0, 1).
FIRST_PASSES = 0.5
# The share of patches that are of clouds after passes (`passed`), where there are such, at the cost of the others.
PASSED = 0.25
# Somewhat smaller than the filter shows them: training with more noise than this loses thin walls (docs/training.md).
_SHOWN_NOISE, _SMALLEST_ZOOM = 0.027, 0.9
# The share of patches whose noise is not the paper's. Of these, some have no tails (uniform in a ball), and of the
# others some are heavy-tailed: each point's variance is drawn from a gamma distribution of mean 1 (shape 1 makes a
# multivariate Laplace distribution, less makes heavier tails). And some have unequal axes: their stds are lognormal.
OTHER_NOISE = 0.32
TAILLESS = 0.25
HEAVY_TAILED, TAILS = 0.7, (0.6, 2.0)
UNEQUAL, STRETCH = 0.4, 0.4
# Others of them have it along one direction only, as depth cameras and scanners do that see a flat piece.
ONE_WAY = 0.15
# Of a cloud that came along beams (`eye`), that share of the patches has noise along them only.
ALONG_BEAMS = 0.7
# The noise of clouds that first passes see, in radii of the bounding sphere.
FIRST_NOISE = 0.03 * (np.arange(60) + 0.5) / 60
_RADII = 200  # patches of a cloud that are measured
# Every tenth shape by name stays out of training, so that there is something honest to choose by.
VALIDATION_EVERY = 10
# Noise moves points in and out of a patch: the noisy patch is chosen among this many clean neighbours. Of a patch of
# the filter at 50K points and 3 %, 2600 lack 1.2 % (at most 12 %), 4000 lack 0.2 % (2 %).
CANDIDATES = 4000
# The filter keeps of a patch what lies near its seed (a third, at 3-fold coverage): of the points that come first in a
# batch, and so into the loss, nine of ten are of the nearer half.
NEAR_SHARE, NEAR_WEIGHT = 0.5, 9.0
# Of the surface around a patch that many points are kept, of the share that a patch has and half as much more.
AROUND, REACH = 6000, 1.5
# Until then what is across the surface is aimed at the surface itself; later it is known no better than the points are.
TOUCH_UNTIL = 0.98

Patch = tuple[npt.NDArray[np.float64], ...]  # what a `Batch` has of one


@dataclass(frozen=True)
class Batch:
    """B patches, in the frame of the seed's noisy position at time t, points near the seed likely to come first.

    noisy: (B, P, 3) float32 x_0, clean: (B, P, 3) float32 y, time: (B, 1, 1) float32 in [EARLIEST, 1). Across the
    surface y is on the plane that touches it where x_t is nearest (`Surface.touching`), and x_0 on the line from there
    through x_t. drawn: (B, P, 3) float32, y before that, the clean points themselves; surface, normals: (B, M, 3)
    float32, points of the surface around the patch and their unit normals: for y where another place than x_t counts
    (`touching`). passed: (B, 1, 1) float32, 1 for a patch of a cloud after passes, of which x_t is what is known, and
    where it is to go only across the surface.
    """

    noisy: torch.Tensor
    clean: torch.Tensor
    time: torch.Tensor
    drawn: torch.Tensor
    surface: torch.Tensor
    normals: torch.Tensor
    passed: torch.Tensor

    @classmethod
    def joined(cls, first: Batch, second: Batch) -> Batch:
        """Return the patches of both, those of the first before."""
        return cls(*map(torch.cat, zip(first._tensors(), second._tensors(), strict=True)))

    def at(self, time: torch.Tensor) -> torch.Tensor:
        """Return x_t = (1 - t) x_0 + t y, (B, P, 3)."""
        return torch.lerp(self.noisy, self.clean, time)

    def to(self, device: torch.device) -> Batch:
        """Return the same batch on another device."""
        return Batch(*(tensor.to(device) for tensor in self._tensors()))

    def split(self, parts: int) -> list[Batch]:
        """Return the same patches in batches, at most `parts` of them."""
        return [Batch(*some) for some in zip(*(tensor.chunk(parts) for tensor in self._tensors()), strict=True)]

    def touching(self, here: torch.Tensor) -> torch.Tensor:
        """Do for the first R points of each patch, here (B, R, 3), what `Surface.touching` does."""
        pairs = [(here, self.surface)]
        if here.device.type == "cpu":  # one patch's distances fit the cache, a batch's do not
            pairs = list(zip(here.chunk(len(here)), self.surface.chunk(len(here)), strict=True))
        near = torch.cat([torch.cdist(*pair).argmin(dim=2) for pair in pairs])
        foot, normal = gathered(self.surface, near), gathered(self.normals, near)
        clean = self.drawn[:, : here.shape[1]]
        return clean + ((foot - clean) * normal).sum(dim=2, keepdim=True) * normal

    def _tensors(self) -> tuple[torch.Tensor, ...]:
        return self.noisy, self.clean, self.time, self.drawn, self.surface, self.normals, self.passed


@dataclass(frozen=True)
class Surface:
    """A cloud dense enough to stand for its surface: points xyz (M, 3), their unit normals (M, 3), float64."""

    xyz: npt.NDArray[np.float64]
    normals: npt.NDArray[np.float64]

    @classmethod
    def of(
        cls,
        clouds: Iterable[npt.NDArray[np.float32]],
        normals: npt.NDArray[np.float32] | None,
        surface: npt.NDArray[np.float32] | None,
    ) -> Surface:
        """Take a shape's `surface`, or else its cloud of most points; with normals that are known, or computed."""
        finest = (max(clouds, key=len) if surface is None else surface).astype(np.float64)
        return cls(finest, recompute_normals(finest, 0 * finest) if normals is None else normals.astype(np.float64))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.xyz)

    def around(
        self, seed: npt.NDArray[np.float64], share: float
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return AROUND points and their normals of that share of the surface that is nearest to the seed (3,)."""
        reach = reach_of(share, len(self.xyz))
        _, near = self._tree.query(seed, k=reach)
        near = near[np.linspace(0, reach - 1, AROUND).astype(np.int64)]
        return self.xyz[near], self.normals[near]

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


def reach_of(share: float, count: int) -> int:
    """Return how many of a surface's points, those nearest to a seed, are that share of it or fill a batch."""
    return min(count, max(AROUND, round(share * count)))


def held_out_shapes(names: Iterable[str]) -> set[str]:
    """Choose the validation shapes among keys `<shape>/<resolution>`: every tenth by name."""
    shapes = sorted({name.split("/")[0] for name in names})
    return set(shapes[VALIDATION_EVERY // 2 :: VALIDATION_EVERY])


class PatchMaker(Protocol):
    """Draw patches of a kind of its own."""

    def patch(self, rng: np.random.Generator) -> Patch:
        """Draw one; all randomness comes from `rng`."""


class PatchSource:
    """Draw patches from clean clouds, each in the frame where its bounding sphere has radius 1."""

    def __init__(
        self,
        shapes: list[list[npt.NDArray[np.float32]]],
        normals: Sequence[npt.NDArray[np.float32] | None] | None = None,
        surfaces: Sequence[npt.NDArray[np.float32] | None] | None = None,
        eyes: Sequence[npt.NDArray[np.float32] | None] | None = None,
    ) -> None:
        """Take the clouds of each shape, in one frame; the one of most points is taken for its surface.

        surfaces: another cloud of each shape to be taken for that, (M, 3), or None; normals: those of the clouds that
        are, (M, 3); None where they are to be computed. eyes: the place (3,) that the beams came from which met the
        points of a shape, or None where there were no beams.
        """
        if not shapes:
            raise InvalidOptions("no training cloud is left after the validation shapes are taken out")
        self.clouds: list[npt.NDArray[np.float64]] = []
        self.surfaces: list[Surface] = []
        self.eyes: list[npt.NDArray[np.float64] | None] = []
        self.by_name: dict[tuple[Path, str], Surface] = {}  # of shapes that were read, in their own coordinates
        self._own: list[Surface] = []
        unknown = [None] * len(shapes)
        # Trees, lookups and eigenvectors hold no lock.
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            self._own.extend(pool.map(Surface.of, shapes, normals or unknown, surfaces or unknown))
            for shape, own, eye in zip(shapes, self._own, eyes or unknown, strict=True):
                for cloud in shape:
                    wide = cloud.astype(np.float64)
                    frame = CloudFrame.of(wide)
                    self.clouds.append(frame.enter(wide))
                    self.surfaces.append(Surface(frame.enter(own.xyz), own.normals))
                    self.eyes.append(None if eye is None else frame.enter(eye.astype(np.float64)))
            self.passed: PatchMaker | None = None  # draws patches of clouds after passes
            self._trees = list(pool.map(cKDTree, self.clouds))
            self.zooms = np.stack(list(pool.map(self._zooms, self.clouds, self._trees)))

    @staticmethod
    def _zooms(cloud: npt.NDArray[np.float64], tree: cKDTree) -> npt.NDArray[np.float64]:
        """Return the zoom of a first pass over a cloud (N, 3) for each of `FIRST_NOISE`."""
        some = cloud[:: max(1, len(cloud) // _RADII)]
        radii = tree.query(some, k=[min(PATCH_SIZE, len(cloud))])[0][:, 0]
        return np.array([zoom_of(std, radii, shown=_SHOWN_NOISE, smallest=_SMALLEST_ZOOM) for std in FIRST_NOISE])

    @classmethod
    def read(cls, *paths: Path, validation: bool = False) -> PatchSource:
        """Read the training shapes of .npz files, or the held-out ones, of each file every tenth.

        Clean clouds (N, 3) are named `<shape>/<resolution>`; with them may be `<shape>/surface`, a finer one from which
        nothing is drawn, `<shape>/normals`, the unit normals of the one of most points, and `<shape>/eye`, (3,), where
        the beams came from that met the points. Raises MalformedFile, TooFewPoints of a cloud smaller than a patch, and
        InvalidOptions where no shape is left to train on, or to validate with.
        """
        shapes: dict[tuple[Path, str], list[npt.NDArray[np.float32]]] = {}
        beside: dict[str, dict[tuple[Path, str], npt.NDArray[np.float32]]] = {"normals": {}, "surface": {}, "eye": {}}
        for path in paths:
            with opened(path) as archive:
                held_out = held_out_shapes(archive.files)
                for name in archive.files:
                    shape, what = split_name(name, path)
                    if (shape in held_out) != validation:
                        continue
                    if what in beside:
                        beside[what][path, shape] = read_array(archive, name, path)
                    else:
                        shapes.setdefault((path, shape), []).append(read_array(archive, name, path))
        if validation and not shapes:
            least = VALIDATION_EVERY // 2 + 1
            raise InvalidOptions(
                f"no shape of {', '.join(map(str, paths))} is held out to validate with; an archive of {least} has one"
            )
        for (path, shape), normals in beside["normals"].items():
            clouds = shapes.get((path, shape), [])
            finest = beside["surface"].get((path, shape), max(clouds, key=len, default=normals))
            if len(normals) != len(finest):
                raise MalformedFile(f"{path}: {shape}/normals has {len(normals)} rows for {len(finest)} points")
        source = cls(list(shapes.values()), *([known.get(key) for key in shapes] for known in beside.values()))
        source.by_name = dict(zip(shapes, source._own, strict=True))
        return source

    def draw(self, rng: np.random.Generator, batch_size: int, *, augment: bool = True) -> Batch:
        """Draw a batch; all randomness comes from `rng`."""
        patches = []
        for _ in range(batch_size):
            if augment and self.passed is not None and rng.random() < PASSED:
                patches.append(self.passed.patch(rng))
            else:
                patches.append(self._patch(rng, augment=augment))
        return Batch(*(torch.from_numpy(np.stack(part).astype(np.float32)) for part in zip(*patches, strict=True)))

    def _patch(self, rng: np.random.Generator, *, augment: bool) -> Patch:
        which = int(rng.integers(len(self.clouds)))
        cloud, tree = self.clouds[which], self._trees[which]
        seed = cloud[rng.integers(len(cloud))]
        reach, near = tree.query(seed, k=min(CANDIDATES, len(cloud)))
        clean = cloud[near]  # row 0 is the seed
        scale, zoom, noise = rng.uniform(*SCALES) if augment else 1.0, 1.0, None
        if rng.random() < (FIRST_PASSES if self.passed is None else FIRST_PASSES / (1 - PASSED)):
            level = rng.integers(len(FIRST_NOISE))
            zoom, noise = self.zooms[which, level], FIRST_NOISE[level]
        scale *= patch_scales(reach[PATCH_SIZE - 1 : PATCH_SIZE], scene=False, zoom=zoom)[0]
        time = rng.uniform(0, 1) if noise is None else max(EARLIEST, 1 - scale * noise / NOISE_STD)
        here = clean + (1 - time) * NOISE_STD / scale * drawn_noise(rng, clean, self.eyes[which])
        origin = here[0]
        # Cut at x_t, as the filter cuts: a patch cut at x_0 has a rim as ragged as that noise, which tells the time.
        distance = np.square(here - origin).sum(axis=1)
        inside = np.argsort(distance)[:PATCH_SIZE]
        transform = scale * (Rotation.random(random_state=rng).as_matrix() if augment else np.eye(3))
        inside = inside[near_first(rng)]
        here, clean = here[inside], clean[inside]
        drawn = clean
        surface, normals = self.surfaces[which].around(seed, REACH * PATCH_SIZE / len(cloud))
        if time < TOUCH_UNTIL:
            clean = self.surfaces[which].touching(here, clean)
        noisy = (here - time * clean) / (1 - time)
        placed = [(points - origin) @ transform for points in (noisy, clean, drawn, surface)]
        when, passed = np.array([[time]]), np.array([[0.0]])
        return placed[0], placed[1], when, placed[2], placed[3], normals @ transform / scale, passed


def near_first(rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Draw an order, (PATCH_SIZE,), of points that are sorted by distance: the nearer half is likely to come first."""
    # A weighted draw without replacement: the smallest of exponential variables (Efraimidis and Spirakis 2006).
    turn = rng.exponential(size=PATCH_SIZE)
    turn[: int(NEAR_SHARE * PATCH_SIZE)] /= NEAR_WEIGHT
    return np.argsort(turn)


def drawn_noise(
    rng: np.random.Generator, clean: npt.NDArray[np.float64], eye: npt.NDArray[np.float64] | None = None
) -> npt.NDArray[np.float64]:
    """Draw noise of std 1 for points (N, 3) of one patch or cloud: the paper's, or another (`OTHER_NOISE`): (N, 3).

    Where beams from the place `eye` (3,) met the points, of `ALONG_BEAMS` it is along them only.
    """
    noise = _scattered(rng, len(clean))
    if eye is None or rng.random() >= ALONG_BEAMS:
        return noise
    return along_beams(noise[:, :1], clean, eye)


def along_beams(
    noise: npt.NDArray[np.float64], clean: npt.NDArray[np.float64], eye: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return noise (N, 1) as moves, (N, 3), along the beams from the place `eye` (3,) that met points (N, 3)."""
    beams = clean - eye
    length = np.linalg.norm(beams, axis=1, keepdims=True)
    # A scan's "nothing was met" often lies in the eye itself, and has no beam.
    along: npt.NDArray[np.float64] = noise * beams / np.where(length > 0, length, 1.0)
    return along


def _scattered(rng: np.random.Generator, count: int) -> npt.NDArray[np.float64]:
    noise = rng.standard_normal((count, 3))
    if rng.random() >= OTHER_NOISE:
        return noise
    if rng.random() < ONE_WAY:
        direction = rng.standard_normal(3)
        one_way: npt.NDArray[np.float64] = np.sqrt(3) * noise[:, :1] * direction / np.linalg.norm(direction)
        return one_way
    if rng.random() < TAILLESS:
        # A ball of radius 1 has a variance of 1 / 5 along each axis.
        noise *= np.sqrt(5) * rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(noise, axis=1, keepdims=True)
    elif rng.random() < HEAVY_TAILED:
        shape = rng.uniform(*TAILS)
        noise *= np.sqrt(rng.gamma(shape, 1 / shape, (count, 1)))
    if rng.random() < UNEQUAL:
        stds = np.exp(STRETCH * rng.standard_normal(3))
        noise = noise * (stds / np.sqrt(np.square(stds).mean())) @ Rotation.random(random_state=rng).as_matrix()
    return noise


def gathered(points: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Return the points (B, P, 3) that lie at rows index (B, n) of their patch: (B, n, 3)."""
    return points.gather(1, index.unsqueeze(2).expand(-1, -1, 3))
