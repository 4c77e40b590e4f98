"""Rotations in which a patch is shown to the network."""

from __future__ import annotations

import math

import torch

__all__ = ["turns"]

_PSI = 1.533751168755204288118041  # the real root of psi^4 = psi + 4 that the paper gives


def turns(count: int) -> torch.Tensor:
    """Return (count, 3, 3) float32 rotations, spread evenly: a super-Fibonacci spiral (Alexa, CVPR 2022)."""
    matrices = []
    for i in range(count):
        s = i + 0.5
        small, large = math.sqrt(s / count), math.sqrt(1 - s / count)
        alpha, beta = 2 * math.pi * s / math.sqrt(2), 2 * math.pi * s / _PSI
        x, y, z, w = small * math.sin(alpha), small * math.cos(alpha), large * math.sin(beta), large * math.cos(beta)
        matrices.append([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
    return torch.tensor(matrices, dtype=torch.float32)
