"""The authors' way to compute, straightforward and independent of `straightpcf.model`: the check and the yardstick.

6 N / 1000 farthest-point seeds, the first layer of every EdgeConv on explicit (B, P, k, 2C) edges, kNN as a full
distance matrix and `torch.topk`, float32, and for each point the patch whose seed is relatively nearest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch.nn.functional import batch_norm, linear

__all__ = ["Reference", "denoise", "distance", "euler", "part", "straightpcf", "velocity"]

State = Mapping[str, torch.Tensor]
PATCH_SIZE = 1000
SEEDS_PER_PATCH = 6  # every point lies in six patches on average
NEIGHBOURS = 32


@dataclass(frozen=True)
class Reference:
    """Hold what `denoise` found.

    xyz: (N, 3) float64; uncovered: points in no patch, left where they were; seconds: for the whole cloud,
    extrapolated from `timed_patches` of `patches` where these differ (then xyz is only partly moved).
    """

    xyz: npt.NDArray[np.float64]
    uncovered: int
    seconds: float
    patches: int
    timed_patches: int


def denoise(
    xyz: npt.NDArray[Any],
    move: Callable[[torch.Tensor], torch.Tensor],
    *,
    passes: int = 1,
    batch: int = 4,
    sample: int | None = None,
) -> Reference:
    """Filter xyz (N, 3), N >= 1000, with `move`, which maps patches (B, 1000, 3) to their new positions.

    sample: time only so many patches a pass and extrapolate.
    """
    start, extra, patches, timed, uncovered = time.perf_counter(), 0.0, 0, 0, 0
    result = np.asarray(xyz, dtype=np.float64)
    for _ in range(passes):
        centre = (result.min(axis=0) + result.max(axis=0)) / 2
        scale = np.linalg.norm(result - centre, axis=1).max()
        cloud = torch.from_numpy((result - centre) / scale).float()
        members, relative = _patches(cloud, _farthest_points(cloud, SEEDS_PER_PATCH * len(cloud) // PATCH_SIZE))
        patches += len(members)
        chosen = members if sample is None else members[:: max(1, len(members) // sample)][:sample]
        began = time.perf_counter()
        moved = _move(cloud, chosen, move, batch)
        extra += (time.perf_counter() - began) * (len(members) / len(chosen) - 1)
        timed += len(chosen)
        if len(chosen) == len(members):
            cloud, uncovered = _stitched(cloud, members, relative, moved)
            result = cloud.double().numpy() * scale + centre
    return Reference(result, uncovered, time.perf_counter() - start + extra, patches, timed)


def velocity(state: State, x: torch.Tensor) -> torch.Tensor:
    """Return a VelocityModule's (B, P, 3) velocities of patches x (B, P, 3)."""
    return _decode(state, _encode(state, x), pool=False)


def distance(state: State, x: torch.Tensor) -> torch.Tensor:
    """Return a DistanceModule's (B, 1) distances of patches x (B, P, 3), in our frame (docs/training.md)."""
    return torch.sigmoid(_decode(state, _encode(state, 4 * x), pool=True))


def euler(modules: list[State], x: torch.Tensor, *, steps: int, scale: torch.Tensor | float = 1.0) -> torch.Tensor:
    """Move patches x (B, P, 3): `steps` rounds through the modules, scale / (steps x modules) of a velocity each."""
    for _ in range(steps):
        for state in modules:
            x = x + scale / (steps * len(modules)) * velocity(state, x)
    return x


def straightpcf(state: State, *, couplings: int, steps: int = 3) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return the paper's whole step on patches from the tensors of a `StraightPCF` of this project."""
    modules = [part(state, f"velocity_modules.{i}.") for i in range(couplings)]
    head = part(state, "distance_module.")
    return lambda x: euler(modules, x, steps=steps, scale=distance(head, x)[:, :, None])


def part(state: State, prefix: str) -> State:
    """Return the tensors whose keys start with `prefix`, without it."""
    return {key.removeprefix(prefix): tensor for key, tensor in state.items() if key.startswith(prefix)}


