"""Training scenes made in code: pieces of streets, rooms, roofs, trees and masts, with what is thin in them.

What a scanner sees of a street is what a network trained on objects knows least: poles, wires, railings, sills, leaves.
To it they are noise beside a wall. `scanned` makes clouds of these as it does of solids.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from straightpcf.model.train.primitives import Box, Cylinder, Ellipsoid, Primitive, Solid, along, log_uniform, pose

__all__ = ["PLACES", "Place"]

Floats = npt.NDArray[np.float64]
Place = tuple[Solid, Floats]  # and the way (3,) to a scanner that sees it, of any length

# In a frame where a place reaches about 1.3 from its middle, which training takes for the unit ball: noise is up to 3 %
# of that.
_WIDE = 1.2
_ROD = (0.006, 0.05)  # radii of what is thin
_LEDGE = (0.02, 0.1)  # what stands out of a wall, or how deep it goes in


def _street(rng: np.random.Generator) -> Place:
    """Ground with a kerb, a wall with windows and sills, and some of poles, a railing, wires and a car."""
    front = rng.uniform(0.2, 0.7)
    parts: list[Primitive] = [
        _block(rng, (-_WIDE, _WIDE), (-1.0, 1.0), (-0.06, 0.0)),
        _block(rng, (-_WIDE, _WIDE), (front - rng.uniform(0.2, 0.5), 0.95), (-0.05, rng.uniform(0.02, 0.08))),
    ]
    holes = _house(rng, parts, front)
    for _ in range(rng.integers(1, 5)):
        foot = np.array([rng.uniform(-1.0, 1.0), rng.uniform(-0.7, front - 0.08), -0.05])
        parts.append(_rod(foot, _above(foot, rng.uniform(0.4, 1.5)), _thin(rng)))
    if rng.random() < 0.5:
        _railing(rng, parts, y=rng.uniform(-0.6, front - 0.15))
    if rng.random() < 0.5:
        _car(rng, parts, y=rng.uniform(-0.7, front - 0.4))
    if rng.random() < 0.6:
        _wires(rng, parts, y=(-0.6, front - 0.1), z=(0.7, 1.3))
    return Solid(parts, holes), np.array([rng.uniform(-1.5, 1.5), -1.0, rng.uniform(0.1, 1.2)])


def _roofs(rng: np.random.Generator) -> Place:
    """Houses from above: flat and gabled roofs, chimneys, aerials, a wire, a kerb."""
    parts: list[Primitive] = [
        _block(rng, (-_WIDE, _WIDE), (-_WIDE, _WIDE), (-0.06, 0.0)),
        _block(rng, (-_WIDE, _WIDE), (-0.3, rng.uniform(0.0, 0.4)), (-0.05, rng.uniform(0.01, 0.06))),
    ]
    for _ in range(rng.integers(2, 5)):
        middle, half, high = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.2, 0.5, 2), rng.uniform(0.2, 0.7)
        turn = pose(rng, 2) @ Rotation.from_rotvec([0, 0, rng.uniform(0, np.pi)]).as_matrix()
        parts.append(Box(np.array([*middle, high / 2 - 0.05]), turn, np.array([*half, high / 2])))
        if rng.random() < 0.6:
            rise = rng.uniform(0.3, 0.8)
            for side in (-1, 1):
                tilt = turn @ Rotation.from_rotvec([side * rise, 0, 0]).as_matrix()
                slope = np.array([half[0] + rng.uniform(0.0, 0.08), half[1] / np.cos(rise) / 2 + 0.02, 0.02])
                at = turn @ np.array([0, -side * half[1] / 2, half[1] * np.tan(rise) / 2])
                parts.append(Box(np.array([*middle, high - 0.06]) + at, tilt, slope))
        for _ in range(rng.integers(0, 3)):
            at = np.array([*(middle + rng.uniform(-0.6, 0.6, 2) * half.min()), high - 0.1])
            top = _above(at, rng.uniform(0.15, 0.5))
            if rng.random() < 0.5:
                parts.append(_rod(at, top, _thin(rng)))
            else:
                parts.append(Box((at + top) / 2, turn, np.array([*rng.uniform(0.02, 0.08, 2), (top - at)[2] / 2])))
    if rng.random() < 0.6:
        _wires(rng, parts, y=(-0.8, 0.8), z=(0.5, 1.0))
    return Solid(parts), np.array([*rng.uniform(-0.8, 0.8, 2), 1.0])


def _room(rng: np.random.Generator) -> Place:
    """A corner of a room: a table and a bench, shelves at a wall, balls and boxes, a lamp."""
    back, side = rng.uniform(0.5, 0.9), rng.choice([-1, 1])
    parts: list[Primitive] = [
        _block(rng, (-_WIDE, _WIDE), (-1.0, 1.0), (-0.06, 0.0)),
        _block(rng, (-_WIDE, _WIDE), (back, back + 0.1), (-0.05, rng.uniform(0.9, 1.4))),
        _block(rng, (side * 1.0, side * 1.1), (-0.9, back + 0.1), (-0.05, rng.uniform(0.8, 1.4))),
    ]
    low, high = np.array([-0.6, -0.5]) + rng.uniform(-0.2, 0.2, 2), np.array([0.2, 0.1]) + rng.uniform(-0.2, 0.2, 2)
    top, thick = rng.uniform(0.3, 0.5), rng.uniform(0.015, 0.05)
    parts.append(_block(rng, (low[0], high[0]), (low[1], high[1]), (top, top + thick)))
    for x in (low[0] + 0.05, high[0] - 0.05):
        for y in (low[1] + 0.05, high[1] - 0.05):
            parts.append(_rod(np.array([x, y, -0.05]), np.array([x, y, top + 0.01]), rng.uniform(0.01, 0.03)))
    for _ in range(rng.integers(2, 7)):
        at, size = np.array([*rng.uniform(low, high), top + thick]), rng.uniform(0.02, 0.09)
        if rng.random() < 0.6:
            parts.append(Ellipsoid(_above(at, size * 0.9), np.eye(3), np.full(3, size)))
        else:
            parts.append(Box(at, pose(rng, 2), size * rng.uniform(0.4, 1.5, 3)))
    start, wide = rng.uniform(-0.8, 0.0), rng.uniform(0.4, 0.8)
    for z in np.cumsum(rng.uniform(0.1, 0.25, rng.integers(2, 6))) + 0.3:
        deep = rng.uniform(0.08, 0.25)
        parts.append(_block(rng, (start, start + wide), (back - deep, back + 0.05), (z, z + rng.uniform(0.01, 0.04))))
    foot = np.array([rng.uniform(0.3, 0.8), rng.uniform(-0.4, 0.3), -0.05])
    head = _above(foot, rng.uniform(0.6, 1.0))
    parts += [_rod(foot, head, _thin(rng)), Ellipsoid(head, np.eye(3), rng.uniform(0.05, 0.15, 3))]
    return Solid(parts), np.array([-side * rng.uniform(0.0, 1.0), -1.2, rng.uniform(0.1, 1.2)])


def _tree(rng: np.random.Generator) -> Place:
    """A trunk, branches and leaves over a piece of ground, or a bush."""
    high = rng.uniform(0.1, 0.9)
    parts: list[Primitive] = [_block(rng, (-0.8, 0.8), (-0.8, 0.8), (-0.56, -0.5))]
    foot, fork = np.array([0, 0, -0.55]), np.array([*rng.normal(0, 0.05, 2), high - 0.5])
    parts.append(_rod(foot, fork, rng.uniform(0.03, 0.09)))
    crown = _above(fork, rng.uniform(0.2, 0.5))
    reach = rng.uniform(0.4, 0.8, 3)
    for _ in range(rng.integers(5, 20)):
        tip = crown + _in_ball(rng) * reach
        parts.append(_rod(fork, tip, _thin(rng) / 2))
    size = log_uniform(rng, (0.02, 0.1))
    for _ in range(rng.integers(40, 160)):
        half = size * np.array([1.0, rng.uniform(0.4, 1.0), rng.choice([0.1, 0.5, 1.0])])
        turn = Rotation.random(random_state=rng).as_matrix()
        parts.append(Ellipsoid(crown + _in_ball(rng) * reach, turn, half))
    return Solid(parts), rng.standard_normal(3) * [1, 1, 0.7] + [0, 0, 0.5]


def _mast(rng: np.random.Generator) -> Place:
    """A lattice mast or a pole with arms, its wires and guys, over ground that slopes."""
    tilt = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()
    parts: list[Primitive] = [Box(np.array([0, 0, -0.85]), tilt, np.array([_WIDE, 0.8, 0.05]))]
    top, wide = rng.uniform(0.4, 1.0), rng.uniform(0.05, 0.2)
    thin = _thin(rng) / 2
    if rng.random() < 0.5:
        corners = wide * np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)])
        levels = np.linspace(-0.85, top, rng.integers(4, 8))
        for here, there in zip(corners, np.roll(corners, 1, axis=0), strict=True):
            parts.append(_rod(np.array([*here, -0.9]), np.array([*here, top]), thin))
            for low, high in pairwise(levels):
                parts.append(_rod(np.array([*here, low]), np.array([*there, high]), 0.7 * thin))
    else:
        parts.append(_rod(np.array([0, 0, -0.9]), np.array([0, 0, top]), rng.uniform(0.02, 0.06)))
    for z in rng.uniform(0.3, 1.0, rng.integers(1, 4)) * top:
        arm = rng.uniform(0.2, 0.5)
        parts.append(_rod(np.array([0, -arm, z]), np.array([0, arm, z]), thin))
        for y in (-arm, arm):
            start = np.array([-_WIDE, y, z - 0.02 + rng.normal(0, 0.05)])
            parts.append(_rod(start, np.array([_WIDE, y, z - 0.02 + rng.normal(0, 0.05)]), rng.uniform(0.005, 0.012)))
    for _ in range(rng.integers(0, 4)):
        ground = np.array([*rng.uniform(-0.7, 0.7, 2), -0.9])
        parts.append(_rod(ground, np.array([0, 0, rng.uniform(0.3, 1.0) * top]), rng.uniform(0.005, 0.012)))
    return Solid(parts), rng.standard_normal(3) * [1, 1, 0.7] + [0, 0, 0.7]


def _house(rng: np.random.Generator, parts: list[Primitive], front: float) -> list[Primitive]:
    """Add a wall with sills to the parts; return its windows, which are holes."""
    high = rng.uniform(0.6, 1.3)
    parts.append(_block(rng, (-_WIDE, _WIDE), (front, 1.0), (-0.05, high)))
    holes: list[Primitive] = []
    wide, tall, deep = rng.uniform(0.1, 0.3), rng.uniform(0.15, 0.35), rng.uniform(*_LEDGE)
    step = wide * rng.uniform(1.4, 2.5)
    for z in np.arange(rng.uniform(0.15, 0.3), high - tall, 1.5 * tall):
        out, thick = rng.uniform(*_LEDGE), rng.uniform(0.01, 0.05)
        for x in np.arange(-_WIDE + 0.1, _WIDE - wide, step):
            if rng.random() < 0.8:
                holes.append(_block(rng, (x, x + wide), (front - 0.1, front + deep), (z, z + tall)))
            if rng.random() < 0.8:
                sill = (front - out, front + 0.02)
                parts.append(_block(rng, (x - 0.02, x + wide + 0.02), sill, (z - thick, z - 0.002)))
    return holes


def _railing(rng: np.random.Generator, parts: list[Primitive], y: float) -> None:
    start, apart, high = rng.uniform(-1.0, 0.0), rng.uniform(0.04, 0.12), rng.uniform(0.2, 0.45)
    count, thin = int(rng.integers(6, 16)), rng.uniform(0.005, 0.015)
    for x in start + apart * np.arange(count):
        parts.append(_rod(np.array([x, y, -0.05]), np.array([x, y, high]), thin))
    end = np.array([start + apart * count, y, high])
    parts.append(_rod(np.array([start, y, high]), end, 1.5 * thin))


def _car(rng: np.random.Generator, parts: list[Primitive], y: float) -> None:
    x, long, wide = rng.uniform(-0.9, 0.2), rng.uniform(0.6, 0.9), rng.uniform(0.25, 0.35)
    parts.append(_block(rng, (x, x + long), (y, y + wide), (0.05, 0.18)))
    roof = rng.uniform(0.15, 0.3) * long
    parts.append(_block(rng, (x + roof, x + long - roof / 2), (y + 0.02, y + wide - 0.02), (0.17, 0.28)))
    for at in (x + 0.2 * long, x + 0.8 * long):
        parts.append(_rod(np.array([at, y, 0.06]), np.array([at, y + wide, 0.06]), 0.06))


def _wires(rng: np.random.Generator, parts: list[Primitive], *, y: tuple[float, float], z: tuple[float, float]) -> None:
    for _ in range(rng.integers(1, 4)):
        start, end = (np.array([x, rng.uniform(*y), rng.uniform(*z)]) for x in (-_WIDE, _WIDE))
        end[1] = start[1] + rng.normal(0, 0.1)
        parts.append(_rod(start, end, rng.uniform(0.005, 0.012)))


def _block(
    rng: np.random.Generator, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]
) -> Primitive:
    """Return an upright box between two corners, off by a little: no two faces shall coincide."""
    low, high = np.sort(np.array([x, y, z]), axis=1).T
    return Box((low + high) / 2 + rng.normal(0, 0.002, 3), pose(rng, 2), (high - low) / 2)


def _rod(start: Floats, end: Floats, radius: float) -> Primitive:
    way = end - start
    return Cylinder((start + end) / 2, along(way), radius, float(np.linalg.norm(way)) / 2)


def _above(place: Floats, high: float) -> Floats:
    return np.array([place[0], place[1], place[2] + high])


def _thin(rng: np.random.Generator) -> float:
    return log_uniform(rng, _ROD)


def _in_ball(rng: np.random.Generator) -> Floats:
    way = rng.standard_normal(3)
    place: Floats = way / np.linalg.norm(way) * rng.random() ** (1 / 3)
    return place


PLACES: list[Callable[[np.random.Generator], Place]] = [_street, _roofs, _room, _tree, _mast, _street]
