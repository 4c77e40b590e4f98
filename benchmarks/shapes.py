"""Clouds with a known surface: the PUNet test split where it is at hand, and analytic shapes with their meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from straightpcf.model.metrics import unit_sphere
from straightpcf.model.run import MIN_POINTS
from straightpcf.model.train.archive import opened
from straightpcf.points.errors import InvalidOptions

__all__ = ["ANALYTIC", "NOISE_TYPES", "Shape", "analytic", "evenly_on", "make_noise", "punet", "turned"]

Floats = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]
Mesh = tuple[Floats, Faces]

# The paper's anisotropic covariance, in units of s^2.
ANISOTROPIC = np.array([[1, -1 / 2, -1 / 4], [-1 / 2, 1, -1 / 4], [-1 / 4, -1 / 4, 1]])


@dataclass(frozen=True)
class Shape:
    """Hold a clean cloud (N, 3), its exact surface, and published noisy inputs by noise level where there are any."""

    name: str
    clean: Floats
    vertices: Floats
    faces: Faces
    noisy: dict[float, Floats]


def punet(data: Path, resolution: int, names: list[str] | None = None) -> list[Shape]:
    """Read the PUNet test shapes from `data`/punet_test.npz, all 20 or those named."""
    with opened(data / "punet_test.npz") as file:
        known = sorted({key.split("/")[0] for key in file.files})
        if unknown := set(names or ()) - set(known):
            raise SystemExit(f"no shape {', '.join(sorted(unknown))}; known: {', '.join(known)}")
        return [
            Shape(
                name,
                file[f"{name}/{resolution}"].astype(np.float64),
                file[f"{name}/vertices"],
                file[f"{name}/faces"].astype(np.int64),
                {s: file[f"{name}/{resolution}/noisy_{s}"].astype(np.float64) for s in (0.01, 0.02, 0.03)},
            )
            for name in names or known
        ]


def analytic(resolution: int, names: list[str] | None = None) -> list[Shape]:
    """Sample the shapes of ANALYTIC, all or those named, evenly with a fixed seed.

    Raises InvalidOptions for fewer points than can be filtered.
    """
    if resolution < MIN_POINTS:
        raise InvalidOptions(f"{resolution} points; at least {MIN_POINTS} can be filtered")
    if unknown := set(names or ()) - set(ANALYTIC):
        raise SystemExit(f"no shape {', '.join(sorted(unknown))}; known: {', '.join(ANALYTIC)}")
    made = []
    for name in names or ANALYTIC:
        vertices, faces = ANALYTIC[name]()
        rng = np.random.default_rng(list(name.encode()))
        made.append(Shape(name, evenly_on(vertices, faces, resolution, rng), vertices, faces, {}))
    return made


def make_noise(kind: str, clean: Floats, level: float, seed: int) -> Floats:
    """Return clean (N, 3) plus noise of size level x R, R the cloud's unit-sphere radius; same seed, same bytes."""
    _, radius = unit_sphere(clean)
    rng = np.random.default_rng([seed, round(level * 1e6), list(NOISE_TYPES).index(kind)])
    return clean + level * radius * NOISE_TYPES[kind](rng, len(clean))


def _uniform_ball(rng: np.random.Generator, count: int) -> Floats:
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(direction * rng.uniform(size=(count, 1)) ** (1 / 3))


NOISE_TYPES: dict[str, Callable[[np.random.Generator, int], Floats]] = {
    "gaussian": lambda rng, count: rng.normal(size=(count, 3)),
    "anisotropic": lambda rng, count: rng.multivariate_normal(np.zeros(3), ANISOTROPIC, size=count),
    "laplace": lambda rng, count: rng.laplace(size=(count, 3)),
    "uniform": _uniform_ball,
}


def evenly_on(vertices: Floats, faces: Faces, count: int, rng: np.random.Generator) -> Floats:
    """Sample `count` points of a mesh that keep their distance, as a Poisson sampling does: (count, 3)."""
    return _spread(_on_mesh(vertices, faces, 5 * count, rng), count)


