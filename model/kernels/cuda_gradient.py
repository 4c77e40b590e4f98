"""The gradient of the EdgeConv maximum for CUDA, in Triton: training's share of `cuda.py`."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch

from straightpcf.model.kernels.cuda import edge_max_into, edges_of, in_half, knn, load, proven, triton

if triton is not None:
    import triton.language as tl

__all__ = ["EDGES", "EdgeMax", "load_gradient"]

EDGES = 32  # of a point: an edge's number fills the low bits of a sum
# The tilings are what was fastest of some dozens on an H200 (docs/kernels.md).
_EDGE_POINTS = 4
_GRADIENT_POINTS, _GRADIENT_WIDTH = 2, 128  # of a tile that is led back: smaller, for more of them wait for memory
_LARGEST_GRADIENT = 1024.0  # what a gradient's largest value is scaled to: float16 keeps what is 1e-9 of it
_WEIGHT_PROGRAMS = 264  # that make a weight's gradient, a part of it of some of the edges: two for a multiprocessor


@functools.cache
def load_gradient() -> bool:
    """Tell whether those do that training needs beside."""
    return load() and proven(_prove_gradient)


class EdgeMax(torch.autograd.Function):
    """max_n W relu(a_i + b_index[i, n]) and its gradient, for 32 edges a point; shapes as in `ops.edge_max`.

    No tensor of edges reaches memory in either direction: hidden rows are computed again. Only the winning edge of each
    (point, channel) has a gradient, which a tile of edges takes as a matrix of mostly zeros, for the tensor cores.
    """

    @staticmethod
    def forward(ctx, a, b, index, weight):  # type: ignore[no-untyped-def]
        """Take the maximum as `edge_max` does, and remember the edge that has it."""
        a, b, index, weight = in_half(a), in_half(b), index.contiguous(), in_half(weight)
        won = torch.empty(*a.shape[:2], weight.shape[0], dtype=torch.uint8, device=a.device)
        out = torch.empty(won.shape, dtype=torch.float32, device=a.device)
        edge_max_into(out, a, b, index, weight, won=won)
        ctx.save_for_backward(a, b, index, weight, won)
        return out

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        """Follow the winning edges back; sums over points have no fixed order."""
        a, b, index, weight, won = ctx.saved_tensors
        (batch, rows, channels), points, (out_channels, _) = a.shape, b.shape[1], weight.shape
        scale = _LARGEST_GRADIENT / grad.abs().amax().clamp(min=torch.finfo(torch.float32).tiny * _LARGEST_GRADIENT)
        scaled = in_half(grad * scale)
        grad_a = torch.empty(a.shape, dtype=torch.float32, device=a.device)
        grad_b = torch.zeros(b.shape, dtype=torch.float32, device=a.device)
        grad_weight = torch.zeros(weight.shape, dtype=torch.float32, device=a.device)
        width = min(_GRADIENT_WIDTH, triton.next_power_of_2(channels))
        _hidden_gradient[batch, triton.cdiv(rows, _GRADIENT_POINTS), triton.cdiv(channels, width)](
            scaled, won, a, b, index, weight, grad_a, grad_b, points, rows, channels,
            OUT_CHANNELS=out_channels, STEP=min(64, out_channels & -out_channels),
            K=index.shape[2], ROWS=_GRADIENT_POINTS, WIDTH=width, num_warps=4,
        )  # fmt: skip
        tiles = triton.cdiv(rows, _EDGE_POINTS)
        width = min(256, triton.next_power_of_2(channels))
        out_width = min(128, triton.next_power_of_2(out_channels))
        parts = triton.cdiv(out_channels, out_width), triton.cdiv(channels, width)
        _weight_gradient[min(_WEIGHT_PROGRAMS // (parts[0] * parts[1]), batch * tiles), *parts](
            scaled, won, a, b, index, grad_weight, points, rows, channels, out_channels, tiles, batch * tiles,
            K=index.shape[2], ROWS=_EDGE_POINTS, WIDTH=width, OUT_WIDTH=out_width, num_warps=8,
            num_stages=1,
        )  # fmt: skip
        return grad_a / scale, grad_b / scale, None, grad_weight / scale


def _prove_gradient(device: torch.device, points: int) -> None:
    """Raise unless the maximum over edges has its twin's gradient in each shape of the shipped network."""
    from straightpcf.model import ops  # it imports this module

    generator = torch.Generator(device).manual_seed(0)
    for width, rows in ((32, points), (64, points), (256, points), (256, 1 + points // 4)):
        a, b = torch.randn(2, 2, points, width, device=device, generator=generator)
        weight = torch.randn(width, width, device=device, generator=generator) / width**0.5
        index = knn(b[:, :, :3].contiguous(), EDGES, rows)
        upstream = torch.randn(2, rows, width, device=device, generator=generator)
        of = a[:, :rows].contiguous(), b, weight
        found, expected = (
            _gradients(EdgeMax.apply, of, index, upstream),
            _gradients(ops.edge_max_torch, of, index, upstream),
        )
        for ours, theirs in zip(found, expected, strict=True):  # of edges that are nearly equal either may win
            if not (ours - theirs).norm() < 1e-1 * theirs.norm():
                raise RuntimeError(f"another gradient of the maximum over edges of {width} channels")


def _gradients(
    maximum: Callable[..., torch.Tensor],
    of: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    index: torch.Tensor,
    upstream: torch.Tensor,
) -> tuple[torch.Tensor, ...]:
    with torch.enable_grad():
        a, b, weight = (each.clone().requires_grad_() for each in of)
        return torch.autograd.grad(maximum(a, b, index, weight), (a, b, weight), upstream)


if triton is not None:
    # Their parameters bear no annotations but tl.constexpr: the compiler would evaluate them.

    @triton.jit
    def _of_winners(grad, won, place, wanted, number):  # type: ignore[no-untyped-def]
        """Return the gradient of each edge's outputs: the maximum's where the edge, `number` of its point, won."""
        upstream = tl.load(grad + place, mask=wanted, other=0.0)
        winner = tl.load(won + place, mask=wanted, other=0)
        return tl.where(winner.to(tl.int32) == number[:, None], upstream, 0.0)

    @triton.jit  # type: ignore[untyped-decorator]
    def _hidden_gradient(  # type: ignore[no-untyped-def]
        grad, won, a, b, index, weight, grad_a, grad_b, points, rows, channels,
        OUT_CHANNELS: tl.constexpr, STEP: tl.constexpr, K: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr,
    ):  # fmt: skip
        """Lead the gradient of a maximum back to both shares of the hidden rows, for ROWS points of one patch."""
        patch = tl.program_id(0).to(tl.int64)
        first = tl.program_id(1) * ROWS
        edge, own, there, other = edges_of(index, patch, first, rows, K, ROWS)
        c = tl.program_id(2) * WIDTH + tl.arange(0, WIDTH)
        total = tl.zeros([ROWS * K, WIDTH], tl.float32)
        for start in range(0, OUT_CHANNELS, STEP):
            d = start + tl.arange(0, STEP)
            place = (patch * rows + own)[:, None] * OUT_CHANNELS + d[None, :]
            upstream = _of_winners(grad, won, place, there[:, None], edge % K)
            w = tl.load(weight + d[:, None] * channels + c[None, :], mask=(c < channels)[None, :], other=0.0)
            total = tl.dot(upstream, w, total)
        inside = there[:, None] & (c < channels)[None, :]
        place_b = (patch * points + other)[:, None] * channels + c[None, :]
        mine = tl.load(a + (patch * rows + own)[:, None] * channels + c[None, :], mask=inside, other=0.0)
        theirs = tl.load(b + place_b, mask=inside, other=0.0)
        total = tl.where(mine.to(tl.float32) + theirs.to(tl.float32) > 0.0, total, 0.0)
        i = first + tl.arange(0, ROWS)
        sums = tl.sum(tl.reshape(total, (ROWS, K, WIDTH)), axis=1)
        inside_a = (i < rows)[:, None] & (c < channels)[None, :]
        tl.store(grad_a + (patch * rows + i)[:, None] * channels + c[None, :], sums, mask=inside_a)
        tl.atomic_add(grad_b + place_b, total, mask=inside & (total != 0.0), sem="relaxed")

    @triton.jit  # type: ignore[untyped-decorator]
    def _weight_gradient(  # type: ignore[no-untyped-def]
        grad, won, a, b, index, grad_weight, points, rows, channels, out_channels, tiles_each, tiles,
        K: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr, OUT_WIDTH: tl.constexpr,
    ):  # fmt: skip
        """Add up the gradient of the weight over a share of the edges, ROWS points' at a time."""
        d = tl.program_id(1) * OUT_WIDTH + tl.arange(0, OUT_WIDTH)
        c = tl.program_id(2) * WIDTH + tl.arange(0, WIDTH)
        total = tl.zeros([OUT_WIDTH, WIDTH], tl.float32)
        for tile in range(tl.program_id(0), tiles, tl.num_programs(0)):
            patch = (tile // tiles_each).to(tl.int64)
            edge, own, there, other = edges_of(index, patch, (tile % tiles_each) * ROWS, rows, K, ROWS)
            inside = there[:, None] & (c < channels)[None, :]
            mine = tl.load(a + (patch * rows + own)[:, None] * channels + c[None, :], mask=inside, other=0.0)
            theirs = tl.load(b + (patch * points + other)[:, None] * channels + c[None, :], mask=inside, other=0.0)
            hidden = tl.clamp(mine.to(tl.float32) + theirs.to(tl.float32), 0.0, 65504.0).to(tl.float16)
            place = (patch * rows + own)[:, None] * out_channels + d[None, :]
            wanted = there[:, None] & (d < out_channels)[None, :]
            upstream = _of_winners(grad, won, place, wanted, edge % K)
            total = tl.dot(tl.trans(upstream), hidden, total)
        inside = (d < out_channels)[:, None] & (c < channels)[None, :]
        tl.atomic_add(grad_weight + d[:, None] * channels + c[None, :], total, mask=inside, sem="relaxed")
