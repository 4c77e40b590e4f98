"""The three objectives of the paper, in units of the training noise: 1 is what a network that does nothing gets."""

from __future__ import annotations

import math

import torch

from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.train.data import NOISE_STD, Batch

__all__ = ["LAMBDA_1", "LAMBDA_2", "coupled_loss", "distance_loss", "velocity_loss"]

LAMBDA_1 = 10.0
LAMBDA_2 = 200.0
_TRAJECTORIES = 0.25  # the share of a batch that L_C moves
_UNIT = 3 * NOISE_STD**2  # the mean of |y - x_0|^2


def velocity_loss(network: StraightPCF, batch: Batch, rows: int) -> torch.Tensor:
    """L_A: |v(x_t) - (y - x_0)|^2 over the first `rows` points of each patch (stage 1)."""
    velocity = network.velocity_modules[0](batch.at(batch.time), rows)
    return _squared(velocity - (batch.clean - batch.noisy)[:, :rows])


def coupled_loss(network: StraightPCF, batch: Batch, rows: int) -> torch.Tensor:
    """L_B: every module's velocity, plus lambda_1 times where each but the last leaves the points (stage 2).

    Module k starts where module k - 1 left the points, at time t + k (1 - t) / K; the last module's
    error is taken on the first `rows` points only.
    """
    couplings = len(network.velocity_modules)
    target = batch.clean - batch.noisy
    x = batch.at(batch.time)
    step = (1 - batch.time) / couplings
    loss = x.new_zeros(())
    for k, velocity in enumerate(network.velocity_modules, start=1):
        last = k == couplings
        v = velocity(x, rows if last else None)
        loss = loss + _squared(v - target[:, : v.shape[1]])
        if not last:
            x = x + step * v
            loss = loss + LAMBDA_1 * _squared(x - batch.at(batch.time + k * step))
    return loss


def distance_loss(network: StraightPCF, batch: Batch, rows: int) -> torch.Tensor:
    """L_C: (d - (1 - t))^2 plus lambda_2 |y - X|^2 where d scales the frozen trajectory to X (stage 3).

    The second term is the mean over the first quarter of the batch: of the same expectation, and the trajectory costs
    three times what the DistanceModule does.
    """
    x = batch.at(batch.time)
    distance = network.distance_module(x)[:, :, None]
    loss = (distance - (1 - batch.time)).square().mean()
    some = math.ceil(len(x) * _TRAJECTORIES)
    x, distance, clean = x[:some], distance[:some], batch.clean[:some]
    couplings = len(network.velocity_modules)
    for k, velocity in enumerate(network.velocity_modules, start=1):
        v = velocity(x, rows if k == couplings else None)
        x = x[:, : v.shape[1]] + distance / couplings * v
    return torch.add(loss, LAMBDA_2 * _UNIT * _squared(x - clean[:, : x.shape[1]]))


def _squared(error: torch.Tensor) -> torch.Tensor:
    return error.square().sum(dim=2).mean() / _UNIT