def _farthest_points(cloud: torch.Tensor, count: int) -> torch.Tensor:
    """Return `count` indices, the first point first and then always the one farthest from all before."""
    chosen = torch.zeros(count, dtype=torch.long)
    nearest = torch.full((len(cloud),), torch.inf)
    for i in range(1, count):
        nearest = torch.minimum(nearest, (cloud - cloud[chosen[i - 1]]).square().sum(dim=1))
        chosen[i] = nearest.argmax()
    return chosen


def _patches(cloud: torch.Tensor, seeds: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return members (S, 1000), the seed first, and their distances in units of the patch's radius, (S, 1000)."""
    found = torch.cdist(cloud[seeds], cloud, compute_mode="donot_use_mm_for_euclid_dist").topk(
        PATCH_SIZE, largest=False
    )
    return found.indices, found.values / found.values[:, -1:]


def _move(
    cloud: torch.Tensor, members: torch.Tensor, move: Callable[[torch.Tensor], torch.Tensor], batch: int
) -> torch.Tensor:
    moved = []
    with torch.inference_mode():
        for some in torch.split(members, batch):
            seed = cloud[some[:, :1]]
            moved.append(move(cloud[some] - seed) + seed)
    return torch.cat(moved)


def _stitched(
    cloud: torch.Tensor, members: torch.Tensor, relative: torch.Tensor, moved: torch.Tensor
) -> tuple[torch.Tensor, int]:
    """Give each point its place in the patch where it is relatively nearest to the seed."""
    result, closest = cloud.clone(), torch.full((len(cloud),), torch.inf)
    for index, reach, places in zip(members, relative, moved, strict=True):
        nearer = reach < closest[index]
        closest[index[nearer]] = reach[nearer]
        result[index[nearer]] = places[nearer]
    return result, int(closest.isinf().sum())


def _encode(state: State, x: torch.Tensor) -> torch.Tensor:
    h1 = _edge_conv(part(state, "encoder.conv1."), x, _neighbours(x), activation=True)
    h2 = _edge_conv(part(state, "encoder.conv2."), h1, _neighbours(h1), activation=True)
    return _edge_conv(part(state, "encoder.conv3."), torch.cat([h1, h2], dim=2), _neighbours(h2), activation=False)


def _neighbours(x: torch.Tensor) -> torch.Tensor:
    """Return the (B, P, k) nearest others of x (B, P, C)."""
    distance = torch.cdist(x, x)
    distance.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    return distance.topk(NEIGHBOURS, largest=False).indices


def _edge_conv(state: State, x: torch.Tensor, index: torch.Tensor, *, activation: bool) -> torch.Tensor:
    batch, points, width = x.shape
    flat = index.reshape(batch, points * NEIGHBOURS, 1).expand(-1, -1, width)
    other = x.gather(1, flat).view(batch, points, NEIGHBOURS, width)
    own = x[:, :, None].expand_as(other)
    edges = torch.cat([own, other - own], dim=3)  # (B, P, k, 2C)
    hidden = torch.relu(linear(edges, state["mlp.0.weight"], state["mlp.0.bias"]))
    messages = linear(hidden, state["mlp.2.weight"], state["mlp.2.bias"])  # (B, P, k, D)
    skip = linear(x, state["lin.weight"], state["lin.bias"])
    if activation:
        messages, skip = torch.relu(messages), torch.relu(skip)
    return messages.amax(dim=2) + skip


def _decode(state: State, features: torch.Tensor, *, pool: bool) -> torch.Tensor:
    h = features.flatten(0, 1)
    for layer in (1, 2):
        norm = part(state, f"decoder.bn_{layer}_out.")
        h = linear(h, state[f"decoder.lin_{layer}.weight"], state[f"decoder.lin_{layer}.bias"])
        h = torch.relu(batch_norm(h, norm["running_mean"], norm["running_var"], norm["weight"], norm["bias"]))
    h = h.view(*features.shape[:2], -1)
    return linear(h.amax(dim=1) if pool else h, state["decoder.lin_3.weight"], state["decoder.lin_3.bias"])
