"""The same loops for CUDA, in Triton: neighbour search, the EdgeConv maximum and its gradient, farthest points.

Tested through Triton's interpreter, compiled for Hopper and run on an H200 (docs/kernels.md). Where Triton is missing,
or the kernels do not do what their torch twins do, `load()` returns False and the twins do the work.
"""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable

import torch

try:
    import triton
    import triton.language as tl
except ImportError:  # a CPU build of torch comes without it
    triton = None

__all__ = [
    "EDGES",
    "MOST_FARTHEST",
    "MOST_NEIGHBOURS",
    "MOST_POINTS",
    "EdgeMax",
    "edge_max",
    "farthest",
    "knn",
    "load",
    "load_gradient",
]

MOST_POINTS = 2048  # of a patch; its indices fill the low bits of a key, and a warp's registers hold a row of keys
MOST_NEIGHBOURS = 32  # of the 64 keys that bound them
_LANES = 32  # of a warp
_DIRECT = 8  # with fewer channels distances are differences, exact; with more, products
EDGES = 32  # of a point, for the gradient: an edge's number fills the low bits of a sum
# The tilings are what was fastest of some dozens on an H200 (docs/kernels.md).
_EDGE_POINTS = 4  # whose edges make a tile of 128 rows
_GRADIENT_POINTS, _GRADIENT_WIDTH = 2, 128  # of a tile that is led back: smaller, for more of them wait for memory
MOST_FARTHEST = 1 << 17  # points; of more, one program is slower than launches over the whole device
_FARTHEST_BLOCK = 4096
_LARGEST_GRADIENT = 1024.0  # what a gradient's largest value is scaled to: float16 keeps what is 1e-9 of it
_ROOM_FOR_THREE = 160 * 1024  # bytes that three stages of a tile take, which a block of a gaming card does not have
_WEIGHT_PROGRAMS = 264  # that make a weight's gradient, a part of it of some of the edges: two for a multiprocessor


@functools.cache
def load() -> bool:
    """Tell whether the kernels run on this machine's GPU, each once in the shapes that the filter has."""
    return _proven(_prove)


@functools.cache
def load_gradient() -> bool:
    """Tell whether those do that training needs beside."""
    return load() and _proven(_prove_gradient)


def _proven(prove: Callable[[torch.device, int], None]) -> bool:
    if triton is None or os.environ.get("STRAIGHTPCF_NO_KERNELS"):
        return False
    try:
        prove(torch.device("cuda"), 1000)
    except Exception as exc:  # the compiler's own errors have no common base
        warnings.warn(f"the Triton kernels do not run here, plain torch does: {exc}", stacklevel=2)
        return False
    return True


def knn(x: torch.Tensor, k: int, rows: int) -> torch.Tensor:
    """Do what `ops.knn` does for at most MOST_POINTS points a patch and MOST_NEIGHBOURS; returns int32 indices.

    Squared distances that agree in their leading bits, 12 at least and mostly 15 or more, go by index.
    """
    batch, points, channels = x.shape
    if points > MOST_POINTS or k > MOST_NEIGHBOURS:
        raise ValueError(f"{k} of {points} points of a patch; the kernel finds {MOST_NEIGHBOURS} of {MOST_POINTS}")
    out = torch.empty(batch, rows, k, dtype=torch.int32, device=x.device)
    direct, size = channels < _DIRECT, max(_LANES, triton.next_power_of_2(points))
    given = squares = x.contiguous()
    if not direct:
        given, squares = torch.bmm(x[:, :rows], x.mT), x.square().sum(dim=2)
    _nearest[batch, rows](
        given, squares, out, points, rows,
        CHANNELS=channels if direct else 0, K=k, POINTS=size, LANES=_LANES, ROOM=31 - size.bit_length(), num_warps=1,
    )  # fmt: skip
    return out


