"""A whole VelocityModule or DistanceModule on a GPU, for inference: its layers in float16 once, and few launches.

The twin is the modules' own forward. Sums are of float32, as positions and what graphs are taken from; the layers per
point and over edges multiply float16.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import torch
from torch import nn
from torch.nn.functional import linear
from torch.nn.utils.fusion import fuse_linear_bn_weights

from straightpcf.model.kernels import cuda

if TYPE_CHECKING:
    from straightpcf.model.nets.edgeconv import Decoder, EdgeConv, Encoder

__all__ = ["FusedOnDevice", "takes"]


def takes(encoder: Encoder, x: torch.Tensor, neighbours: int) -> bool:
    """Tell whether patches x (B, P, 3) on a GPU, and a network of these widths, are what the kernels are for."""
    widths = [block.lin.out_features for block in (encoder.conv1, encoder.conv2, encoder.conv3)]
    fits = x.shape[1] <= cuda.MOST_POINTS and neighbours <= cuda.MOST_NEIGHBOURS
    return fits and all(width % 16 == 0 for width in widths) and cuda.load()


class FusedOnDevice:
    """The layers of an encoder and its decoder as they are now, each kind joined; widths are multiples of 16."""

    def __init__(self, encoder: Encoder, decoder: Decoder, neighbours: int) -> None:
        self._neighbours, self._pool = neighbours, decoder.pool
        self._first, self._second, self._third = map(_Block, (encoder.conv1, encoder.conv2, encoder.conv3))
        self._decoder = [
            tuple(
                each.half()
                for each in fuse_linear_bn_weights(
                    lin.weight, lin.bias, cast(torch.Tensor, norm.running_mean), cast(torch.Tensor, norm.running_var),
                    norm.eps, norm.weight, norm.bias,
                )
            )
            for lin, norm in ((decoder.lin_1, decoder.bn_1_out), (decoder.lin_2, decoder.bn_2_out))
        ]  # fmt: skip
        self._last = decoder.lin_3.weight.detach(), decoder.lin_3.bias.detach()

    def __call__(self, x: torch.Tensor, rows: int | None = None) -> torch.Tensor:
        """Map patches x (B, P, 3) float32, P > 1, to (B, rows, D), or to (B, D) where the decoder pools."""
        batch, count, _ = x.shape
        rows = count if rows is None else rows
        first, second = self._first.width, self._second.width
        both = torch.empty(batch, count, first + second, dtype=torch.float16, device=x.device)
        h1 = self._first.features(x, cuda.knn(x, self._neighbours, count), both[:, :, :first])
        h2 = self._second.features(both[:, :, :first], cuda.knn(h1, self._neighbours, count), both[:, :, first:])
        h = self._third.last_features(both, cuda.knn(h2, self._neighbours, rows))  # (B, rows, D)
        for weight, bias in self._decoder:
            h = linear(h, weight, bias).relu_()
        return linear((h.amax(dim=1) if self._pool else h).float(), *self._last)


class _Block:
    """An EdgeConv: [x_i, x_j - x_i] W = x_i (W_a - W_b) + x_j W_b, so its first layer runs per point."""

    def __init__(self, block: EdgeConv) -> None:
        hidden, second = (layer for layer in block.mlp if isinstance(layer, nn.Linear))
        own, other = hidden.weight.detach().chunk(2, dim=1)
        self.width = len(second.weight)
        beside, bias = torch.cat([own - other, block.lin.weight.detach()]), torch.cat([hidden.bias, block.lin.bias])
        if own.shape[1] > 3:  # what is made of positions is of float32
            beside, bias, other = beside.half(), bias.half(), other.half()
        self._other, self._beside, self._bias = other.contiguous(), beside, bias.detach()
        self._borders = len(other), 2 * len(other)
        self._all = torch.cat([other, beside]), torch.cat([torch.zeros_like(bias[: len(other)]), self._bias])
        self._maximum = second.weight.detach().half(), second.bias.detach()

    def features(self, x: torch.Tensor, index: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
        """Return the features (B, P, D) float32 of points x (B, P, C), and write them to `half`."""
        b, a, skip = linear(x, *self._all).tensor_split(self._borders, dim=2)
        return cuda.edge_conv(a, b, skip, index, *self._maximum, half, activation=True)

    def last_features(self, x: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
        """Return the features (B, M, D) float16 of the points whose neighbours index (B, M, k) holds."""
        rows = index.shape[1]
        a, skip = linear(x[:, :rows], self._beside, self._bias).tensor_split(self._borders[:1], dim=2)
        out = torch.empty(len(x), rows, self.width, dtype=torch.float16, device=x.device)
        cuda.edge_conv(a, linear(x, self._other), skip, index, *self._maximum, out, activation=False)
        return out
