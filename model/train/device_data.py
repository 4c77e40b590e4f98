"""Training patches drawn on the device, in batched operations: the host has nothing to do, so a graph can hold it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from straightpcf.model.normalize import LARGEST_RADIUS, SMALLEST_RADIUS
from straightpcf.model.patches import PATCH_SIZE
from straightpcf.model.train.data import (
    ALONG_BEAMS,
    AROUND,
    CANDIDATES,
    EARLIEST,
    FIRST_NOISE,
    FIRST_PASSES,
    HEAVY_TAILED,
    NEAR_SHARE,
    NEAR_WEIGHT,
    NOISE_STD,
    ONE_WAY,
    OTHER_NOISE,
    PASSED,
    REACH,
    SCALES,
    STRETCH,
    TAILLESS,
    TAILS,
    TOUCH_UNTIL,
    UNEQUAL,
    Batch,
    PatchSource,
    Surface,
    gathered,
    reach_of,
)
from straightpcf.model.train.passed import SHORTEST, PassedClouds

__all__ = ["DevicePatchSource", "random_rotations"]


class DevicePatchSource:
    """Draw what `PatchSource` draws, with the device's default generator.

    Clouds of different size share one (C, N, 3) tensor; the places that a cloud does not fill are infinitely far.
    A draw costs B N distances and as many to the surfaces, which a GPU does not notice and a CPU does: there, use
    `PatchSource`.
    """

    def __init__(self, source: PatchSource, device: torch.device) -> None:
        self._counts = torch.tensor([len(cloud) for cloud in source.clouds], device=device)
        self._candidates = min(CANDIDATES, max(map(len, source.clouds)))
        self._clouds = _padded(source.clouds, device)
        self._noise = torch.from_numpy(FIRST_NOISE).float().to(device)
        self._zooms = torch.from_numpy(source.zooms).float().to(device)
        # Clouds of no beams have an eye that is not a number, and so no beams.
        eyes = [np.full(3, np.nan) if eye is None else eye for eye in source.eyes]
        self._eyes = torch.from_numpy(np.stack(eyes)).float().to(device)[:, None]
        self._surfaces = _Surfaces(source.surfaces, range(len(source.clouds)), source.clouds, device)
        self._passed = _Passed(source.passed, device) if isinstance(source.passed, PassedClouds) else None

    def draw(self, batch_size: int) -> Batch:
        """Draw an augmented batch of `batch_size` patches; of clouds after passes, if any, are `PASSED` of them."""
        after = round(PASSED * batch_size) if self._passed is not None else 0
        if self._passed is None or not after:
            return self._noisy(batch_size, FIRST_PASSES)
        return Batch.joined(self._noisy(batch_size - after, FIRST_PASSES / (1 - PASSED)), self._passed.draw(after))

    def _noisy(self, batch_size: int, first_passes: float) -> Batch:
        """Draw patches of clouds with drawn noise, that share of them as first passes show them."""
        device = self._clouds.device
        which = torch.randint(len(self._clouds), (batch_size,), device=device)
        seeds = (torch.rand(batch_size, device=device) * self._counts[which]).long()
        clouds = self._clouds[which]  # (B, N, 3)
        seed = gathered(clouds, seeds[:, None])
        clean = gathered(clouds, _nearest(clouds, seed, self._candidates))  # the seed first
        time, scale = self._shown(which, first_passes, (clean[:, PATCH_SIZE - 1] - seed[:, 0]).norm(dim=1))
        noise = NOISE_STD / scale * _noise(clean, self._eyes[which])
        noisy, here = clean + noise, clean + (1 - time) * noise  # infinitely far where the cloud has no more points
        origin = here[:, :1]
        inside = _near_first(_nearest(here, origin, PATCH_SIZE))  # cut at x_t, as PatchSource does
        noisy, here, clean = (gathered(part, inside) for part in (noisy, here, clean))
        surface, normals = self._surfaces.around(which, seed)
        turn = random_rotations(batch_size, device)
        noisy, here, clean, surface = ((part - origin) @ turn * scale for part in (noisy, here, clean, surface))
        batch = Batch(noisy, clean, time, clean, surface, normals @ turn, torch.zeros_like(time))
        early = time < TOUCH_UNTIL
        touched = torch.where(early, batch.touching(here), clean)
        # Late in time x_0 stays as drawn: float32 cannot find it again from x_t.
        noisy = torch.where(early, torch.lerp(touched, here, 1 / (1 - time)), noisy)
        return replace(batch, noisy=noisy, clean=touched)

    def _shown(
        self, which: torch.Tensor, first_passes: float, radii: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw the times and sizes, (B, 1, 1), in which patches of radii (B,) of the clouds `which` (B,) are shown."""
        first, time, scale = torch.rand(3, len(which), device=which.device)
        scale = SCALES[0] + (SCALES[1] - SCALES[0]) * scale
        level = torch.randint(len(self._noise), which.shape, device=which.device)
        early = first < first_passes
        scale = scale * _patch_scales(radii, torch.where(early, self._zooms[which, level], 1.0))
        time = torch.where(early, (1 - scale * self._noise[level] / NOISE_STD).clamp(min=EARLIEST), time)
        return time.view(-1, 1, 1), scale.view(-1, 1, 1)


