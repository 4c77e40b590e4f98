"""Training patches drawn on the device, in batched operations: the host has nothing to do, so a graph can hold it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from straightpcf.model.train.data import (
    AROUND,
    CANDIDATES,
    EARLIEST,
    FIRST_NOISE,
    FIRST_PASSES,
    HEAVY_TAILED,
    NEAR_SHARE,
    NEAR_WEIGHT,
    NOISE_STD,
    OTHER_NOISE,
    PATCH_SIZE,
    REACH,
    SCALES,
    STRETCH,
    TAILS,
    TOUCH_UNTIL,
    UNEQUAL,
    Batch,
    PatchSource,
    gathered,
    reach_of,
)

__all__ = ["DevicePatchSource", "random_rotations"]


class DevicePatchSource:
    """Draw what `PatchSource` draws, with the device's default generator.

    Clouds of different size share one (C, N, 3) tensor; the places that a cloud does not fill are infinitely far.
    A draw costs B N distances and as many to the surfaces, which a GPU does not notice and a CPU does: there, use
    `PatchSource`.
    """

    def __init__(self, source: PatchSource, device: torch.device) -> None:
        self._counts = torch.tensor([len(cloud) for cloud in source.clouds], device=device)
        self._candidates = min([CANDIDATES, *map(len, source.clouds)])
        self._clouds = _padded(source.clouds, device)
        self._noise = torch.from_numpy(FIRST_NOISE).float().to(device)
        self._zooms = torch.from_numpy(source.zooms).float().to(device)
        self._surfaces = _repeated([surface.xyz for surface in source.surfaces], device)
        self._normals = _repeated([surface.normals for surface in source.surfaces], device)
        pairs = zip(source.clouds, source.surfaces, strict=True)
        reach = [reach_of(REACH * PATCH_SIZE / len(cloud), len(surface.xyz)) for cloud, surface in pairs]
        self._reach, self._farthest = torch.tensor(reach, device=device), max(reach)

    def draw(self, batch_size: int) -> Batch:
        """Draw an augmented batch of `batch_size` patches."""
        device = self._clouds.device
        which = torch.randint(len(self._clouds), (batch_size,), device=device)
        seeds = (torch.rand(batch_size, device=device) * self._counts[which]).long()
        clouds = self._clouds[which]  # (B, N, 3)
        squared = (clouds - gathered(clouds, seeds[:, None])).square().sum(dim=2)
        near = squared.topk(self._candidates, dim=1, largest=False).indices  # (B, C), the seed first
        clean = gathered(clouds, near)
        time, scale = self._shown(which)
        noisy = clean + NOISE_STD / scale * _noise(batch_size, clean.shape[1], device)
        here = torch.lerp(noisy, clean, time)
        origin = here[:, :1]
        squared = (here - origin).square().sum(dim=2)  # cut at x_t, as PatchSource does
        inside = squared.topk(PATCH_SIZE, dim=1, largest=False).indices
        turn = torch.empty(batch_size, PATCH_SIZE, device=device).exponential_()
        turn[:, : int(NEAR_SHARE * PATCH_SIZE)] /= NEAR_WEIGHT
        inside = inside.gather(1, turn.argsort(dim=1))
        noisy, here, clean = (gathered(part, inside) for part in (noisy, here, clean))
        surface, normals = self._around(which, gathered(clouds, seeds[:, None]))
        turn = random_rotations(batch_size, device)
        noisy, here, clean, surface = ((part - origin) @ turn * scale for part in (noisy, here, clean, surface))
        batch = Batch(noisy, clean, time, clean, surface, normals @ turn, torch.zeros_like(time))
        early = time < TOUCH_UNTIL
        touched = torch.where(early, batch.touching(here), clean)
        # Late in time x_0 stays as drawn: float32 cannot find it again from x_t.
        noisy = torch.where(early, torch.lerp(touched, here, 1 / (1 - time)), noisy)
        return replace(batch, noisy=noisy, clean=touched)

    def _shown(self, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw the times and sizes, (B, 1, 1), in which patches of the clouds numbered `which` (B,) are shown."""
        first, time, scale = torch.rand(3, len(which), device=which.device)
        scale = SCALES[0] + (SCALES[1] - SCALES[0]) * scale
        level = torch.randint(len(self._noise), which.shape, device=which.device)
        zoomed = scale * self._zooms[which, level]
        early = first < FIRST_PASSES
        time = torch.where(early, (1 - zoomed * self._noise[level] / NOISE_STD).clamp(min=EARLIEST), time)
        return time.view(-1, 1, 1), torch.where(early, zoomed, scale).view(-1, 1, 1)

    def _around(self, which: torch.Tensor, seeds: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Do for seeds (B, 1, 3) on the clouds numbered `which` (B,) what `Surface.around` does."""
        surface, normals = self._surfaces[which], self._normals[which]
        squared = (surface - seeds).square().sum(dim=2)
        near = squared.topk(self._farthest, dim=1, largest=False).indices
        places = torch.linspace(0, 1, AROUND, device=squared.device) * (self._reach[which, None] - 1)
        near = near.gather(1, places.long())
        return gathered(surface, near), gathered(normals, near)


def _noise(batch_size: int, count: int, device: torch.device) -> torch.Tensor:
    """Draw noise of std 1, (B, count, 3), of the kinds that `PatchSource` draws, a kind for each patch."""
    noise = torch.randn(batch_size, count, 3, device=device)
    other, heavy, unequal, shape = torch.rand(4, batch_size, 1, 1, device=device)
    shape = TAILS[0] + (TAILS[1] - TAILS[0]) * shape
    variance = torch._standard_gamma(shape.expand(-1, count, -1)) / shape
    noise = torch.where((other < OTHER_NOISE) & (heavy < HEAVY_TAILED), noise * variance.sqrt(), noise)
    stds = (STRETCH * torch.randn(batch_size, 1, 3, device=device)).exp()
    stretched = noise * stds / stds.square().mean(dim=2, keepdim=True).sqrt() @ random_rotations(batch_size, device)
    return torch.where((other < OTHER_NOISE) & (unequal < UNEQUAL), stretched, noise)


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
