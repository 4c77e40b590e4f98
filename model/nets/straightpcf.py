"""VelocityModule, DistanceModule and their composition, StraightPCF (de Silva Edirimuni et al., CVPR 2024)."""

from __future__ import annotations

import torch
from torch import nn

from straightpcf.model.kernels.fused import fused
from straightpcf.model.nets.edgeconv import NEIGHBOURS, Decoder, Encoder

__all__ = ["DistanceModule", "StraightPCF", "VelocityModule"]

# What patches agree on in the first evaluation differs from what one of them says mostly as its later ones would.
_AGREED_SHARE = 0.5
_PATCHES_PER_RADIUS = 4.0  # the median patch of training has a quarter of its object's radius


class VelocityModule(nn.Module):
    """v(X): the constant velocity that carries a noisy patch to the surface in unit time (section 4.1)."""

    def __init__(self, width: int = 256) -> None:
        super().__init__()
        self.encoder = Encoder(width)
        self.decoder = Decoder(width, 3)

    def forward(self, x: torch.Tensor, rows: int | None = None) -> torch.Tensor:
        """Return (B, rows, 3) velocities of the first `rows` points of each patch x (B, P, 3)."""
        if whole := fused(self, self.encoder, self.decoder, x, NEIGHBOURS):
            return whole(x, rows)
        return self.decoder(self.encoder(x, rows))  # type: ignore[no-any-return]

    def start_slow(self) -> VelocityModule:
        """Shrink the last layer so that training starts from velocities near zero; they are about 0.02."""
        with torch.no_grad():
            self.decoder.lin_3.weight.mul_(0.01)
            self.decoder.lin_3.bias.zero_()
        return self


class DistanceModule(nn.Module):
    """d(X) in (0, 1): how far from the surface a patch is, in units of the training noise (section 4.3).

    The published one sees each patch scaled to unit radius, where the noise is known only relative to the patch and
    patches differ fourfold in radius. This one sees the VelocityModule's frame: the training noise has one size there
    (docs/training.md has the figures of both).
    """

    def __init__(self, width: int = 128) -> None:
        super().__init__()
        self.encoder = Encoder(width)
        self.decoder = Decoder(width, 1, pool=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return (B, 1) distances of patches x (B, P, 3), centred on their seeds."""
        x = x * _PATCHES_PER_RADIUS
        whole = fused(self, self.encoder, self.decoder, x, NEIGHBOURS)
        return torch.sigmoid(whole(x) if whole else self.decoder(self.encoder(x)))


class StraightPCF(nn.Module):
    """K coupled VelocityModules whose trajectory the DistanceModule scales (section 4.2 and 4.3)."""

    def __init__(self, *, couplings: int = 2, width: int = 256, distance_width: int = 128) -> None:
        super().__init__()
        self.velocity_modules = nn.ModuleList(VelocityModule(width) for _ in range(couplings))
        self.distance_module = DistanceModule(distance_width)

    def forward(
        self,
        x: torch.Tensor,
        *,
        euler_steps: int = 3,
        rows: int | None = None,
        owned: torch.Tensor | None = None,
        full_evaluations: int = 1,
        distance: torch.Tensor | None = None,
        turns: torch.Tensor | None = None,
        first: tuple[torch.Tensor, torch.Tensor] | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Move patches x (B, P, 3) along X += d / (N K) v_k(X) for N = euler_steps rounds.

        Returns the moved patches (B, P, 3), or their first `rows` points, for which the last evaluation costs
        less, and their distances d (B, 1), those given or else the DistanceModule's. With `owned`, (B,) at most `rows`,
        only so many points of each patch have a velocity of every evaluation: the others, there as neighbours, keep
        that of the last of the first full_evaluations. The flow is straight (section 4.2), so that hardly changes
        what is seen of them (docs/kernels.md has the figures). turns: (T, 3, 3) rotations, one after the other for the
        evaluations: the network's errors depend on how a patch lies, and those of several positions average out.
        first: the first evaluation's velocities of `rows` points or more, made before (`first_velocities`), and what
        takes their place (B, P, 3): `_AGREED_SHARE` of the difference is added to the `rows` points' later velocities.
        """
        distance = self.distance_module(x) if distance is None else distance
        step = distance[:, :, None] / (euler_steps * len(self.velocity_modules))
        evaluations = [velocity for _ in range(euler_steps) for velocity in self.velocity_modules]
        moving = torch.zeros_like(x)
        inside = None if owned is None else torch.arange(rows or x.shape[1], device=x.device) < owned[:, None]
        differs = None if first is None else _AGREED_SHARE * (first[1][:, :rows] - first[0][:, :rows])

        def velocities(number: int, x: torch.Tensor, rows: int | None) -> torch.Tensor:
            if first is not None and number == 0:
                return first[1][:, :rows]
            turn = None if turns is None else turns[number % len(turns)]
            found = _turned(evaluations[number], x, rows, turn)
            return found if differs is None or rows is None else found + differs

        last = len(evaluations) - 1
        for done in range(last):
            if inside is None or done < full_evaluations:
                moving = velocities(done, x, None)
            else:
                fresh = torch.where(inside[:, :, None], velocities(done, x, rows), moving[:, :rows])
                moving = torch.cat([fresh, moving[:, inside.shape[1] :]], dim=1)
            x = x + step * moving
        return x[:, :rows] + step * velocities(last, x, rows), distance

    def first_velocities(self, x: torch.Tensor, turns: torch.Tensor | None = None) -> torch.Tensor:
        """Return the velocities (B, P, 3) of the first evaluation that `forward` makes of patches x (B, P, 3)."""
        return _turned(self.velocity_modules[0], x, None, None if turns is None else turns[0])


def _turned(module: nn.Module, x: torch.Tensor, rows: int | None, turn: torch.Tensor | None) -> torch.Tensor:
    """Return a module's velocities of the patches in another position, in their own."""
    if turn is None:
        return module(x, rows)  # type: ignore[no-any-return]
    return module(x @ turn, rows) @ turn.mT  # type: ignore[no-any-return]
