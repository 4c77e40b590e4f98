"""Spread points evenly along the surface, between two passes of the filter."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree

from straightpcf.model.processor import Floats, Mapper

__all__ = ["ROUNDS", "TANGENT_NEIGHBOURS", "spread", "spread_among"]

TANGENT_NEIGHBOURS = 16  # of which the tangent plane is taken
ROUNDS = 2  # but where noise is strong: `Sampling.spread_rounds`
_PUSH_SHARE = 0.2  # of the mean distance to these, what a round moves by
_PUSHING_NEIGHBOURS = 8
# The length of the mean direction to a point's neighbours: 0 where they are all around, 0.64 on a straight border.
_BORDER, _INSIDE = 0.5, 0.3
_CHUNKS = {"cpu": 1 << 12, "cuda": 1 << 15}  # points at once: what the cache holds, what a batched product takes
_TINY = torch.finfo(torch.float64).tiny


def spread(xyz: Floats, limit: float, *, rounds: int = ROUNDS, workers: int = 1, mapper: Mapper = map) -> Floats:
    """Return how far each of the points (N, 3) goes to be farther from its nearest ones: (N, 3), along the surface.

    Noise moves points along a surface as far as across it, and leaves them in clumps and gaps that no clean cloud has;
    where each came from cannot be known, but that they were apart can. A weighted repulsion in the tangent plane, as in
    LOP (Lipman et al. 2007, "Parameterization-free projection for geometry reconstruction"). limit: the farthest that
    any goes, in the unit of xyz; rounds: how often all are pushed. Points of a border, whose neighbours
    are all on one side, stay. workers: threads that look up neighbours; mapper: calls a function with chunks of the
    points, in any order, on threads if it has some.
    """
    _, index = cKDTree(xyz).query(xyz, k=min(TANGENT_NEIGHBOURS, len(xyz) - 1) + 1, workers=workers)
    around = torch.from_numpy(index[:, 1:].astype(np.int32))
    moved: Floats = spread_among(torch.from_numpy(xyz), around, limit, rounds=rounds, mapper=mapper).numpy()
    return moved


def spread_among(
    xyz: torch.Tensor, around: torch.Tensor, limit: float, *, rounds: int, mapper: Mapper = map
) -> torch.Tensor:
    """Do what `spread` does for points (N, 3) float64 on any device.

    around: (N, k) rows of each point's nearest others, nearest first.
    """
    pushing = around[:, :_PUSHING_NEIGHBOURS]
    step = _CHUNKS[xyz.device.type]
    chunks = [slice(start, start + step) for start in range(0, len(xyz), step)]
    normal, free, moved = torch.empty_like(xyz), torch.empty_like(xyz[:, :1]), torch.empty_like(xyz)

    def look(some: slice) -> None:
        apart = xyz[around[some].long()] - xyz[some, None]  # (n, k, 3)
        one_sided = _length((apart / _length(apart).clamp(min=_TINY)).mean(dim=1))
        normal[some] = _normals(apart)
        free[some] = ((_BORDER - one_sided) / (_BORDER - _INSIDE)).clamp(0, 1)

    def push(here: torch.Tensor, there: torch.Tensor, some: slice) -> None:
        away = here[some, None] - here[pushing[some].long()]
        far = _length(away)
        reach = far.amax(dim=1, keepdim=True).clamp(min=_TINY)
        force = (away * (1 / far.clamp(min=_TINY) - 1 / reach)).sum(dim=1)
        force *= _PUSH_SHARE * far.mean(dim=1) * free[some]
        there[some] = here[some] + force - (force * normal[some]).sum(dim=1, keepdim=True) * normal[some]

    def limited(here: torch.Tensor, some: slice) -> None:
        far = here[some] - xyz[some]
        moved[some] = far * (limit / _length(far).clamp(min=_TINY)).clamp(max=1)

    # Nothing is done with all points at once: torch would share that among OpenMP's threads, which take twenty times
    # as long where another process has one of the cores.
    _all(mapper(look, chunks))
    here = xyz
    for _ in range(rounds):
        there = torch.empty_like(xyz)
        _all(mapper(partial(push, here, there), chunks))
        here = there
    _all(mapper(partial(limited, here), chunks))
    return moved


def _all(calls: Iterable[None]) -> None:
    for _ in calls:
        pass


def _length(vectors: torch.Tensor) -> torch.Tensor:
    """Return the lengths of (..., 3) vectors, (..., 1)."""
    return (vectors * vectors).sum(dim=-1, keepdim=True).sqrt()


def _normals(around: torch.Tensor) -> torch.Tensor:
    """Return (n, 3) directions in which (n, k, 3) points spread least; of length 0 where they are in a line.

    The inverse of their covariance, taken as its adjugate to the fourth power, is that direction times itself. An
    approximation, unsigned, where `recompute_normals` is exact: eigenvectors took most of a spread's time.
    """
    centred = around - around.mean(dim=1, keepdim=True)
    covariance = centred.mT @ centred  # (n, 3, 3)
    covariance /= covariance.diagonal(dim1=1, dim2=2).sum(dim=1).clamp(min=_TINY)[:, None, None]
    x, y, z = covariance.unbind(dim=1)
    adjugate = torch.stack([torch.cross(y, z, dim=1), torch.cross(z, x, dim=1), torch.cross(x, y, dim=1)], dim=1)
    for _ in range(2):
        adjugate /= adjugate.abs().amax(dim=(1, 2), keepdim=True).clamp(min=_TINY)
        adjugate = adjugate @ adjugate
    longest = _length(adjugate).argmax(dim=1, keepdim=True).expand(-1, -1, 3)
    normal = adjugate.gather(1, longest)[:, 0]
    return normal / _length(normal).clamp(min=_TINY)