def _on_mesh(vertices: Floats, faces: Faces, count: int, rng: np.random.Generator) -> Floats:
    """Sample `count` points uniformly by area."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(faces), size=count, p=area / area.sum())
    u, v = np.sqrt(rng.uniform(size=(count, 1))), rng.uniform(size=(count, 1))
    return np.asarray((1 - u) * a[chosen] + u * (1 - v) * b[chosen] + u * v * c[chosen])


def _spread(points: Floats, count: int) -> Floats:
    """Thin out to `count` points that keep their distance, as a Poisson sampling does."""
    import fpsample

    chosen = fpsample.bucket_fps_kdline_sampling(points.astype(np.float32), count, 7, 0)
    return np.asarray(points[np.asarray(chosen, dtype=np.int64)])


def _grid(rows: int, columns: int, *, round_rows: bool = False, round_columns: bool = False) -> Faces:
    """Triangulate a rows x columns grid of vertices, closed in the directions that go round."""
    grid = np.meshgrid(np.arange(rows - (not round_rows)), np.arange(columns - (not round_columns)), indexing="ij")
    i, j = grid[0].ravel(), grid[1].ravel()
    below, right = (i + 1) % rows, (j + 1) % columns
    a, b, c, d = i * columns + j, below * columns + j, below * columns + right, i * columns + right
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def turned(profile: Floats, around: int = 96) -> Mesh:
    """Turn a profile (M, 2) of radius and height about the z axis."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    xy = profile[:, None, :1] * ring
    z = np.broadcast_to(profile[:, None, 1:], (len(profile), around, 1))
    faces = _grid(len(profile), around, round_columns=True)
    vertices = np.concatenate([xy, z], axis=2).reshape(-1, 3)
    corner = vertices[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return vertices, faces[area > 1e-12]  # the quads at a pole are half empty


def _sphere() -> Mesh:
    angle = np.linspace(0, np.pi, 64)
    return turned(np.stack([np.sin(angle), np.cos(angle)], axis=1))


def _torus() -> Mesh:
    a, b = np.meshgrid(np.arange(128) * 2 * np.pi / 128, np.arange(48) * 2 * np.pi / 48, indexing="ij")
    ring = 0.7 + 0.3 * np.cos(b)
    vertices = np.stack([ring * np.cos(a), ring * np.sin(a), 0.3 * np.sin(b)], axis=2).reshape(-1, 3)
    return vertices, _grid(128, 48, round_rows=True, round_columns=True)


def _box(x: float, y: float, z: float, cells: int = 24) -> Mesh:
    """Build the six faces of a box of half edges x, y, z, each a grid so that triangles stay small."""
    s, t = (g.ravel() for g in np.meshgrid(np.linspace(-1, 1, cells), np.linspace(-1, 1, cells), indexing="ij"))
    one = np.ones_like(s)
    sides = [np.stack(order, axis=1) for sign in (one, -one) for order in ([sign, s, t], [s, sign, t], [s, t, sign])]
    faces = [_grid(cells, cells) + side * cells**2 for side in range(6)]
    return np.concatenate(sides) * [x, y, z], np.concatenate(faces)


def _cylinder() -> Mesh:
    up = np.linspace(-0.8, 0.8, 40)
    out = np.linspace(0, 0.5, 16)[:-1]
    bottom, side, top = (out, np.full(15, -0.8)), (np.full(40, 0.5), up), (out[::-1], np.full(15, 0.8))
    return turned(np.concatenate([np.stack(piece, axis=1) for piece in (bottom, side, top)]))


def _saddle() -> Mesh:
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 64), np.linspace(-0.7, 0.7, 64), indexing="ij")
    return np.stack([x, y, x**2 - y**2], axis=2).reshape(-1, 3), _grid(64, 64)


ANALYTIC: dict[str, Callable[[], Mesh]] = {
    "sphere": _sphere,
    "torus": _torus,
    "cube": lambda: _box(0.57, 0.57, 0.57),
    "plate": lambda: _box(0.8, 0.6, 0.04),
    "cylinder": _cylinder,
    "saddle": _saddle,
}
