"""The same loops for CUDA, in Triton: neighbour search, the EdgeConv maximum without the edge tensor, farthest points.

Tested through Triton's interpreter and compiled for Hopper; not yet run on a GPU (docs/kernels.md). Where Triton is
missing, or the kernels do not do what their torch twins do, `load()` returns False and the twins do the work.
"""

from __future__ import annotations

import functools
import os
import warnings

import torch

try:
    import triton
    import triton.language as tl
except ImportError:  # a CPU build of torch comes without it
    triton = None

__all__ = ["MOST_FARTHEST", "MOST_POINTS", "edge_max", "farthest", "knn", "load"]

MOST_POINTS = 2048  # of a patch; its indices fill the low bits of a key, and a warp's registers hold two rows of keys
_ROWS = 2
_DIRECT = 8  # with fewer channels distances are differences, exact; with more, products
_EDGE_POINTS = 4  # whose 32 edges each make a tile of 128 rows
MOST_FARTHEST = 1 << 17  # points; of more, one program is slower than launches over the whole device
_FARTHEST_BLOCK = 4096


@functools.cache
def load() -> bool:
    """Tell whether the kernels run on this machine's GPU, each once in the shapes that the filter has."""
    if triton is None or os.environ.get("STRAIGHTPCF_NO_KERNELS"):
        return False
    try:
        _prove(torch.device("cuda"), 1000)
    except Exception as exc:  # the compiler's own errors have no common base
        warnings.warn(f"the Triton kernels do not run here, plain torch does: {exc}", stacklevel=2)
        return False
    return True


def knn(x: torch.Tensor, k: int, rows: int) -> torch.Tensor:
    """Do what `ops.knn` does for at most MOST_POINTS points a patch; returns int32 indices.

    Squared distances that agree in their leading bits, 12 at least and mostly 15 or more, go by index.
    """
    batch, points, channels = x.shape
    if points > MOST_POINTS:
        raise ValueError(f"a patch of {points} points; the kernel takes {MOST_POINTS}")
    out = torch.empty(batch, rows, k, dtype=torch.int32, device=x.device)
    direct, size = channels < _DIRECT, triton.next_power_of_2(points)
    given = squares = x.contiguous()
    if not direct:
        given, squares = torch.bmm(x[:, :rows], x.mT), x.square().sum(dim=2)
    _nearest[batch, triton.cdiv(rows, _ROWS)](
        given, squares, out, points, rows,
        CHANNELS=channels if direct else 0, K=k, ROWS=_ROWS, POINTS=size, ROOM=31 - size.bit_length(), num_warps=1,
    )  # fmt: skip
    return out


def edge_max(a: torch.Tensor, b: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Do what `ops.edge_max` does, in float16 products with float32 sums; channels a multiple of 16, no gradient."""
    batch, rows, channels = a.shape
    out_channels, k = weight.shape[0], index.shape[2]
    out = torch.empty(batch, rows, out_channels, dtype=torch.float32, device=a.device)
    width = min(128, triton.next_power_of_2(out_channels))
    _edge_max[batch, triton.cdiv(rows, _EDGE_POINTS), triton.cdiv(out_channels, width)](
        a.to(torch.float16).contiguous(), b.to(torch.float16).contiguous(), index.contiguous(),
        weight.to(torch.float16).contiguous(), out, b.shape[1], rows, out_channels,
        CHANNELS=channels, STEP=min(64, channels & -channels), K=k, ROWS=_EDGE_POINTS, WIDTH=width, num_warps=8,
    )  # fmt: skip
    return out


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


def _distances(x: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Return the squared distances of the points (1, P, C) from others of theirs (1, P, k), ascending."""
    return (x[0][index[0].long()] - x[0][:, None]).square().sum(dim=2).sort(dim=1).values


if triton is not None:
    # Their parameters bear no annotations but tl.constexpr: the compiler would evaluate them.

    @triton.jit  # type: ignore[untyped-decorator]
    def _nearest(  # type: ignore[no-untyped-def]
        x, squares, out, points, rows,
        CHANNELS: tl.constexpr, K: tl.constexpr, ROWS: tl.constexpr, POINTS: tl.constexpr, ROOM: tl.constexpr,
    ):  # fmt: skip
        """Select the K nearest of all points for ROWS points of one patch, by K minima inside one warp.

        x: the points' CHANNELS coordinates, or where CHANNELS is 0 the products of rows with points, and `squares`
        their squared lengths. A key is ROOM bits of a distance above the point's index: one comparison finds both.
        """
        patch = tl.program_id(0).to(tl.int64)
        i = tl.program_id(1) * ROWS + tl.arange(0, ROWS)
        j = tl.arange(0, POINTS)
        there = (i < rows)[:, None] & (j < points)[None, :]
        if CHANNELS > 0:
            distance = tl.zeros([ROWS, POINTS], tl.float32)
            for c in tl.static_range(CHANNELS):
                own = tl.load(x + (patch * points + i) * CHANNELS + c, mask=i < rows, other=0.0)
                other = tl.load(x + (patch * points + j) * CHANNELS + c, mask=j < points, other=0.0)
                apart = own[:, None] - other[None, :]
                distance += apart * apart
        else:
            own = tl.load(squares + patch * points + i, mask=i < rows, other=0.0)
            other = tl.load(squares + patch * points + j, mask=j < points, other=0.0)
            product = tl.load(x + (patch * rows + i)[:, None] * points + j[None, :], mask=there, other=0.0)
            distance = tl.maximum(own[:, None] + other[None, :] - 2.0 * product, 0.0)
        # As integers, squared distances keep their order; of what they are above the row's least, the leading bits fit.
        valid = there & (j[None, :] != i[:, None])
        bits = distance.to(tl.int32, bitcast=True)
        least = tl.min(tl.where(valid, bits, 0x7FFFFFFF), axis=1)
        reach = tl.maximum(tl.max(tl.where(valid, bits, 0), axis=1) - least, 0)
        length = (reach.to(tl.float32).to(tl.int32, bitcast=True) >> 23) - 126  # in bits: the exponent of a float
        key = ((bits - least[:, None]) >> tl.maximum(length - ROOM, 0)[:, None]) * POINTS + j[None, :]
        key = tl.where(valid, key, 0x7FFFFFFF)
        last = tl.zeros([ROWS], tl.int32)
        for n in range(K):
            nearest = tl.min(key, axis=1)
            last = tl.where(nearest < 0x7FFFFFFF, nearest & (POINTS - 1), last)  # too few points: the farthest again
            tl.store(out + (patch * rows + i) * K + n, last, mask=i < rows)
            key = tl.where(key == nearest[:, None], 0x7FFFFFFF, key)

    @triton.jit  # type: ignore[untyped-decorator]
    def _edge_max(  # type: ignore[no-untyped-def]
        a, b, index, weight, out, points, rows, out_channels,
        CHANNELS: tl.constexpr, STEP: tl.constexpr, K: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr,
    ):  # fmt: skip
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

    @triton.jit  # type: ignore[untyped-decorator]
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
