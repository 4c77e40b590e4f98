"""What overlapping patches say of a point in a pass's first evaluation, and what they agree on."""

from __future__ import annotations

import torch

__all__ = ["Agreement"]

# Near its rim a patch lacks neighbours: what it says of a point counts by a power of how near to the seed that is, from
# 1 there to the least at the rim.
_SHARPNESS, _LEAST_NEARNESS = 2.0, 1e-3
_LEAST_DISTANCE = 1e-6  # bounds a division; the step that comes of it is as small
# Sums are of integers, so that the order in which patches come, and on a device threads, changes nothing.
_STEPS = 2.0**40  # of the unit ball's radius


class Agreement:
    """A mean over the patches that a point is in, for the points of M patches of P.

    A patch's first evaluation is made for all of its points, so each point has a velocity from every patch that it is
    in, of which only the owner's was used. What differs between them is the network's error, and the mean has less.
    """

    def __init__(self, count: int, index: torch.Tensor, scales: torch.Tensor, radii: torch.Tensor) -> None:
        """Take of a cloud of `count` points the rows in each patch, index (M, P), in what size it is shown, its radius.

        scales, radii: (M,). What is summed is where these are.
        """
        within = torch.zeros(count, dtype=torch.bool, device=index.device)
        within[index.flatten()] = True
        self._index, self._place = index, within.cumsum(0, dtype=torch.int32) - 1
        self._sums = torch.zeros(min(count, index.numel()), 4, dtype=torch.int64, device=index.device)
        self._scales, self._reach = scales[:, None, None], (scales * radii)[:, None]

    def add(self, patches: slice, x: torch.Tensor, velocities: torch.Tensor, distance: torch.Tensor) -> None:
        """Hear some of the patches: x, as they are shown, and velocities, both (B, P, 3), and d (B, 1)."""
        self.add_weighed(*self.weighed(patches, x, velocities, distance))

    def weighed(
        self, patches: slice, x: torch.Tensor, velocities: torch.Tensor, distance: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return what `add_weighed` takes, of what `add` takes; on any thread."""
        from_seed = torch.linalg.vector_norm(x.double(), dim=2) / self._reach[patches]
        weight = (1 - from_seed.nan_to_num()).clamp(min=_LEAST_NEARNESS).pow(_SHARPNESS)[:, :, None]
        steps = _bounded(distance) * velocities / self._scales[patches]
        said = torch.cat([weight * steps, weight], dim=2)
        return self._places(patches).flatten(), (_STEPS * said).round().long().flatten(0, 1)

    def add_weighed(self, places: torch.Tensor, said: torch.Tensor) -> None:
        """Add what was heard; on one thread at a time."""
        self._sums.index_add_(0, places, said)

    def velocities(self, patches: slice | torch.Tensor, distance: torch.Tensor) -> torch.Tensor:
        """Return what is agreed on for some patches, as velocities (B, P, 3) float32 that their d (B, 1) scales."""
        sums = self._sums[self._places(patches)].double()
        steps = sums[:, :, :3] / sums[:, :, 3:]
        return (steps * self._scales[patches] / _bounded(distance)).float()

    def _places(self, patches: slice | torch.Tensor) -> torch.Tensor:
        return self._place[self._index[patches].long()].long()


def _bounded(distance: torch.Tensor) -> torch.Tensor:
    return distance.clamp(min=_LEAST_DISTANCE)[:, :, None]
