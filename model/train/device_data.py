"""Training patches drawn on the device, in batched operations: the host has nothing to do, so a graph can hold it."""

from __future__ import annotations

import torch

from straightpcf.model.train.data import (
    CANDIDATES,
    NEAR_SHARE,
    NEAR_WEIGHT,
    NOISE_STD,
    PATCH_SIZE,
    SCALES,
    Batch,
    PatchSource,
)

__all__ = ["DevicePatchSource", "random_rotations"]


class DevicePatchSource:
    """Draw what `PatchSource` draws, with the device's default generator.

    Clouds of different size share one (C, N, 3) tensor; the places that a cloud does not fill are infinitely far.
    A draw costs B N distances, which a GPU does not notice and a CPU does: there, use `PatchSource`.
    """

    def __init__(self, source: PatchSource, device: torch.device) -> None:
        self._counts = torch.tensor([len(cloud) for cloud in source.clouds], device=device)
        self._candidates = min([CANDIDATES, *map(len, source.clouds)])
        shape = (len(source.clouds), int(self._counts.max()), 3)
        self._clouds = torch.full(shape, torch.inf, dtype=torch.float32, device=device)
        for padded, cloud in zip(self._clouds, source.clouds, strict=True):
            padded[: len(cloud)] = torch.from_numpy(cloud).to(padded)

    def draw(self, batch_size: int) -> Batch:
        """Draw an augmented batch of `batch_size` patches."""
        device = self._clouds.device
        which = torch.randint(len(self._clouds), (batch_size,), device=device)
        seeds = (torch.rand(batch_size, device=device) * self._counts[which]).long()
        clouds = self._clouds[which]  # (B, N, 3)
        squared = (clouds - clouds.gather(1, _rows(seeds[:, None]))).square().sum(dim=2)
        near = squared.topk(self._candidates, dim=1, largest=False).indices  # (B, C), the seed first
        clean = clouds.gather(1, _rows(near))
        noisy = clean + NOISE_STD * torch.randn_like(clean)
        time = torch.rand(batch_size, 1, 1, device=device)
        here = torch.lerp(noisy, clean, time)
        origin = here[:, :1]
        squared = (here - origin).square().sum(dim=2)  # cut at x_t, as PatchSource does
        inside = squared.topk(PATCH_SIZE, dim=1, largest=False).indices
        turn = torch.empty(batch_size, PATCH_SIZE, device=device).exponential_()
        turn[:, : int(NEAR_SHARE * PATCH_SIZE)] /= NEAR_WEIGHT
        inside = inside.gather(1, turn.argsort(dim=1))
        scale = torch.empty(batch_size, 1, 1, device=device).uniform_(*SCALES)
        transform = random_rotations(batch_size, device) * scale
        return Batch(
            (noisy.gather(1, _rows(inside)) - origin) @ transform,
            (clean.gather(1, _rows(inside)) - origin) @ transform,
            time,
        )


def random_rotations(count: int, device: torch.device) -> torch.Tensor:
    """Return (count, 3, 3) rotations, uniform: normalised normal quaternions are (Shoemake 1992)."""
    w, x, y, z = torch.nn.functional.normalize(torch.randn(count, 4, device=device), dim=1).unbind(dim=1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).view(count, 3, 3)


def _rows(index: torch.Tensor) -> torch.Tensor:
    return index.unsqueeze(2).expand(-1, -1, 3)
