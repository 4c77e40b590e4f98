"""The same loops for CUDA, in Triton: neighbour search, the EdgeConv maximum, farthest points.

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
    "MOST_FARTHEST",
    "MOST_NEIGHBOURS",
    "MOST_POINTS",
    "edge_conv",
    "edge_max",
    "edge_max_into",
    "edges_of",
    "farthest",
    "in_half",
    "knn",
    "load",
    "proven",
    "triton",
]

MOST_POINTS = 2048  # of a patch; its indices fill the low bits of a key, and a warp's registers hold a row of keys
MOST_NEIGHBOURS = 32  # of the 96 keys that bound them
_LANES = 32  # of a warp
_DIRECT = 8  # with fewer channels distances are differences, exact; with more, products
_DISTANCES = 64  # of so many points from as many, in one program
# The tilings are what was fastest of some dozens on an H200 (docs/kernels.md).
_EDGE_POINTS = 4  # whose edges make a tile of 128 rows
_LAST_WIDTHS = 128  # of the blocks that are the networks' last, and wider
MOST_FARTHEST = 1 << 17  # points; of more, one program is slower than launches over the whole device
_FARTHEST_BLOCK = 4096
_ROOM_FOR_THREE = 160 * 1024  # bytes that three stages of a tile take, which a block of a gaming card does not have


@functools.cache
def load() -> bool:
    """Tell whether the kernels run on this machine's GPU, each once in the shapes that the filter has."""
    return proven(_prove)


def proven(prove: Callable[[torch.device, int], None]) -> bool:
    """Tell whether `prove` raises nothing, called with the device and the points of a patch."""
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
    direct, size, x = channels < _DIRECT, max(_LANES, triton.next_power_of_2(points)), x.contiguous()
    given = x if direct else _distances_between(x, rows)
    _nearest[batch, rows](
        given, out, points, rows,
        CHANNELS=channels if direct else 0, K=k, POINTS=size, LANES=_LANES, ROOM=31 - size.bit_length(), num_warps=1,
    )  # fmt: skip
    return out


def _distances_between(x: torch.Tensor, rows: int) -> torch.Tensor:
    """Return the squared distances of the first `rows` points of patches x (B, P, C) from all: (B, rows, P)."""
    batch, points, channels = x.shape
    out = torch.empty(batch, rows, points, dtype=torch.float32, device=x.device)
    _squared_distances[batch, triton.cdiv(rows, _DISTANCES), triton.cdiv(points, _DISTANCES)](
        x, out, points, rows, channels, CHANNELS=max(16, triton.next_power_of_2(channels)),
        ROWS=_DISTANCES, OTHERS=_DISTANCES, num_warps=4,
    )  # fmt: skip
    return out


