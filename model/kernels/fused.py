"""A whole VelocityModule or DistanceModule in one call of the compiled kernels, for inference on a CPU.

Step by step, torch asks for the interpreter's lock some forty times an evaluation, and patches on other threads wait
for it: of two threads each took half as long again as one alone. The twin is the modules' own forward.
"""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, cast

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_linear_bn_weights

from straightpcf.model.kernels import cpu

if TYPE_CHECKING:
    from straightpcf.model.kernels.fused_cuda import FusedOnDevice
    from straightpcf.model.nets.edgeconv import Decoder, EdgeConv, Encoder

__all__ = ["Fused", "fused"]

_WIDE = 32  # widths are filled up to a multiple of it


class Fused:
    """The layers of an encoder and its decoder as they are now, packed."""

    def __init__(self, library: ctypes.CDLL, encoder: Encoder, decoder: Decoder, neighbours: int) -> None:
        self._library, self._neighbours, self._pool = library, neighbours, decoder.pool
        blocks = (encoder.conv1, encoder.conv2, encoder.conv3)
        first, second, _ = outs = [block.lin.out_features for block in blocks]
        # Block 3 sees the first two blocks' features side by side, each filled up by itself.
        ins = [[3], [first], [first, second]]
        maxima: list[cpu.Packing] = ["edge_max_fine", "edge_max_fine", "edge_max_coarse"]
        self._kept = [each for args in zip(blocks, ins, maxima, strict=True) for each in self._block(*args)]
        self._kept += self._decoder(decoder)
        self._layers = (ctypes.c_void_p * len(self._kept))(*(each.data_ptr() for each in self._kept))
        self.out_width = decoder.lin_3.out_features
        widths = [*outs, decoder.lin_1.out_features, decoder.lin_2.out_features, self.out_width]
        self._widths = (ctypes.c_int32 * len(widths))(*widths)

    def __call__(self, x: torch.Tensor, rows: int | None = None) -> torch.Tensor:
        """Map patches x (B, P, 3) float32, P > 1, to (B, rows, D), or to (B, D) where the decoder pools."""
        batch, count, _ = x.shape
        rows = count if rows is None else rows
        x = x.contiguous()
        out = torch.empty((batch, self.out_width) if self._pool else (batch, rows, self.out_width), dtype=torch.float32)
        for patch, to in zip(x, out, strict=True):
            self._library.straightpcf_fused(
                ctypes.c_void_p(patch.data_ptr()), count, rows, self._neighbours, self._layers, self._widths,
                int(self._pool), ctypes.c_void_p(to.data_ptr()),
            )  # fmt: skip
        return out

    def _block(self, block: EdgeConv, parts: list[int], maximum: cpu.Packing) -> Iterator[torch.Tensor]:
        """Yield what `Block` in fused.cpp lists; parts: the widths of the inputs that lie side by side."""
        hidden, second = (layer for layer in block.mlp if isinstance(layer, nn.Linear))
        own, other = hidden.weight.chunk(2, dim=1)
        layer = self._exact if parts == [3] else partial(self._layer, parts=parts)
        yield from layer(own - other, hidden.bias)  # the first layer runs per point, not per edge
        yield from layer(other, torch.zeros_like(hidden.bias))
        yield from self._layer(second.weight, second.bias, [second.in_features], maximum)
        yield from layer(block.lin.weight, block.lin.bias)

    def _decoder(self, decoder: Decoder) -> Iterator[torch.Tensor]:
        for lin, norm in ((decoder.lin_1, decoder.bn_1_out), (decoder.lin_2, decoder.bn_2_out)):
            weight, bias = fuse_linear_bn_weights(
                lin.weight, lin.bias, cast(torch.Tensor, norm.running_mean), cast(torch.Tensor, norm.running_var),
                norm.eps, norm.weight, norm.bias,
            )  # fmt: skip
            yield from self._layer(weight, bias, [lin.in_features])
        yield from self._exact(decoder.lin_3.weight, decoder.lin_3.bias)

    def _layer(
        self, weight: torch.Tensor, bias: torch.Tensor, parts: list[int], kernel: cpu.Packing = "linear"
    ) -> Iterator[torch.Tensor]:
        """Yield a weight (D, C), packed, and its bias (D,), filled up: the C columns part by part."""
        rows, starts = _filled(len(weight)) - len(weight), [sum(parts[:n]) for n in range(len(parts))]
        columns = [
            nn.functional.pad(weight[:, start : start + part], (0, _filled(part) - part, 0, rows))
            for start, part in zip(starts, parts, strict=True)
        ]
        yield cpu.packed(self._library, torch.cat(columns, dim=1), kernel)
        yield nn.functional.pad(bias, (0, rows))

    @staticmethod
    def _exact(weight: torch.Tensor, bias: torch.Tensor) -> Iterator[torch.Tensor]:
        """Yield what `exact` in fused.cpp reads: a weight (D, C) as (C, D), and its bias (D,), D filled up."""
        rows = _filled(len(weight)) - len(weight)
        yield nn.functional.pad(weight.T, (0, rows)).contiguous()
        yield nn.functional.pad(bias, (0, rows)).contiguous()


_KNOWN: weakref.WeakKeyDictionary[nn.Module, tuple[object, Fused | FusedOnDevice]] = weakref.WeakKeyDictionary()


def fused(
    module: nn.Module, encoder: Encoder, decoder: Decoder, x: torch.Tensor, neighbours: int
) -> Fused | FusedOnDevice | None:
    """Return what does as a module does that is `encoder`, then `decoder`, on patches like x; None where nothing does.

    Packed anew where a weight has changed.
    """
    if torch.is_grad_enabled() or decoder.training or x.dtype != torch.float32 or x.shape[1] < 2:
        return None
    library = cpu.load() if x.device.type == "cpu" else None
    pack: Callable[[Encoder, Decoder, int], Fused | FusedOnDevice]
    if library is not None:
        pack = partial(Fused, library)
    elif x.is_cuda:
        from straightpcf.model.kernels import fused_cuda  # a GPU's, which not every process has

        if not fused_cuda.takes(encoder, x, neighbours):
            return None
        pack = fused_cuda.FusedOnDevice
    else:
        return None
    tensors = [*module.parameters(), *module.buffers()]
    if any(each.is_inference() for each in tensors):  # made in inference mode: nothing tells when they change
        return None
    state = (id(library), *((each.data_ptr(), each._version) for each in tensors))
    known = _KNOWN.get(module)
    if known is None or known[0] != state:
        known = _KNOWN[module] = (state, pack(encoder, decoder, neighbours))
    return known[1]


def _filled(width: int) -> int:
    return -(-width // _WIDE) * _WIDE
