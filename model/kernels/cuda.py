"""The same loops for CUDA, in Triton: neighbour search, and the EdgeConv maximum without the edge tensor.

Written and tested through Triton's interpreter; not yet run on a GPU (docs/kernels.md). Where Triton is missing, or the
first launch fails, `load()` returns None and the torch twins do the work.
"""

from __future__ import annotations

import functools
import os
import warnings
from typing import Any

import torch

try:
    import triton
    import triton.language as tl
except ImportError:  # a CPU build of torch comes without it
    triton = None

__all__ = ["edge_max", "knn", "load"]

_ROWS, _CHANNELS = 16, 16  # of a tile of the neighbour search; a tile sees every point of the patch
_MAX_POINTS = 2048
_POINTS = 4  # whose 32 edges each make a tile of 128 rows


@functools.cache
def load() -> bool:
    """Tell whether the kernels run on this machine's GPU."""
    if triton is None or os.environ.get("STRAIGHTPCF_NO_KERNELS"):
        return False
    try:
        x = torch.zeros(1, 64, 32, device="cuda")
        edge_max(x, x, knn(x, 32, 64), torch.zeros(32, 32, device="cuda"))
        torch.cuda.synchronize()
    except Exception as exc:  # the compiler's own errors have no common base
        warnings.warn(f"the Triton kernels do not run here, plain torch does: {exc}", stacklevel=2)
        return False
    return True


def knn(x: torch.Tensor, k: int, rows: int) -> torch.Tensor:
    """Do what `ops.knn` does; returns int32 indices."""
    batch, points, channels = x.shape
    if points > _MAX_POINTS:
        raise ValueError(f"a patch of {points} points; the kernel takes {_MAX_POINTS}")
    x = x.contiguous()
    out = torch.empty(batch, rows, k, dtype=torch.int32, device=x.device)
    _knn[batch, triton.cdiv(rows, _ROWS)](
        x, out, points, rows, channels,
        direct=channels < _CHANNELS, K=k, ROWS=_ROWS, CHANNELS=_CHANNELS, POINTS=triton.next_power_of_2(points),
        num_warps=8,
    )  # fmt: skip
    return out


def edge_max(a: torch.Tensor, b: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Do what `ops.edge_max` does, in float16 products with float32 sums; channels a multiple of 16, no gradient."""
    batch, rows, channels = a.shape
    out_channels, k = weight.shape[0], index.shape[2]
    out = torch.empty(batch, rows, out_channels, dtype=torch.float32, device=a.device)
    width = min(128, triton.next_power_of_2(out_channels))
    _edge_max[batch, triton.cdiv(rows, _POINTS), triton.cdiv(out_channels, width)](
        a.to(torch.float16).contiguous(), b.to(torch.float16).contiguous(), index.contiguous(),
        weight.to(torch.float16).contiguous(), out, b.shape[1], rows, out_channels,
        CHANNELS=channels, STEP=min(64, channels & -channels), K=k, ROWS=_POINTS, WIDTH=width, num_warps=8,
    )  # fmt: skip
    return out


if triton is not None:

    @triton.jit  # type: ignore[untyped-decorator]
    def _knn(
        x: Any, out: Any, points: Any, rows: Any, channels: Any,
        direct: tl.constexpr, K: tl.constexpr, ROWS: tl.constexpr, CHANNELS: tl.constexpr, POINTS: tl.constexpr,
    ) -> None:  # fmt: skip
        """Select the K nearest of all points for ROWS points of one patch: distances once, then K minima."""
        patch = tl.program_id(0).to(tl.int64)
        i = tl.program_id(1) * ROWS + tl.arange(0, ROWS)
        j = tl.arange(0, POINTS)
        base = x + patch * points * channels
        distance = tl.zeros([ROWS, POINTS], tl.float32)
        if direct:  # exact differences where they are cheap
            for c in range(channels):
                own = tl.load(base + i * channels + c, mask=i < points, other=0.0)
                other = tl.load(base + j * channels + c, mask=j < points, other=0.0)
                difference = own[:, None] - other[None, :]
                distance += difference * difference
        else:  # |x_j|^2 - 2 x_i x_j orders as the distance does
            for first in range(0, channels, CHANNELS):
                c = first + tl.arange(0, CHANNELS)
                own = tl.load(
                    base + i[:, None] * channels + c[None, :],
                    mask=(i < points)[:, None] & (c < channels)[None, :],
                    other=0.0,
                )
                other = tl.load(
                    base + j[None, :] * channels + c[:, None],
                    mask=(j < points)[None, :] & (c < channels)[:, None],
                    other=0.0,
                )
                distance += tl.sum(other * other, axis=0)[None, :]
                distance -= 2.0 * tl.dot(own, other, input_precision="ieee")
        distance = tl.where((j < points)[None, :] & (j[None, :] != i[:, None]), distance, float("inf"))
        last = tl.zeros([ROWS], tl.int32)
        for n in range(K):
            nearest, index = tl.min(distance, axis=1, return_indices=True)
            last = tl.where(nearest < float("inf"), index.to(tl.int32), last)  # too few points: the farthest again
            tl.store(out + (patch * rows + i) * K + n, last, mask=i < rows)
            distance = tl.where(j[None, :] == index[:, None], float("inf"), distance)

    @triton.jit  # type: ignore[untyped-decorator]
    def _edge_max(
        a: Any, b: Any, index: Any, weight: Any, out: Any, points: Any, rows: Any, out_channels: Any,
        CHANNELS: tl.constexpr, STEP: tl.constexpr, K: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr,
    ) -> None:  # fmt: skip
        """Gather, add, ReLU, multiply and take the maximum over the neighbours, for ROWS points of one patch."""
        patch = tl.program_id(0).to(tl.int64)
        first = tl.program_id(1) * ROWS
        edge = tl.arange(0, ROWS * K)
        own = first + edge // K
        there = own < rows
        other = tl.load(index + (patch * rows + own) * K + edge % K, mask=there, other=0)
        d = tl.program_id(2) * WIDTH + tl.arange(0, WIDTH)
        total = tl.zeros([ROWS * K, WIDTH], tl.float32)
        for start in range(0, CHANNELS, STEP):
            c = start + tl.arange(0, STEP)
            mine = tl.load(a + (patch * rows + own)[:, None] * CHANNELS + c[None, :], mask=there[:, None], other=0.0)
            theirs = tl.load(b + (patch * points + other)[:, None] * CHANNELS + c[None, :])
            hidden = tl.clamp(mine.to(tl.float32) + theirs.to(tl.float32), 0.0, 65504.0).to(tl.float16)
            w = tl.load(weight + d[None, :] * CHANNELS + c[:, None], mask=(d < out_channels)[None, :], other=0.0)
            total = tl.dot(hidden, w, total)
        best = tl.max(tl.reshape(total, (ROWS, K, WIDTH)), axis=1)
        i = first + tl.arange(0, ROWS)
        inside = (i < rows)[:, None] & (d < out_channels)[None, :]
        tl.store(out + (patch * rows + i)[:, None] * out_channels + d[None, :], best, mask=inside)
