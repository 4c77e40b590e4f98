"""The three objectives of the paper, errors of velocities and places weighted by what the noise leaves knowable.

Along a surface it can hardly be told where a noisy point came from: two thirds of |v - (y - x_0)|^2 are that noise, and
nearly all of its gradient's variance. So errors are weighted as in generalised least squares (Aitken 1936), by the
inverse of the target's covariance given the clean points around (`precision`).
"""

from __future__ import annotations

import math
from functools import cache

import torch

from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.train.data import NOISE_STD, TOUCH_UNTIL, Batch, gathered
from straightpcf.model.turns import turns

__all__ = ["LAMBDA_1", "LAMBDA_2", "across", "coupled_loss", "distance_loss", "precision", "velocity_loss"]

LAMBDA_1 = 10.0
LAMBDA_2 = 200.0
_TRAJECTORIES = 0.25  # the share of a batch that L_C moves
_UNIT = 3 * NOISE_STD**2  # the mean of |y - x_0|^2
# Spread of the target, in units of the noise at time t, at which an error counts by half.
_KNOWABLE = 1.0
_ALONG = 0.02  # the weight of errors along the surface after a pass: enough that points do not wander
_LATEST = 0.9  # the noise at time t is taken as no less than at this one: float32 covariances bear no less


def velocity_loss(network: StraightPCF, batch: Batch, rows: int) -> torch.Tensor:
    """L_A: |v(x_t) - (y - x_0)|^2 over the first `rows` points of each patch (stage 1)."""
    velocity = network.velocity_modules[0](batch.at(batch.time), rows)
    return _weighted(velocity - (batch.clean - batch.noisy)[:, :rows], precision(batch, rows))


def coupled_loss(network: StraightPCF, batch: Batch, rows: int, euler_steps: int = 1) -> torch.Tensor:
    """L_B: every evaluation's velocity, plus lambda_1 times where it leaves the points (stage 2).

    The K modules take N = euler_steps rounds of shorter and shorter ways along their own path, as the filter runs
    them: evaluation k of N K starts where k - 1 left the points, at time t + (k - 1) s / (N K) for a pass of length
    s = 1 - t, 1 at most, in a position of its own, and all but the first move the first `rows` points only. These are
    led to the surface nearest to where the pass leaves them (`_targets`). The paper has N = 1 and leaves out where the
    last module leaves the points: then it learns to go on straight, also from where the first has gone wrong, and the
    stack ends farther from the surface than two copies of a single module do (docs/training.md).
    """
    evaluations = [velocity for _ in range(euler_steps) for velocity in network.velocity_modules]
    positions = _turns(len(evaluations), batch.noisy.device)
    start = x = batch.at(batch.time)
    step = _to_go(batch) / len(evaluations)
    beyond = torch.zeros_like(x[:, rows:])
    steps: list[tuple[torch.Tensor, torch.Tensor]] = []
    for k, (velocity, turn) in enumerate(zip(evaluations, positions, strict=True), start=1):
        v = velocity(x @ turn, rows if k > 1 else None) @ turn.mT
        if k == 1:
            beyond = v[:, rows:]
        moved = x[:, : v.shape[1]] + step * v
        steps.append((v, moved))
        x = moved if k == 1 else torch.cat([moved, x[:, rows:] + step * beyond], dim=1)
    target = _targets(batch, start, x, steps[-1][0][:, :rows])
    weight = across(batch, start + (1 - batch.time) * target, precision(batch, target.shape[1]))
    loss = x.new_zeros(())
    for k, (v, moved) in enumerate(steps, start=1):
        some = slice(v.shape[1])
        loss = loss + _weighted(v - target[:, some], weight[:, some])
        there = start[:, some] + k * step * target[:, some]
        loss = loss + LAMBDA_1 * _weighted(moved - there, weight[:, some])
    return loss / euler_steps


