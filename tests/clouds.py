"""Clouds on analytic surfaces, so that no test needs data."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["distance_to_torus", "even_sphere", "far_group", "noisy", "profiles", "sphere", "torus"]

_RING, _TUBE = 0.7, 0.3


def torus(count: int, seed: int = 0) -> npt.NDArray[np.float64]:
    """Sample (count, 3) float64 points of a torus around z inside the unit ball, nearly evenly."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0, 2 * np.pi, (2, 4 * count + 40))
    # The outer side has more area: keep a point in proportion to it.
    kept = rng.uniform(0, _RING + _TUBE, len(v)) < _RING + _TUBE * np.cos(v)
    u, v = u[kept][:count], v[kept][:count]
    ring = _RING + _TUBE * np.cos(v)
    return np.stack([ring * np.cos(u), ring * np.sin(u), _TUBE * np.sin(v)], axis=1)


def distance_to_torus(xyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return (N,) exact distances from `torus`."""
    return np.abs(np.hypot(np.hypot(xyz[:, 0], xyz[:, 1]) - _RING, xyz[:, 2]) - _TUBE)


def sphere(count: int, seed: int = 0) -> npt.NDArray[np.float64]:
    """Sample (count, 3) float64 points of the unit sphere."""
    xyz = np.random.default_rng(seed).standard_normal((count, 3))
    return xyz / np.linalg.norm(xyz, axis=1, keepdims=True)


def far_group(away: float, count: int = 12) -> npt.NDArray[np.float64]:
    """Put (count, 3) points together so far away that beside them a cloud is a scene; one alone is passed over."""
    return np.array([away, 0, 0]) + 0.01 * np.random.default_rng(7).standard_normal((count, 3))


def even_sphere(count: int) -> npt.NDArray[np.float64]:
    """Spread (count, 3) float64 points over the unit sphere along a golden spiral."""
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def noisy(xyz: npt.NDArray[np.float64], noise_std: float, seed: int = 1) -> npt.NDArray[np.float64]:
    """Add Gaussian noise of `noise_std`, in the cloud's unit."""
    return xyz + noise_std * np.random.default_rng(seed).standard_normal(xyz.shape)


def profiles(noise_std: float, ratio: int, count: int) -> npt.NDArray[np.float64]:
    """Return `count` profiles of a ball, `ratio` times as far apart as their points, with noise in their planes."""
    across = np.linspace(-0.97, 0.97, count)
    parts = []
    for y in across:
        radius = np.sqrt(1 - y * y)
        turn = np.linspace(0, 2 * np.pi, round(2 * np.pi * radius * ratio / (across[1] - across[0])), endpoint=False)
        parts.append(np.column_stack([radius * np.cos(turn), np.full(len(turn), y), radius * np.sin(turn)]))
    clean = np.concatenate(parts)
    beams = clean * [1.0, 0.0, 1.0] / np.linalg.norm(clean[:, ::2], axis=1, keepdims=True)
    rng = np.random.default_rng(0)
    out: npt.NDArray[np.float64] = clean + noise_std * beams * rng.standard_normal((len(clean), 1))
    return out
