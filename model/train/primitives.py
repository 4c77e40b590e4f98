"""Simple bodies in poses of their own, and solids made of them, whose surfaces are sampled exactly.

A solid is a union of parts less a union of holes; no mesh is in between, and normals are exact.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

__all__ = ["Box", "Cylinder", "Ellipsoid", "Primitive", "Ring", "Solid", "along", "log_uniform", "pose"]

Floats = npt.NDArray[np.float64]
Samples = tuple[Floats, Floats]  # points (N, 3) and their unit normals (N, 3)


@dataclass(frozen=True)
class Primitive(ABC):
    """A simple body in a pose of its own."""

    centre: Floats = field(default_factory=lambda: np.zeros(3))
    turn: Floats = field(default_factory=lambda: np.eye(3))  # columns: the body's axes

    def surface(self, rng: np.random.Generator, density: float) -> Samples:
        """Sample the boundary evenly, `density` points a unit of area."""
        xyz, normals = self._surface(rng, density)
        return xyz @ self.turn.T + self.centre, normals @ self.turn.T

    def contains(self, xyz: Floats) -> npt.NDArray[np.bool_]:
        """Say which points (N, 3) are inside: (N,)."""
        return self._contains((xyz - self.centre) @ self.turn)

    @abstractmethod
    def _surface(self, rng: np.random.Generator, density: float) -> Samples: ...

    @abstractmethod
    def _contains(self, xyz: Floats) -> npt.NDArray[np.bool_]: ...


@dataclass(frozen=True)
class Box(Primitive):
    """half: (3,) half its sides."""

    half: Floats = field(default_factory=lambda: np.ones(3))

    def _surface(self, rng: np.random.Generator, density: float) -> Samples:
        points, normals = [], []
        for axis in range(3):
            others = [i for i in range(3) if i != axis]
            for side in (-1.0, 1.0):
                face = rng.uniform(-1, 1, (rng.poisson(density * 4 * np.prod(self.half[others])), 3))
                face[:, axis] = side
                points.append(face * self.half)
                normals.append(np.broadcast_to(side * np.eye(3)[axis], face.shape))
        return np.concatenate(points), np.concatenate(normals)

    def _contains(self, xyz: Floats) -> npt.NDArray[np.bool_]:
        return np.asarray((np.abs(xyz) < self.half).all(axis=1))


@dataclass(frozen=True)
class Cylinder(Primitive):
    """Of a radius and half a height, along its z axis."""

    radius: float = 1.0
    half: float = 1.0

    def _surface(self, rng: np.random.Generator, density: float) -> Samples:
        around = rng.uniform(0, 2 * np.pi, rng.poisson(density * 4 * np.pi * self.radius * self.half))
        out = np.stack([np.cos(around), np.sin(around), np.zeros_like(around)], axis=1)
        points, normals = [self.radius * out], [out]
        points[0][:, 2] = rng.uniform(-self.half, self.half, len(around))
        for side in (-1.0, 1.0):
            count = rng.poisson(density * np.pi * self.radius**2)
            around, reach = rng.uniform(0, 2 * np.pi, count), self.radius * np.sqrt(rng.random(count))
            disc = [reach * np.cos(around), reach * np.sin(around), np.full(count, side * self.half)]
            points.append(np.stack(disc, axis=1))
            normals.append(np.broadcast_to([0.0, 0.0, side], (count, 3)))
        return np.concatenate(points), np.concatenate(normals)

    def _contains(self, xyz: Floats) -> npt.NDArray[np.bool_]:
        return (np.hypot(xyz[:, 0], xyz[:, 1]) < self.radius) & (np.abs(xyz[:, 2]) < self.half)


@dataclass(frozen=True)
class Ring(Cylinder):
    """A cylinder less a bore of radius `inner` along its axis."""

    inner: float = 0.5

    def _surface(self, rng: np.random.Generator, density: float) -> Samples:
        points, normals = super()._surface(rng, density)
        kept = np.hypot(points[:, 0], points[:, 1]) >= self.inner
        inside, inwards = Cylinder(radius=self.inner, half=self.half)._surface(rng, density)
        wall = np.abs(inwards[:, 2]) < 0.5
        return np.concatenate([points[kept], inside[wall]]), np.concatenate([normals[kept], -inwards[wall]])

    def _contains(self, xyz: Floats) -> npt.NDArray[np.bool_]:
        return super()._contains(xyz) & (np.hypot(xyz[:, 0], xyz[:, 1]) > self.inner)


@dataclass(frozen=True)
class Ellipsoid(Primitive):
    """half: (3,) its semi-axes."""

    half: Floats = field(default_factory=lambda: np.ones(3))

    def _surface(self, rng: np.random.Generator, density: float) -> Samples:
        # A patch of the unit sphere grows by |h1 h2 h3| |n / h|, by this factor's bound at most: rejection.
        bound = np.prod(self.half) / self.half.min()
        ball = rng.standard_normal((rng.poisson(density * 4 * np.pi * bound), 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        normals = ball / self.half
        growth = np.linalg.norm(normals, axis=1)
        kept = rng.random(len(ball)) < growth * self.half.min()
        return ball[kept] * self.half, normals[kept] / growth[kept, None]

    def _contains(self, xyz: Floats) -> npt.NDArray[np.bool_]:
        return np.asarray(np.square(xyz / self.half).sum(axis=1) < 1)


@dataclass(frozen=True)
class Solid:
    """A union of parts less a union of holes."""

    parts: Sequence[Primitive]
    holes: Sequence[Primitive] = ()

    def contains(self, xyz: Floats) -> npt.NDArray[np.bool_]:
        """Say which points (N, 3) are inside: (N,)."""
        return self._in_any(xyz, self.parts) & ~self._in_any(xyz, self.holes)

    def sample(self, rng: np.random.Generator, count: int) -> Samples:
        """Sample about `count` points of the boundary, evenly."""
        rough = len(self._at(rng, 200.0)[0]) / 200.0
        return self._at(rng, count / rough)

    def _at(self, rng: np.random.Generator, density: float) -> Samples:
        points, normals = [], []
        for part in self.parts:
            xyz, outward = part.surface(rng, density)
            shown = ~self._in_any(xyz, [*(p for p in self.parts if p is not part), *self.holes])
            points.append(xyz[shown])
            normals.append(outward[shown])
        for hole in self.holes:
            xyz, outward = hole.surface(rng, density)
            shown = self._in_any(xyz, self.parts) & ~self._in_any(xyz, [h for h in self.holes if h is not hole])
            points.append(xyz[shown])
            normals.append(-outward[shown])
        return np.concatenate(points), np.concatenate(normals)

    @staticmethod
    def _in_any(xyz: Floats, bodies: Sequence[Primitive]) -> npt.NDArray[np.bool_]:
        held = np.zeros(len(xyz), dtype=bool)
        for body in bodies:
            held |= body.contains(xyz)
        return held


def log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """Draw a size whose logarithm is uniform between those of two bounds."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


def pose(rng: np.random.Generator, z: int) -> Floats:
    """Return a pose whose z axis is one of the three, off by a little: no two faces shall coincide."""
    turn = np.roll(np.eye(3), z + 1, axis=1)
    small: Floats = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix()
    return small @ turn


def along(direction: Floats) -> Floats:
    """Return a pose whose z axis points along `direction`."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, [1.0, 0, 0] if abs(z[0]) < 0.9 else [0, 1.0, 0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