@torch.no_grad()
def _targets(batch: Batch, start: torch.Tensor, end: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    """Return the velocities (B, P, 3) that lead from x_t, `start`, to the surface.

    For the rows of `velocity`, the last evaluation's, it is the surface nearest to where they are led now: their place
    after the pass, `end`, and on from there for what a path from before t = 0 has left. Of walls that the noise has
    mixed, each is as good as the other; between them is none. For the others it is the surface nearest to x_t.
    """
    rows = velocity.shape[1]
    target = batch.clean - batch.noisy
    left = 1 - batch.time
    there = end[:, :rows] + (left - _to_go(batch)) * velocity
    nearest = (batch.touching(there) - start[:, :rows]) / left
    target[:, :rows] = torch.where(batch.time < TOUCH_UNTIL, nearest, target[:, :rows])
    return target


@torch.no_grad()
def across(batch: Batch, there: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Return the weights (B, P, 3, 3), those of clouds after passes for errors across the surface at `there` only.

    Where along it a point came from is not to be told after a pass: what is left of the noise is no noise.
    """
    if batch.passed.is_cuda:  # a graph has no branches: all are weighed, in one
        parts = [slice(None)]
    else:
        parts = [slice(n, n + 1) for n in batch.passed.flatten().nonzero().flatten().tolist()]
    for part in parts:
        near = torch.cdist(there[part], batch.surface[part]).argmin(dim=2)
        normal = gathered(batch.normals[part], near)
        flat = _ALONG * torch.eye(3, device=normal.device) + (1 - _ALONG) * normal[..., :, None] * normal[..., None, :]
        weight[part] = torch.where(batch.passed[part, ..., None] > 0, flat, weight[part])
    return weight


@torch.no_grad()
def precision(batch: Batch, rows: int) -> torch.Tensor:
    """Weigh the errors of the first `rows` points of each patch: (B, rows, 3, 3), symmetric, eigenvalues in (0, 1].

    s^2 (C + s^2 I)^-1, where C is the covariance of the clean points that x_t may have come from, each as likely as
    the noise at time t makes it, and s is that noise: about 1 across a surface, 1/2 along it, and 1 throughout where
    the noise is smaller than the distance between points. It depends on x_t and the clean points, not on which of
    them is the target: the velocity of least weighted error is still a mean of y - x_0, in which clean clouds that
    tell more of it count for more.
    """
    x = batch.at(batch.time)[:, :rows]
    noise = NOISE_STD * (1 - batch.time).clamp(min=1 - _LATEST)
    parts = [(x, batch.clean, noise)]
    if x.device.type == "cpu":  # one patch's tensors fit the cache, a batch's do not
        parts = list(zip(*(t.chunk(len(x)) for t in (x, batch.clean, noise)), strict=True))
    spread = torch.cat([_covariance(*part) / (_KNOWABLE * part[2]).square() for part in parts])
    return _inverse_of_one_plus(spread)


def distance_loss(network: StraightPCF, batch: Batch, rows: int) -> torch.Tensor:
    """L_C: (d - (1 - t))^2 plus lambda_2 |y - X|^2 where d scales the frozen trajectory to X (stage 3).

    d is 1 at most: where t < 0, so is its target, and y gives way to x_t+1, as far as that leads. The second term is
    the mean over the first quarter of the batch: of the same expectation, and the trajectory costs three times what
    the DistanceModule does.
    """
    x = batch.at(batch.time)
    distance = network.distance_module(x)[:, :, None]
    to_go = _to_go(batch)
    loss = (distance - to_go).square().mean()
    some = math.ceil(len(x) * _TRAJECTORIES)
    x, distance, there = x[:some], distance[:some], batch.at(batch.time + to_go)[:some]
    couplings = len(network.velocity_modules)
    for k, velocity in enumerate(network.velocity_modules, start=1):
        v = velocity(x, rows if k == couplings else None)
        x = x[:, : v.shape[1]] + distance / couplings * v
    return torch.add(loss, LAMBDA_2 * (x - there[:, : x.shape[1]]).square().sum(dim=2).mean())


def _to_go(batch: Batch) -> torch.Tensor:
    return (1 - batch.time).clamp(max=1)  # of the way from x_0 to y, as far as one pass goes: (B, 1, 1)


@cache
def _turns(count: int, device: torch.device) -> torch.Tensor:
    return turns(count).to(device)  # once: a CUDA graph holds no copy from the host


def _covariance(x: torch.Tensor, clean: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """Return the upper triangle, (B, rows, 6), of the covariance of the clean points that x may have come from."""
    scaled = clean / noise.square()
    # -|x - y|^2 / (2 noise^2), less the part that a row has in common
    likely = torch.softmax(x @ scaled.mT - 0.5 * (scaled * clean).sum(dim=2)[:, None], dim=2)  # (B, rows, P)
    first, second = torch.triu_indices(3, 3, device=x.device)
    moments = likely @ torch.cat([clean, clean[:, :, first] * clean[:, :, second]], dim=2)
    mean, square = moments[:, :, :3], moments[:, :, 3:]
    return square - mean[:, :, first] * mean[:, :, second]


def _weighted(error: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    return torch.einsum("bpi,bpij,bpj->bp", error, weight, error).mean() / _UNIT


def _inverse_of_one_plus(spread: torch.Tensor) -> torch.Tensor:
    """Invert I + S for symmetric S given by its upper triangle (..., 6): by cofactors, which a CUDA graph can hold."""
    xx, xy, xz, yy, yz, zz = spread.unbind(dim=-1)
    xx, yy, zz = xx + 1, yy + 1, zz + 1
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * a + xy * b + xz * c
    cofactors = torch.stack([a, b, c, b, d, e, c, e, f], dim=-1)
    return (cofactors / determinant[..., None]).view(*determinant.shape, 3, 3)
