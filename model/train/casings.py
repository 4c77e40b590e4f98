"""Training clouds made in code: thin walls that bend and have fillets, as in castings, vessels and folded sheets.

The solids of `model.train.solids` have thin walls, but plane ones with sharp edges; its bodies bend, but are thick.
Much of what is scanned is both. `UNSEEN` are families that nothing is trained on, to judge by.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from straightpcf.model.train.bodies import direction
from straightpcf.model.train.fields import (
    Field,
    ball,
    block,
    intersection,
    less,
    moved,
    plane,
    post,
    shell,
    torus,
    union,
    widened,
)
from straightpcf.model.train.level_set import LevelSet
from straightpcf.model.train.primitives import log_uniform

__all__ = ["CASINGS", "UNSEEN", "Casing", "casing", "lattice", "scroll", "sheet", "vessel"]

Floats = npt.NDArray[np.float64]

_WALL = (0.045, 0.22)  # thickness, where bodies have a radius of about 2, as that of solids
_UP = np.array([0.0, 0.0, 1.0])
_STEEPEST = 1.05  # of a field, no steeper than 1 but for what rounding does to sums


@dataclass(frozen=True)
class Casing(LevelSet):
    """A body given by a field, within `reach` (3,) of the origin."""

    field: Field
    reach: Floats

    def value(self, xyz: Floats) -> tuple[Floats, Floats]:
        """Return the field at points (N, 3): (N,), and its gradient (N, 3)."""
        return self.field(xyz)

    def box(self) -> tuple[Floats, Floats]:
        """Return the corners, (3,) each, of a box around the surface."""
        return -self.reach, self.reach

    def slope(self) -> float:
        """Return the steepest that the function is anywhere, or more."""
        return _STEEPEST


def _wall(rng: np.random.Generator) -> float:
    return log_uniform(rng, _WALL)


def _seam(wall: float) -> float:
    """Return how far seams of such a wall may be rounded, so that it stays."""
    return min(0.03, wall / 8)


def _turned(rng: np.random.Generator) -> Floats:
    return np.asarray(Rotation.random(random_state=rng).as_matrix())


def casing(rng: np.random.Generator) -> Casing:
    """A hollow body of blocks and posts, open at one side: with a flange, ribs, bosses that have bores, and windows."""
    wall = _wall(rng)
    seam = _seam(wall)
    masses = []
    for _ in range(rng.integers(1, 4)):
        half, centre = rng.uniform(0.35, 1.0, 3), rng.uniform(-0.5, 0.5, 3)
        turn = Rotation.from_rotvec([0, 0, rng.uniform(0, np.pi)]).as_matrix()
        round_ = rng.uniform(0.05, 0.3)
        mass = block(half, round_) if rng.random() < 0.6 else post(half[0], half[2], round_)
        masses.append(moved(mass, centre, np.roll(turn, rng.integers(3), axis=1)))
    outer = union(rng.uniform(0.01, 0.08), *masses)
    inner = widened(outer, -wall)
    parts = [shell(widened(outer, -wall / 2), wall)]
    for _ in range(rng.integers(0, 5)):  # ribs
        slab = moved(block(np.array([4.0, 4.0, _wall(rng) / 2]), 0.0), rng.uniform(-0.5, 0.5, 3), _turned(rng))
        parts.append(intersection(seam, slab, widened(outer, rng.choice([0.0, rng.uniform(0, 0.25)]))))
    holes = []
    for _ in range(rng.integers(0, 5)):  # bosses
        centre, tall = rng.uniform(-0.8, 0.8, 3), rng.uniform(0.2, 0.7)
        turn = np.roll(np.eye(3), rng.integers(3), axis=1)
        thick = rng.uniform(0.1, 0.3)
        parts.append(moved(post(thick, tall, 0.02), centre, turn))
        if rng.random() < 0.7:
            holes.append(moved(post(thick * rng.uniform(0.3, 0.7), 3.0, 0.0), centre, turn))
    for _ in range(rng.integers(0, 4)):  # windows
        turn = np.roll(np.eye(3), rng.integers(3), axis=1)
        holes.append(moved(post(rng.uniform(0.1, 0.45), 3.0, 0.0), rng.uniform(-0.7, 0.7, 3), turn))
    way, cut = direction(rng), rng.uniform(0.1, 0.7)
    if rng.random() < 0.5:
        way = np.eye(3)[rng.integers(3)]
    if rng.random() < 0.5:  # a flange around what is open
        thick = _wall(rng)
        rim = intersection(seam, plane(way, cut), plane(-way, thick - cut), widened(outer, rng.uniform(0.1, 0.3)))
        parts.append(less(seam, rim, inner))
    body = intersection(seam, union(seam, *parts), plane(way, cut))
    return Casing(less(seam, body, *holes) if holes else body, np.full(3, 2.4))


def vessel(rng: np.random.Generator) -> Casing:
    """A cup, bowl or vase that is turned and a little bent, with a bottom, some with a foot or handles."""
    wall = _wall(rng)
    seam = _seam(wall)
    tall = rng.uniform(0.6, 1.3)
    waves = np.pi / tall * np.arange(3) / 2
    shares, phases = rng.uniform(0, 0.3, 3) * [1, 1, 0.5], rng.uniform(0, 2 * np.pi, 3)
    radius, lobes, depth = rng.uniform(0.45, 1.1), int(rng.integers(2, 9)), rng.choice([0.0, rng.uniform(0, 0.08)])

    def profile(xyz: Floats) -> tuple[Floats, Floats]:
        reach, angle = np.hypot(xyz[:, 0], xyz[:, 1]), np.arctan2(xyz[:, 1], xyz[:, 0])
        height = xyz[:, 2].clip(-tall, tall)
        wide = radius * (1 + np.sin(height[:, None] * waves + phases) @ shares)
        steep = radius * (np.cos(height[:, None] * waves + phases) * waves) @ shares
        steep = np.where(np.abs(xyz[:, 2]) < tall, steep, 0.0)
        near = np.minimum(reach, 1.0)  # lobes end at the axis
        out = xyz[:, :2] / np.maximum(reach, 1e-12)[:, None]
        side = np.stack([-out[:, 1], out[:, 0]], axis=1)
        value = reach - wide - depth * near**2 * np.sin(lobes * angle)
        radial = 1 - 2 * depth * np.where(reach < 1, reach, 0.0) * np.sin(lobes * angle)
        around = -depth * lobes * np.where(reach < 1, near, 1 / np.maximum(reach, 1.0)) * np.cos(lobes * angle)
        gradient = np.column_stack([radial[:, None] * out + around[:, None] * side, -steep])
        return value / limit, gradient / limit

    limit = float(np.hypot(np.hypot(1 + 2 * depth, depth * lobes), radius * np.abs(waves) @ shares))
    bottom = rng.uniform(-0.9, -0.5) * tall
    body = shell(profile, wall / np.sqrt(limit))
    floor = intersection(seam, profile, moved(block(np.array([4.0, 4.0, wall / 2]), 0.0), bottom * _UP, np.eye(3)))
    body = union(seam, intersection(seam, body, plane(-_UP, -bottom + wall / 2)), floor)
    for _ in range(rng.integers(0, 3)):
        turn = Rotation.from_euler("zx", [rng.uniform(0, 2 * np.pi), np.pi / 2]).as_matrix()
        place = turn @ [radius * rng.uniform(0.9, 1.2), rng.uniform(-0.3, 0.3) * tall, 0]
        ring = moved(torus(rng.uniform(0.25, 0.5), rng.uniform(0.05, 0.12)), place, turn)
        body = union(seam, body, less(seam, ring, profile))
    rim = rng.standard_normal(3) * 0.15 + _UP
    rim /= np.linalg.norm(rim)
    return Casing(intersection(seam, body, plane(rim, rng.uniform(0.5, 0.95) * tall)), np.array([2.4, 2.4, 2.0]))


def _wavy(rng: np.random.Generator, wall: float, steepest: float) -> Field:
    """Return a sheet about z = 0 that is folded in waves."""
    count = int(rng.integers(1, 5))
    lengths, headings = rng.uniform(0.7, 4.0, count), rng.uniform(0, 2 * np.pi, count)
    waves = 2 * np.pi / lengths[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    phases, slopes = rng.uniform(0, 2 * np.pi, count), rng.dirichlet(np.ones(count)) * rng.uniform(0.1, steepest)
    limit = float(np.hypot(1, slopes.sum()))

    def field(xyz: Floats) -> tuple[Floats, Floats]:
        angles = xyz[:, :2] @ waves.T + phases
        value = xyz[:, 2] - np.sin(angles) @ (slopes * lengths / (2 * np.pi))
        tilt = np.cos(angles) @ (slopes * lengths / (2 * np.pi) * waves.T).T
        return value / limit, np.column_stack([-tilt, np.ones(len(xyz))]) / limit

    return shell(field, wall)


def sheet(rng: np.random.Generator) -> Casing:
    """One to four wavy sheets of rounded outline, some with holes: leaves, seats, wings, bodywork."""
    parts = []
    for _ in range(rng.integers(1, 5)):
        wall = _wall(rng)
        seam = _seam(wall)
        discs = [
            moved(
                post(rng.uniform(0.25, 0.8), 4.0, 0.0) if rng.random() < 0.6 else
                block(np.array([*rng.uniform(0.2, 0.9, 2), 4.0]), 0.1),
                np.array([*rng.uniform(-0.7, 0.7, 2), 0]),
                np.asarray(Rotation.from_rotvec([0, 0, rng.uniform(0, np.pi)]).as_matrix()),
            )
            for _ in range(rng.integers(1, 5))
        ]  # fmt: skip
        flat = intersection(seam, _wavy(rng, wall, 1.2), union(0.05, *discs))
        holes = [
            moved(post(rng.uniform(0.06, 0.3), 4.0, 0.0), np.array([*rng.uniform(-0.8, 0.8, 2), 0]), np.eye(3))
            for _ in range(rng.integers(0, 4))
        ]
        if holes:
            flat = less(seam, flat, *holes)
        parts.append(moved(flat, rng.uniform(-0.35, 0.35, 3), _turned(rng)))
    return Casing(intersection(0.01, union(0.01, *parts), ball(1.9)), np.full(3, 2.0))


def lattice(rng: np.random.Generator) -> Casing:
    """A gyroid's wall inside a ball, a block or a post: walls that bend everywhere, close to each other."""
    wall, period = _wall(rng), rng.uniform(1.0, 2.2)
    wave, phase = 2 * np.pi / period, rng.uniform(0, 2 * np.pi, 3)

    def gyroid(xyz: Floats) -> tuple[Floats, Floats]:
        sine, cosine = np.sin(wave * xyz + phase), np.cos(wave * xyz + phase)
        value = (sine * np.roll(cosine, -1, axis=1)).sum(axis=1)
        gradient = wave * (cosine * np.roll(cosine, -1, axis=1) - sine * np.roll(sine, 1, axis=1))
        return value / (np.sqrt(3) * wave), gradient / (np.sqrt(3) * wave)

    outline = [ball(1.0), block(np.full(3, 0.8), 0.1), post(0.8, 0.9, 0.1)][rng.integers(3)]
    turn = _turned(rng)
    return Casing(intersection(_seam(wall), moved(shell(gyroid, wall), np.zeros(3), turn), outline), np.full(3, 1.2))