def edge_max(a: torch.Tensor, b: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Do what `ops.edge_max` does, in float16 products with float32 sums; channels a multiple of 16, no gradient."""
    out = torch.empty(*a.shape[:2], weight.shape[0], dtype=torch.float32, device=a.device)
    edge_max_into(out, in_half(a), in_half(b), index.contiguous(), in_half(weight))
    return out


def in_half(x: torch.Tensor) -> torch.Tensor:
    """Return the tensor in float16, contiguous."""
    return x.to(torch.float16).contiguous()


def edge_conv(
    a: torch.Tensor,
    b: torch.Tensor,
    skip: torch.Tensor,
    index: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    half: torch.Tensor,
    *,
    activation: bool,
) -> torch.Tensor:
    """Return what an EdgeConv makes of both shares of its first layer and of the layer beside it: (B, M, D) float32.

    a, skip: (B, M, C), (B, M, D), parts of one tensor's rows; b: (B, P, C), too; weight: (D, C) float16; bias: (D,).
    half: (B, M, D), a part of a tensor's rows that takes the same in float16. Without activation nothing else does.
    """
    out = torch.empty(half.shape if activation else 0, dtype=torch.float32, device=a.device)
    edge_max_into(out, a, b, index, weight, bias=bias, skip=skip, half=half, activation=activation)
    return out


def edge_max_into(
    out: torch.Tensor,
    a: torch.Tensor,
    b: torch.Tensor,
    index: torch.Tensor,
    weight: torch.Tensor,
    *,
    won: torch.Tensor | None = None,
    bias: torch.Tensor | None = None,
    skip: torch.Tensor | None = None,
    half: torch.Tensor | None = None,
    activation: bool = False,
) -> None:
    """Write what `edge_max` returns to out (B, M, D); won: (B, M, D) uint8, to take which edge has the maximum.

    With bias, skip and half what `edge_conv` does is written, to out where there is activation.
    """
    (batch, rows, channels), out_channels = a.shape, weight.shape[0]
    width = min(256, triton.next_power_of_2(out_channels))
    _edge_max[batch, triton.cdiv(rows, _EDGE_POINTS), triton.cdiv(out_channels, width)](
        a, b, index, weight, out, out if won is None else won, out if bias is None else bias,
        out if skip is None else skip, out if half is None else half, b.shape[1], rows, out_channels,
        a.stride(1), b.stride(1), 0 if half is None else half.stride(1),
        CHANNELS=channels, STEP=min(64, channels & -channels), K=index.shape[2], ROWS=_EDGE_POINTS, WIDTH=width,
        WON=won is not None, WHOLE=half is not None, ACTIVATION=activation,
        num_warps=8, num_stages=3 if _room(a.device) >= _ROOM_FOR_THREE else 2,
    )  # fmt: skip


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
        inner, half = width < _LAST_WIDTHS, torch.empty(1, points, width, dtype=torch.float16, device=device)
        edge_conv(a, b, a, index, in_half(weight), b[0, 0], half, activation=inner)
        expected += b[0, 0]
        expected = torch.relu(expected) + torch.relu(a) if inner else expected + a
        if not (half - expected).norm() < 1e-2 * expected.norm():
            raise RuntimeError(f"another block of {width} channels")
    cloud = torch.randn(5000, 3, device=device, generator=generator)
    if not torch.equal(farthest(cloud, 8, 1), device_patches.farthest_torch(cloud, 8, 1)):
        raise RuntimeError("other farthest points")


def _distances(x: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Return the squared distances of the points (1, P, C) from others of theirs (1, P, k), ascending."""
    return (x[0][index[0].long()] - x[0][:, None]).square().sum(dim=2).sort(dim=1).values


if triton is not None:
    # Their parameters bear no annotations but tl.constexpr: the compiler would evaluate them.

    @triton.jit  # type: ignore[untyped-decorator]
    def _squared_distances(  # type: ignore[no-untyped-def]
        x, out, points, rows, channels, CHANNELS: tl.constexpr, ROWS: tl.constexpr, OTHERS: tl.constexpr,
    ):  # fmt: skip
        """Write |x_i - x_j|^2 of ROWS points of a patch and OTHERS of all, by products to float32's precision."""
        patch = tl.program_id(0).to(tl.int64)
        i, j = tl.program_id(1) * ROWS + tl.arange(0, ROWS), tl.program_id(2) * OTHERS + tl.arange(0, OTHERS)
        c = tl.arange(0, CHANNELS)
        own = tl.load(
            x + (patch * points + i)[:, None] * channels + c[None, :],
            mask=(i < rows)[:, None] & (c < channels)[None, :], other=0.0,
        )  # fmt: skip
        other = tl.load(
            x + (patch * points + j)[:, None] * channels + c[None, :],
            mask=(j < points)[:, None] & (c < channels)[None, :], other=0.0,
        )  # fmt: skip
        product = tl.dot(own, tl.trans(other), input_precision="tf32x3")
        squares = tl.sum(own * own, axis=1)[:, None] + tl.sum(other * other, axis=1)[None, :]
        to = out + (patch * rows + i)[:, None] * points + j[None, :]
        tl.store(to, tl.maximum(squares - 2.0 * product, 0.0), mask=(i < rows)[:, None] & (j < points)[None, :])

    @triton.jit  # type: ignore[untyped-decorator]
    def _nearest(  # type: ignore[no-untyped-def]
        x, out, points, rows,
        CHANNELS: tl.constexpr, K: tl.constexpr, POINTS: tl.constexpr, LANES: tl.constexpr, ROOM: tl.constexpr,
    ):  # fmt: skip
        """Select the K nearest of all points for one point of a patch, inside one warp, in any order.

        x: the points' CHANNELS coordinates, or where CHANNELS is 0 the squared distances of rows from points. A key is
        ROOM bits of a distance above the point's index: one comparison finds both.
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
            distance = tl.load(x + (patch * rows + i) * points + j, mask=j < points, other=0.0)
        # As integers, squared distances keep their order; of what they are above the row's least, the leading bits fit.
        bits = distance.to(tl.int32, bitcast=True)
        least = tl.min(tl.where(valid, bits, 0x7FFFFFFF), axis=0)
        reach = tl.maximum(tl.max(tl.where(valid, bits, 0), axis=0) - least, 0)
        length = (reach.to(tl.float32).to(tl.int32, bitcast=True) >> 23) - 126  # in bits: the exponent of a float
        key = tl.where(valid, ((bits - least) >> tl.maximum(length - ROOM, 0)) * POINTS + j, 0x7FFFFFFF)
        # The K-th of each lane's three least keys bounds the K-th of all: some K + 1 keep to it. It is sought by
        # halves, from the largest of the lanes' least down, until just K of the three are no larger.
        lanes = tl.reshape(key, (POINTS // LANES, LANES))  # the first axis lies within a lane: no key changes places
        first = tl.min(lanes, axis=0)
        second = tl.min(tl.where(lanes == first[None, :], 0x7FFFFFFF, lanes), axis=0)
        third = tl.min(tl.where(lanes <= second[None, :], 0x7FFFFFFF, lanes), axis=0)
        bound, low = tl.minimum(tl.max(first, axis=0), 0x7FFFFFFE), -1  # 0x7FFFFFFF is no point's
        held = _within(first, second, third, bound)
        while held > K:
            middle = low + (bound - low) // 2
            some = _within(first, second, third, middle)
            if some >= K:
                bound, held = middle, some
            else:
                low = middle
        known = tl.maximum(tl.where(first <= bound, first, 0), tl.where(second <= bound, second, 0))
        bound = tl.max(tl.maximum(known, tl.where(third <= bound, third, 0)), axis=0)  # the K-th itself
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

    @triton.jit
    def _within(first, second, third, bound):  # type: ignore[no-untyped-def]
        """Count how many of the lanes' three least keys are no larger than a bound."""
        held = (first <= bound).to(tl.int32) + (second <= bound).to(tl.int32) + (third <= bound).to(tl.int32)
        return tl.sum(held, axis=0)

    @triton.jit  # type: ignore[untyped-decorator]
    def edges_of(index, patch, first, rows, K: tl.constexpr, ROWS: tl.constexpr):  # type: ignore[no-untyped-def]
        """Return the edges of ROWS points of a patch, the point of each, whether it is there, and its neighbour."""
        edge = tl.arange(0, ROWS * K)
        own = first + edge // K
        there = own < rows
        return edge, own, there, tl.load(index + (patch * rows + own) * K + edge % K, mask=there, other=0)

    @triton.jit  # type: ignore[untyped-decorator]
    def _edge_max(  # type: ignore[no-untyped-def]
        a, b, index, weight, out, won, bias, skip, half, points, rows, out_channels, a_step, b_step, half_step,
        CHANNELS: tl.constexpr, STEP: tl.constexpr, K: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr,
        WON: tl.constexpr, WHOLE: tl.constexpr, ACTIVATION: tl.constexpr,
    ):  # fmt: skip
        """Gather, add, ReLU, multiply and take the maximum over the neighbours, for ROWS points of one patch.

        Rows of a and skip lie a_step apart, those of b b_step. Where WON, which neighbour has it comes out too: it
        takes the place of a sum's last bits. Where WHOLE, what comes out is that of the whole block, in float16, too.
        """
        patch = tl.program_id(0).to(tl.int64)
        first = tl.program_id(1) * ROWS
        edge, own, there, other = edges_of(index, patch, first, rows, K, ROWS)
        d = tl.program_id(2) * WIDTH + tl.arange(0, WIDTH)
        total = tl.zeros([ROWS * K, WIDTH], tl.float32)
        for start in range(0, CHANNELS, STEP):
            c = start + tl.arange(0, STEP)
            mine = tl.load(a + (patch * rows + own)[:, None] * a_step + c[None, :], mask=there[:, None], other=0.0)
            theirs = tl.load(b + (patch * points + other)[:, None] * b_step + c[None, :])
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
        if WON:
            tl.store(won + place, (best.to(tl.int32, bitcast=True) & (K - 1)).to(tl.uint8), mask=inside)
        if WHOLE:
            beside = tl.load(skip + (patch * rows + i)[:, None] * a_step + d[None, :], mask=inside, other=0.0)
            beside = beside.to(tl.float32)
            best += tl.load(bias + d, mask=d < out_channels, other=0.0)[None, :]
            best = tl.maximum(best, 0.0) + tl.maximum(beside, 0.0) if ACTIVATION else best + beside
            to = half + (patch * rows + i)[:, None] * half_step + d[None, :]
            tl.store(to, tl.clamp(best, -65504.0, 65504.0).to(tl.float16), mask=inside)
        if ACTIVATION or not WHOLE:  # the last block's features are no positions of a graph
            tl.store(out + place, best, mask=inside)

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