def edge_max(a: torch.Tensor, b: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Do what `ops.edge_max` does, in float16 products with float32 sums; channels a multiple of 16, no gradient."""
    return _maximum(_half(a), _half(b), index.contiguous(), _half(weight), None)


class EdgeMax(torch.autograd.Function):
    """max_n W relu(a_i + b_index[i, n]) and its gradient, for 32 edges a point; shapes as in `ops.edge_max`.

    No tensor of edges reaches memory in either direction: hidden rows are computed again. Only the winning edge of each
    (point, channel) has a gradient, which a tile of edges takes as a matrix of mostly zeros, for the tensor cores.
    """

    @staticmethod
    def forward(ctx, a, b, index, weight):  # type: ignore[no-untyped-def]
        """Take the maximum as `edge_max` does, and remember the edge that has it."""
        a, b, index, weight = _half(a), _half(b), index.contiguous(), _half(weight)
        won = torch.empty(*a.shape[:2], weight.shape[0], dtype=torch.uint8, device=a.device)
        out = _maximum(a, b, index, weight, won)
        ctx.save_for_backward(a, b, index, weight, won)
        return out

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        """Follow the winning edges back; sums over points have no fixed order."""
        a, b, index, weight, won = ctx.saved_tensors
        (batch, rows, channels), points, (out_channels, _) = a.shape, b.shape[1], weight.shape
        scale = _LARGEST_GRADIENT / grad.abs().amax().clamp(min=torch.finfo(torch.float32).tiny * _LARGEST_GRADIENT)
        scaled = _half(grad * scale)
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


def _half(x: torch.Tensor) -> torch.Tensor:
    return x.to(torch.float16).contiguous()


def _maximum(
    a: torch.Tensor, b: torch.Tensor, index: torch.Tensor, weight: torch.Tensor, won: torch.Tensor | None
) -> torch.Tensor:
    batch, rows, channels = a.shape
    out_channels, k = weight.shape[0], index.shape[2]
    out = torch.empty(batch, rows, out_channels, dtype=torch.float32, device=a.device)
    width = min(256, triton.next_power_of_2(out_channels))
    _edge_max[batch, triton.cdiv(rows, _EDGE_POINTS), triton.cdiv(out_channels, width)](
        a, b, index, weight, out, out if won is None else won, b.shape[1], rows, out_channels,
        CHANNELS=channels, STEP=min(64, channels & -channels), K=k, ROWS=_EDGE_POINTS, WIDTH=width,
        WON=won is not None, num_warps=8, num_stages=3 if _room(a.device) >= _ROOM_FOR_THREE else 2,
    )  # fmt: skip
    return out


@functools.cache
def _room(device: torch.device) -> int:
    """Return how much memory a block may share, in bytes."""
    if device.type != "cuda":  # Triton's interpreter
        return _ROOM_FOR_THREE
    return int(triton.runtime.driver.active.utils.get_device_properties(device.index)["max_shared_mem"])


def farthest(points: torch.Tensor, wanted: int, first: int) -> torch.Tensor:
    """Sample `wanted` farthest points of (N, 3) float32, beginning with row `first`: (wanted,) int64, one launch."""
    seeds = torch.empty(wanted, dtype=torch.int64, device=points.device)
    apart = torch.full((len(points),), torch.inf, dtype=torch.float32, device=points.device)
    _farthest[1,](points.T.contiguous(), apart, seeds, len(points), wanted, first, BLOCK=_FARTHEST_BLOCK, num_warps=16)
    return seeds


def _prove(device: torch.device, points: int) -> None:
    """Raise unless each kernel does what its torch twin does for a patch of so many points of the shipped network."""
    from straightpcf.model import device_patches, ops  # they import this module

    generator = torch.Generator(device).manual_seed(0)
    for channels, k in ((3, 16), (3, 32), (16, 32), (32, 32), (64, 32)):
        x = torch.randn(1, points, channels, device=device, generator=generator)
        found, expected = (_distances(x, index) for index in (knn(x, k, points), ops.knn_torch(x, k, points)))
        if not torch.allclose(found, expected, rtol=1e-3):
            raise RuntimeError(f"no nearest neighbours in {channels} channels")
    index = knn(x, 32, points)
    for width in (16, 32, 64, 128, 256):
        a, b = torch.randn(2, 1, points, width, device=device, generator=generator)
        weight = torch.randn(width, width, device=device, generator=generator)
        expected = ops.edge_max_torch(a, b, index, weight)
        if not (edge_max(a, b, index, weight) - expected).norm() < 1e-2 * expected.norm():
            raise RuntimeError(f"another maximum over edges of {width} channels")
    cloud = torch.randn(5000, 3, device=device, generator=generator)
    if not torch.equal(farthest(cloud, 8, 1), device_patches.farthest_torch(cloud, 8, 1)):
        raise RuntimeError("other farthest points")


def _prove_gradient(device: torch.device, points: int) -> None:
    """Raise unless the maximum over edges has its twin's gradient in each shape of the shipped network."""
    from straightpcf.model import ops  # it imports this module

    generator = torch.Generator(device).manual_seed(0)
    for width, rows in ((32, points), (64, points), (256, points), (256, 1 + points // 4)):
        a, b = torch.randn(2, 2, points, width, device=device, generator=generator)
        weight = torch.randn(width, width, device=device, generator=generator) / width**0.5
        index = ops.knn(b[:, :, :3].contiguous(), 32, rows)
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


def _distances(x: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Return the squared distances of the points (1, P, C) from others of theirs (1, P, k), ascending."""
    return (x[0][index[0].long()] - x[0][:, None]).square().sum(dim=2).sort(dim=1).values


if triton is not None:
    # Their parameters bear no annotations but tl.constexpr: the compiler would evaluate them.

    @triton.jit  # type: ignore[untyped-decorator]
    def _nearest(  # type: ignore[no-untyped-def]
        x, squares, out, points, rows,
        CHANNELS: tl.constexpr, K: tl.constexpr, POINTS: tl.constexpr, LANES: tl.constexpr, ROOM: tl.constexpr,
    ):  # fmt: skip
        """Select the K nearest of all points for one point of a patch, inside one warp, in any order.

        x: the points' CHANNELS coordinates, or where CHANNELS is 0 the products of rows with points, and `squares`
        their squared lengths. A key is ROOM bits of a distance above the point's index: one comparison finds both.
        """
        patch, i = tl.program_id(0).to(tl.int64), tl.program_id(1)
        j = tl.arange(0, POINTS)
        valid = (j < points) & (j != i)
        if CHANNELS > 0:
            distance = tl.zeros([POINTS], tl.float32)
            for c in tl.static_range(CHANNELS):
                own = tl.load(x + (patch * points + i) * CHANNELS + c)
                apart = own - tl.load(x + (patch * points + j) * CHANNELS + c, mask=j < points, other=0.0)
                distance += apart * apart
        else:
            own = tl.load(squares + patch * points + i)
            other = tl.load(squares + patch * points + j, mask=j < points, other=0.0)
            product = tl.load(x + (patch * rows + i) * points + j, mask=j < points, other=0.0)
            distance = tl.maximum(own + other - 2.0 * product, 0.0)
        # As integers, squared distances keep their order; of what they are above the row's least, the leading bits fit.
        bits = distance.to(tl.int32, bitcast=True)
        least = tl.min(tl.where(valid, bits, 0x7FFFFFFF), axis=0)
        reach = tl.maximum(tl.max(tl.where(valid, bits, 0), axis=0) - least, 0)
        length = (reach.to(tl.float32).to(tl.int32, bitcast=True) >> 23) - 126  # in bits: the exponent of a float
        key = tl.where(valid, ((bits - least) >> tl.maximum(length - ROOM, 0)) * POINTS + j, 0x7FFFFFFF)
        # The K-th of each lane's two least keys, found bit by bit, bounds the K-th of all: some K + 4 keep to it.
        lanes = tl.reshape(key, (POINTS // LANES, LANES))  # the first axis lies within a lane: no key changes places
        first = tl.min(lanes, axis=0)
        second = tl.min(tl.where(lanes == first[None, :], 0x7FFFFFFF, lanes), axis=0)
        bound = 0
        for n in range(31):
            higher = bound | (1 << (30 - n))
            below = tl.sum((first < higher).to(tl.int32) + (second < higher).to(tl.int32), axis=0)
            bound = tl.where(below < K, higher, bound)
        bound = tl.minimum(bound, 0x7FFFFFFE)  # where all are too few it is no point's
        count = tl.sum((key <= bound).to(tl.int32), axis=0)
        while count > K:
            bound = tl.max(tl.where(key < bound, key, 0), axis=0)
            count -= 1
        chosen = key <= bound
        # Each finds its place by counting those before it, lane by lane.
        taken = tl.reshape(chosen.to(tl.int32), (POINTS // LANES, LANES))
        lane = tl.sum(taken, axis=0)
        start = tl.cumsum(lane, axis=0) - lane
        place = tl.reshape(start[None, :] + tl.cumsum(taken, axis=0) - taken, (POINTS,))
        to = out + (patch * rows + i) * K
        tl.store(to + place, key & (POINTS - 1), mask=chosen)
        if count < K:  # too few points: the farthest again
            rest = tl.arange(0, LANES)
            last = tl.max(tl.where(chosen, key, 0), axis=0) & (POINTS - 1)
            tl.store(to + rest, tl.full([LANES], 0, tl.int32) + last, mask=(rest >= count) & (rest < K))

    @triton.jit  # type: ignore[untyped-decorator]
    def _edges(index, patch, first, rows, K: tl.constexpr, ROWS: tl.constexpr):  # type: ignore[no-untyped-def]
        """Return the edges of ROWS points of a patch, the point of each, whether it is there, and its neighbour."""
        edge = tl.arange(0, ROWS * K)
        own = first + edge // K
        there = own < rows
        return edge, own, there, tl.load(index + (patch * rows + own) * K + edge % K, mask=there, other=0)

    @triton.jit
    def _of_winners(grad, won, place, wanted, number):  # type: ignore[no-untyped-def]
        """Return the gradient of each edge's outputs: the maximum's where the edge, `number` of its point, won."""
        upstream = tl.load(grad + place, mask=wanted, other=0.0)
        winner = tl.load(won + place, mask=wanted, other=0)
        return tl.where(winner.to(tl.int32) == number[:, None], upstream, 0.0)

    @triton.jit  # type: ignore[untyped-decorator]
    def _edge_max(  # type: ignore[no-untyped-def]
        a, b, index, weight, out, won, points, rows, out_channels,
        CHANNELS: tl.constexpr, STEP: tl.constexpr, K: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr,
        WON: tl.constexpr,
    ):  # fmt: skip
        """Gather, add, ReLU, multiply and take the maximum over the neighbours, for ROWS points of one patch.

        Where WON, which neighbour has it comes out too: it takes the place of a sum's last bits.
        """
        patch = tl.program_id(0).to(tl.int64)
        first = tl.program_id(1) * ROWS
        edge, own, there, other = _edges(index, patch, first, rows, K, ROWS)
        d = tl.program_id(2) * WIDTH + tl.arange(0, WIDTH)
        total = tl.zeros([ROWS * K, WIDTH], tl.float32)
        for start in range(0, CHANNELS, STEP):
            c = start + tl.arange(0, STEP)
            mine = tl.load(a + (patch * rows + own)[:, None] * CHANNELS + c[None, :], mask=there[:, None], other=0.0)
            theirs = tl.load(b + (patch * points + other)[:, None] * CHANNELS + c[None, :])
            hidden = tl.clamp(mine.to(tl.float32) + theirs.to(tl.float32), 0.0, 65504.0).to(tl.float16)
            w = tl.load(weight + d[None, :] * CHANNELS + c[:, None], mask=(d < out_channels)[None, :], other=0.0)
            total = tl.dot(hidden, w, total)
        i = first + tl.arange(0, ROWS)
        inside = (i < rows)[:, None] & (d < out_channels)[None, :]
        place = (patch * rows + i)[:, None] * out_channels + d[None, :]
        if WON:
            bits = (total.to(tl.int32, bitcast=True) & -K) | (edge % K)[:, None]
            total = bits.to(tl.float32, bitcast=True)
        best = tl.max(tl.reshape(total, (ROWS, K, WIDTH)), axis=1)
        tl.store(out + place, best, mask=inside)
        if WON:
            tl.store(won + place, (best.to(tl.int32, bitcast=True) & (K - 1)).to(tl.uint8), mask=inside)

    @triton.jit  # type: ignore[untyped-decorator]
    def _hidden_gradient(  # type: ignore[no-untyped-def]
        grad, won, a, b, index, weight, grad_a, grad_b, points, rows, channels,
        OUT_CHANNELS: tl.constexpr, STEP: tl.constexpr, K: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr,
    ):  # fmt: skip
        """Lead the gradient of a maximum back to both shares of the hidden rows, for ROWS points of one patch."""
        patch = tl.program_id(0).to(tl.int64)
        first = tl.program_id(1) * ROWS
        edge, own, there, other = _edges(index, patch, first, rows, K, ROWS)
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
            edge, own, there, other = _edges(index, patch, (tile % tiles_each) * ROWS, rows, K, ROWS)
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

    # Else it is compiled again for counts that are multiples of 16, and for seeds of 1 and 0: eighteen times.
    @triton.jit(do_not_specialize=["count", "wanted", "first"])  # type: ignore[untyped-decorator]
    def _farthest(xyz, apart, seeds, count, wanted, first, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
        """Take the point farthest from those taken, again and again, in one program; xyz: (3, count)."""
        lane = tl.arange(0, BLOCK)
        last = first
        for n in range(wanted):
            tl.store(seeds + n, last.to(tl.int64))
            x, y, z = tl.load(xyz + last), tl.load(xyz + count + last), tl.load(xyz + 2 * count + last)
            best = tl.full([BLOCK], -1.0, tl.float32)
            where = tl.zeros([BLOCK], tl.int32)
            for start in range(0, count, BLOCK):
                j = start + lane
                dx = tl.load(xyz + j, mask=j < count, other=0.0) - x
                dy = tl.load(xyz + count + j, mask=j < count, other=0.0) - y
                dz = tl.load(xyz + 2 * count + j, mask=j < count, other=0.0) - z
                nearest = tl.load(apart + j, mask=j < count, other=-1.0)  # what lies beyond is never the farthest
                nearest = tl.minimum(nearest, dx * dx + dy * dy + dz * dz)
                tl.store(apart + j, nearest, mask=j < count)
                farther = nearest > best
                best, where = tl.where(farther, nearest, best), tl.where(farther, j, where)
            last = tl.min(tl.where(best == tl.max(best, axis=0), where, count), axis=0)  # the first of equals