class _Passed:
    """Draw what `PassedClouds.patch` draws; the surfaces are those of the shapes, the seeds are brought to them."""

    def __init__(self, passed: PassedClouds, device: torch.device) -> None:
        clouds = passed.clouds
        self._distance: Callable[[torch.Tensor], torch.Tensor] = passed.distance
        self._counts = torch.tensor([len(cloud.xyz) for cloud in clouds], device=device)
        self._clouds = _padded([cloud.xyz for cloud in clouds], device)
        self._centres = torch.from_numpy(np.stack([cloud.frame.centre for cloud in clouds])).float().to(device)
        self._radii = torch.tensor([cloud.frame.radius for cloud in clouds], dtype=torch.float32, device=device)
        shapes = list({id(cloud.surface): cloud.surface for cloud in clouds}.values())
        number = {id(surface): n for n, surface in enumerate(shapes)}
        self._surfaces = _Surfaces(
            shapes, [number[id(cloud.surface)] for cloud in clouds], [c.xyz for c in clouds], device
        )

    def draw(self, batch_size: int) -> Batch:
        device = self._clouds.device
        which = torch.randint(len(self._clouds), (batch_size,), device=device)
        seeds = (torch.rand(batch_size, device=device) * self._counts[which]).long()
        clouds = self._clouds[which]
        origin = gathered(clouds, seeds[:, None])
        inside = _near_first(_nearest(clouds, origin, PATCH_SIZE))
        scale = SCALES[0] + (SCALES[1] - SCALES[0]) * torch.rand(batch_size, 1, 1, device=device)
        around = gathered(clouds, inside) - origin
        radii = around.norm(dim=2).amax(dim=1)
        scale = scale * _patch_scales(radii, torch.ones_like(radii)).view(-1, 1, 1)
        turn = random_rotations(batch_size, device)
        here = around @ turn * scale
        with torch.no_grad():
            time = 1 - self._distance(here).view(-1, 1, 1).clamp(min=SHORTEST)
        centre, radius = self._centres[which, None], self._radii[which, None, None]
        surface, normals = self._surfaces.around(which, origin * radius + centre)
        surface = ((surface - centre) / radius - origin) @ turn * scale
        batch = Batch(here, here, time, here, surface, normals @ turn, torch.ones_like(time))
        clean = batch.touching(here)
        return replace(batch, noisy=torch.lerp(clean, here, 1 / (1 - time)), clean=clean)


