"""The dynamic-graph EdgeConv encoder and the decoder on top of it."""

from __future__ import annotations

from typing import cast

import torch
from torch import nn
from torch.nn.functional import linear

from straightpcf.model.ops import edge_max, knn

__all__ = ["NEIGHBOURS", "Decoder", "EdgeConv", "Encoder"]

NEIGHBOURS = 32  # k of every graph in the paper


class EdgeConv(nn.Module):
    """h_i = max_j MLP([x_i, x_j - x_i]) + Lin(x_i), with a ReLU on both branches if `activation`."""

    def __init__(self, width: int, out_width: int, *, activation: bool = True) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(2 * width, out_width), nn.ReLU(), nn.Linear(out_width, out_width))
        self.lin = nn.Linear(width, out_width)
        self.activation = activation

    def forward(self, x: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
        """Map x (B, P, C) to (B, M, D) for the M points whose neighbours `index` (B, M, k) holds."""
        first, second = cast(nn.Linear, self.mlp[0]), cast(nn.Linear, self.mlp[2])
        rows = x[:, : index.shape[1]]
        # [x_i, x_j - x_i] W = x_i (W_a - W_b) + x_j W_b: the first layer runs per point, not per edge.
        own, other = first.weight[:, : x.shape[2]], first.weight[:, x.shape[2] :]
        a = linear(rows, own - other, first.bias)
        b = linear(x, other)
        edges = edge_max(a, b, index, second.weight) + second.bias
        skip = self.lin(rows)
        return torch.relu(edges) + torch.relu(skip) if self.activation else edges + skip


class Encoder(nn.Module):
    """Three EdgeConv blocks of width D/8, D/4 and D, the graph rebuilt before each one."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = EdgeConv(3, width // 8)
        self.conv2 = EdgeConv(width // 8, width // 4)
        self.conv3 = EdgeConv(width // 8 + width // 4, width, activation=False)

    def forward(self, x: torch.Tensor, rows: int | None = None) -> torch.Tensor:
        """Map positions (B, P, 3) to features (B, rows, D) of the first `rows` points (all if None)."""
        if x.device.type == "cpu" and len(x) > 1:  # one patch's tensors fit the cache, a batch's do not
            return torch.cat([self(patch, rows) for patch in x.split(1)])  # type: ignore[no-untyped-call]
        h1 = self.conv1(x, knn(x, NEIGHBOURS))
        h2 = self.conv2(h1, knn(h1, NEIGHBOURS))
        # Only block 3 can be restricted: its inputs need every point's features.
        return self.conv3(torch.cat([h1, h2], dim=2), knn(h2, NEIGHBOURS, rows))  # type: ignore[no-any-return]


class Decoder(nn.Module):
    """Linear-BatchNorm-ReLU-Dropout twice, then a linear layer; with `pool` a maximum over points before it."""

    def __init__(self, width: int, out_width: int, *, pool: bool = False) -> None:
        super().__init__()
        self.lin_1 = nn.Linear(width, width)
        self.bn_1_out = nn.BatchNorm1d(width)
        self.lin_2 = nn.Linear(width, 64)
        self.bn_2_out = nn.BatchNorm1d(64)
        self.lin_3 = nn.Linear(64, out_width)
        self.dropout = nn.Dropout(0.1)
        self.pool = pool

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Map (B, M, D) to (B, M, out), or to (B, out) with `pool`."""
        h = features.flatten(0, 1)
        h = self.dropout(torch.relu(self.bn_1_out(self.lin_1(h))))
        h = self.dropout(torch.relu(self.bn_2_out(self.lin_2(h))))
        h = h.unflatten(0, features.shape[:2])  # (B, M, 64)
        return self.lin_3(h.amax(dim=1) if self.pool else h)  # type: ignore[no-any-return]
