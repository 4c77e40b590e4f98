"""Functions of a place that are below zero inside a body, with their gradients, and how bodies are put together.

A field takes points (N, 3) float64 and returns values (N,), no steeper than 1, and gradients (N, 3). Where two meet
the seam is rounded: a log-sum-exp takes the place of the minimum.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

__all__ = [
    "Field",
    "ball",
    "block",
    "intersection",
    "less",
    "moved",
    "plane",
    "post",
    "shell",
    "torus",
    "union",
    "widened",
]

Floats = npt.NDArray[np.float64]
Field = Callable[[Floats], tuple[Floats, Floats]]

_TINY = 1e-12


def plane(normal: Floats, offset: float) -> Field:
    """Return the half-space below the plane n . x = offset, n a unit vector (3,)."""
    return lambda xyz: (xyz @ normal - offset, np.broadcast_to(normal, xyz.shape))


def block(half: Floats, rounding: float) -> Field:
    """Return a box of half sides `half` (3,) about the origin, its edges rounded."""

    def field(xyz: Floats) -> tuple[Floats, Floats]:
        value, gradient = _rounded(np.abs(xyz) - (half - rounding), rounding)
        return value, gradient * np.where(xyz < 0, -1.0, 1.0)

    return field


def post(radius: float, half: float, rounding: float) -> Field:
    """Return a cylinder about the z axis, its rims rounded."""

    def field(xyz: Floats) -> tuple[Floats, Floats]:
        reach = np.hypot(xyz[:, 0], xyz[:, 1])
        beyond = np.stack([reach - (radius - rounding), np.abs(xyz[:, 2]) - (half - rounding)], axis=1)
        value, gradient = _rounded(beyond, rounding)
        out = xyz[:, :2] / np.maximum(reach, _TINY)[:, None]
        up = np.where(xyz[:, 2] < 0, -1.0, 1.0)
        return value, np.column_stack([gradient[:, :1] * out, gradient[:, 1] * up])

    return field


def torus(radius: float, tube: float) -> Field:
    """Return a ring about the z axis."""

    def field(xyz: Floats) -> tuple[Floats, Floats]:
        reach = np.hypot(xyz[:, 0], xyz[:, 1])
        off = np.stack([reach - radius, xyz[:, 2]], axis=1)
        length = np.maximum(np.linalg.norm(off, axis=1), _TINY)
        out = xyz[:, :2] / np.maximum(reach, _TINY)[:, None]
        return length - tube, np.column_stack([off[:, :1] / length[:, None] * out, off[:, 1] / length])

    return field


def ball(radius: float) -> Field:
    """Return a ball about the origin."""
    return torus(0.0, radius)


def moved(field: Field, centre: Floats, turn: Floats) -> Field:
    """Return the same body at `centre` (3,), its axes the columns of `turn` (3, 3)."""

    def there(xyz: Floats) -> tuple[Floats, Floats]:
        value, gradient = field((xyz - centre) @ turn)
        return value, gradient @ turn.T

    return there


def widened(field: Field, by: float) -> Field:
    """Return a body that reaches that much farther; less, where `by` is below zero."""

    def wide(xyz: Floats) -> tuple[Floats, Floats]:
        value, gradient = field(xyz)
        return value - by, gradient

    return wide


def shell(field: Field, wall: float) -> Field:
    """Return a wall of that thickness, half of it on either side of a body's surface."""

    def hollow(xyz: Floats) -> tuple[Floats, Floats]:
        value, gradient = field(xyz)
        return np.abs(value) - wall / 2, gradient * np.where(value < 0, -1.0, 1.0)[:, None]

    return hollow


def union(blend: float, *fields: Field) -> Field:
    """Return what is in any; `blend`: how far around a seam it is rounded."""

    def joined(xyz: Floats) -> tuple[Floats, Floats]:
        values, gradients = zip(*(field(xyz) for field in fields), strict=True)
        every = np.stack(values)
        nearest = every.min(axis=0)
        weights = np.exp((nearest - every) / blend)
        total = weights.sum(axis=0)
        return nearest - blend * np.log(total), np.einsum("fn,fnd->nd", weights / total, np.stack(gradients))

    return joined


def intersection(blend: float, *fields: Field) -> Field:
    """Return what is in all."""
    return _opposite(union(blend, *map(_opposite, fields)))


def less(blend: float, field: Field, *holes: Field) -> Field:
    """Return what is in the first and in none of the others."""
    return intersection(blend, field, *map(_opposite, holes))


def _opposite(field: Field) -> Field:
    def outside(xyz: Floats) -> tuple[Floats, Floats]:
        value, gradient = field(xyz)
        return -value, -gradient

    return outside


def _rounded(beyond: Floats, rounding: float) -> tuple[Floats, Floats]:
    """Return distance and gradient of a corner, `beyond` (N, D) how far a point is outside each of its sides."""
    out = np.maximum(beyond, 0)
    length = np.linalg.norm(out, axis=1)
    deepest = beyond.max(axis=1)
    inside = deepest <= 0
    side = np.eye(beyond.shape[1])[beyond.argmax(axis=1)]
    gradient = np.where(inside[:, None], side, out / np.maximum(length, _TINY)[:, None])
    return np.where(inside, deepest, length) - rounding, gradient