class _Surfaces:
    """The surfaces of clouds, of which some may share one: cloud n lies on number[n] of `surfaces`."""

    def __init__(
        self,
        surfaces: Sequence[Surface],
        number: Sequence[int],
        clouds: Sequence[npt.NDArray[np.float64]],
        device: torch.device,
    ) -> None:
        self._number = torch.tensor(number, device=device)
        self._xyz = _repeated([surface.xyz for surface in surfaces], device)
        self._normals = _repeated([surface.normals for surface in surfaces], device)
        pairs = zip(number, clouds, strict=True)
        reach = [reach_of(REACH * PATCH_SIZE / len(cloud), len(surfaces[n].xyz)) for n, cloud in pairs]
        self._reach, self._farthest = torch.tensor(reach, device=device), max(reach)

    def around(self, which: torch.Tensor, seeds: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Do for seeds (B, 1, 3) on the clouds numbered `which` (B,) what `Surface.around` does."""
        surface, normals = self._xyz[self._number[which]], self._normals[self._number[which]]
        near = _nearest(surface, seeds, self._farthest)
        places = torch.linspace(0, 1, AROUND, device=near.device) * (self._reach[which, None] - 1)
        near = near.gather(1, places.long())
        return gathered(surface, near), gathered(normals, near)


def _patch_scales(radii: torch.Tensor, zoom: torch.Tensor) -> torch.Tensor:
    """Do for objects' patches of radii (B,), shown `zoom` (B,) times their size, what `patch_scales` does: (B,)."""
    wanted = torch.minimum((zoom * radii).clamp(min=SMALLEST_RADIUS), zoom.clamp(min=1.0) * LARGEST_RADIUS)
    return wanted / radii


def _nearest(points: torch.Tensor, seeds: torch.Tensor, count: int) -> torch.Tensor:
    """Return which of points (B, N, 3) are the `count` nearest to seeds (B, 1, 3), the nearest first: (B, count)."""
    return (points - seeds).square().sum(dim=2).topk(count, dim=1, largest=False).indices


def _near_first(inside: torch.Tensor) -> torch.Tensor:
    """Order points sorted by distance, (B, PATCH_SIZE), as `near_first` does."""
    turn = torch.empty(inside.shape, device=inside.device).exponential_()
    turn[:, : int(NEAR_SHARE * PATCH_SIZE)] /= NEAR_WEIGHT
    return inside.gather(1, turn.argsort(dim=1))


def _noise(clean: torch.Tensor, eyes: torch.Tensor) -> torch.Tensor:
    """Draw noise of std 1 for points (B, n, 3), of the kinds that `drawn_noise` draws, a kind for each patch.

    eyes: (B, 1, 3), where beams came from, not a number where there were none.
    """
    batch_size, count, _ = clean.shape
    device = clean.device
    noise = torch.randn(batch_size, count, 3, device=device)
    other, one_way, tailless, heavy, unequal, shape, along = torch.rand(7, batch_size, 1, 1, device=device)
    shape = TAILS[0] + (TAILS[1] - TAILS[0]) * shape
    variance = torch._standard_gamma(shape.expand(-1, count, -1)) / shape
    # A ball of radius 1 has a variance of 1 / 5 along each axis.
    radius = math.sqrt(5) * torch.rand(batch_size, count, 1, device=device).pow(1 / 3)
    ball = radius * torch.nn.functional.normalize(noise, dim=2)
    tailed = torch.where(heavy < HEAVY_TAILED, noise * variance.sqrt(), noise)
    noise = torch.where(other < OTHER_NOISE, torch.where(tailless < TAILLESS, ball, tailed), noise)
    stds = (STRETCH * torch.randn(batch_size, 1, 3, device=device)).exp()
    stretched = noise * stds / stds.square().mean(dim=2, keepdim=True).sqrt() @ random_rotations(batch_size, device)
    noise = torch.where((other < OTHER_NOISE) & (unequal < UNEQUAL), stretched, noise)
    direction = torch.nn.functional.normalize(torch.randn(batch_size, 1, 3, device=device), dim=2)
    straight = math.sqrt(3) * torch.randn(batch_size, count, 1, device=device) * direction
    noise = torch.where((other < OTHER_NOISE) & (one_way < ONE_WAY), straight, noise)
    beams = torch.nn.functional.normalize(clean - eyes, dim=2)
    return torch.where((along < ALONG_BEAMS) & beams.isfinite(), noise[:, :, :1] * beams, noise)


def random_rotations(count: int, device: torch.device) -> torch.Tensor:
    """Return (count, 3, 3) rotations, uniform: normalised normal quaternions are (Shoemake 1992)."""
    w, x, y, z = torch.nn.functional.normalize(torch.randn(count, 4, device=device), dim=1).unbind(dim=1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).view(count, 3, 3)


def _padded(clouds: list[npt.NDArray[np.float64]], device: torch.device) -> torch.Tensor:
    out = torch.full((len(clouds), max(map(len, clouds)), 3), torch.inf, dtype=torch.float32, device=device)
    for padded, cloud in zip(out, clouds, strict=True):
        padded[: len(cloud)] = torch.from_numpy(cloud).to(padded)
    return out


def _repeated(clouds: list[npt.NDArray[np.float64]], device: torch.device) -> torch.Tensor:
    """Stack clouds, those of fewer points filled up with their own from the first on."""
    count = max(map(len, clouds))
    stacked = np.stack([np.resize(cloud, (count, 3)) for cloud in clouds])
    return torch.from_numpy(stacked.astype(np.float32)).to(device)