def scroll(rng: np.random.Generator) -> Casing:
    """A sheet rolled up, its layers apart by one to three walls."""
    wall = _wall(rng)
    pitch = wall + rng.uniform(0.12, 0.4)  # from layer to layer
    inside = rng.uniform(0.3, 0.5)
    outside = min(1.1, inside + rng.uniform(1.2, 3.0) * pitch)
    limit = float(np.hypot(1, pitch / (2 * np.pi * 0.2)))

    def spiral(xyz: Floats) -> tuple[Floats, Floats]:
        reach, angle = np.hypot(xyz[:, 0], xyz[:, 1]), np.arctan2(xyz[:, 1], xyz[:, 0])
        value = (reach - pitch * angle / (2 * np.pi) + pitch / 2) % pitch - pitch / 2
        out = xyz[:, :2] / np.maximum(reach, 0.2)[:, None]
        side = np.stack([-out[:, 1], out[:, 0]], axis=1) / np.maximum(reach, 0.2)[:, None]
        gradient = np.column_stack([out - pitch / (2 * np.pi) * side, np.zeros(len(xyz))])
        return value / limit, gradient / limit

    seam = _seam(wall)
    body = less(seam, intersection(seam, shell(spiral, wall / limit), post(outside, rng.uniform(0.4, 1.1), 0.0)),
                post(inside, 3.0, 0.0))  # fmt: skip
    return Casing(body, np.full(3, 1.3))


CASINGS: list[Callable[[np.random.Generator], Casing]] = [casing, vessel, sheet]
UNSEEN: list[Callable[[np.random.Generator], Casing]] = [lattice, scroll]
