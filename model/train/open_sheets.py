"""Training clouds made in code: open surfaces, such as a scanner sees of bodies, grounds, panels and walls.

Everything else that is trained on is closed: where two sheets lie near each other they are two surfaces. On an open one
there is nothing to tell apart, however much noise there is, and it fills the whole cloud: at the same count its patches
reach less far beside the noise than those of a body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from straightpcf.model.train.primitives import log_uniform

__all__ = ["OPEN_SHEETS", "OpenSheet", "dish", "folds", "profile", "relief"]

Floats = npt.NDArray[np.float64]

_STEP = 1e-5  # of the parameters, for tangents
_PILOT = 20_000  # points that tell how large the largest element of area is
_MARGIN = 1.2  # above the largest of these
_DRAWN = 200_000  # points at once


@dataclass(frozen=True)
class OpenSheet:
    """A surface with an edge: `place` maps parameters (N, 2), within 1, to points (N, 3), `kept` says which hold."""

    place: Callable[[Floats], Floats]
    kept: Callable[[Floats], npt.NDArray[np.bool_]]

    def sample(self, rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
        """Sample `count` points of the surface evenly, (count, 3), and their unit normals."""
        largest = _MARGIN * np.linalg.norm(self._across(rng.uniform(-1, 1, (_PILOT, 2))), axis=1).max()
        found: list[Floats] = []
        while sum(map(len, found)) < count:
            drawn = rng.uniform(-1, 1, (_DRAWN, 2))
            drawn = drawn[self.kept(drawn)]
            areas = np.linalg.norm(self._across(drawn), axis=1)
            found.append(drawn[rng.uniform(0, largest, len(drawn)) < areas])
        at = np.concatenate(found)[:count]
        across = self._across(at)
        return self.place(at), across / np.linalg.norm(across, axis=1, keepdims=True)

    def _across(self, at: Floats) -> Floats:
        """Return what is across the surface, (N, 3), as long as the element of area is large."""
        one, other = ((self.place(at + way) - self.place(at - way)) / (2 * _STEP) for way in _STEP * np.eye(2))
        return np.cross(one, other)


def relief(rng: np.random.Generator) -> OpenSheet:
    """Heights over a plane: bent one way, two ways or against each other, with waves, of one scale or of several."""
    bent = rng.uniform(-0.9, 0.9, 3) * rng.choice([0.0, 1.0], p=[0.25, 0.75])
    waves = int(rng.integers(0, 5))
    ways = rng.standard_normal((waves, 2))
    ways *= np.array([log_uniform(rng, (1.5, 8.0)) for _ in range(waves)]).reshape(-1, 1) / np.linalg.norm(
        ways, axis=1, keepdims=True
    )
    heights = rng.uniform(0, 0.6, waves) / np.linalg.norm(ways, axis=1)
    phases, aspect = rng.uniform(0, 2 * np.pi, waves), rng.uniform(0.5, 1.0)

    def place(at: Floats) -> Floats:
        x, y = at[:, 0], at[:, 1] * aspect
        height = bent[0] * x**2 + bent[1] * y**2 + bent[2] * x * y
        height = height + np.sin(np.column_stack([x, y]) @ ways.T + phases) @ heights
        return np.column_stack([x, y, height])

    return OpenSheet(place, _outline(rng))


def dish(rng: np.random.Generator) -> OpenSheet:
    """A part of what is turned about an axis: a dome, a bowl, a tube, a cone or a horn, all around it or not."""
    around = rng.choice([np.pi, rng.uniform(0.3, 0.9) * np.pi])
    low = rng.choice([0.0, rng.uniform(0.1, 0.6)])  # 0: closed at its top
    lean, bulge = rng.uniform(0, np.pi / 2), rng.uniform(-0.4, 0.9) * rng.choice([0.0, 1.0], p=[0.2, 0.8])
    squeezed = rng.choice([1.0, rng.uniform(0.5, 1.0)])

    def place(at: Floats) -> Floats:
        along, angle = (at[:, 0] + 1) / 2, at[:, 1] * around
        reach = low + along * np.sin(lean) + bulge * np.sin(np.pi / 2 * along) * (1 - np.sin(lean) / 2)
        tall = along * np.cos(lean) * 1.6 + np.abs(bulge) * (1 - np.cos(np.pi / 2 * along))
        return np.column_stack([reach * np.cos(angle), squeezed * reach * np.sin(angle), tall])

    return OpenSheet(place, _outline(rng) if around < np.pi else _all)


def folds(rng: np.random.Generator) -> OpenSheet:
    """Planes that meet in sharp or rounded edges: a corner of a room, a stair, a roof, a folded sheet."""
    edges = np.sort(rng.uniform(-0.75, 0.75, rng.integers(1, 5)))
    turns = rng.uniform(0.3, 1.0, len(edges)) * np.pi / 2 * np.cumprod(np.where(rng.random(len(edges)) < 0.6, -1, 1))
    return _bent(rng, edges, turns, rng.choice([0.0, rng.uniform(0.02, 0.2)]))


def profile(rng: np.random.Generator) -> OpenSheet:
    """A sheet rolled or waved along a line: corrugated, arched, or curled up, and a little bent across."""
    edges = np.linspace(-0.8, 0.8, int(rng.integers(2, 7)))
    turns = rng.uniform(0.2, 0.9, len(edges)) * np.pi / 2
    if rng.random() < 0.6:
        turns *= (-1.0) ** np.arange(len(edges))
    else:
        turns *= min(1.0, 1.5 * np.pi / turns.sum())
    return _bent(rng, edges, turns, rng.uniform(0.1, 0.3))


def _bent(rng: np.random.Generator, edges: Floats, turns: Floats, rounded: float) -> OpenSheet:
    """Return a sheet that turns by `turns` at `edges` of its length, within `rounded` on both sides of each."""
    fine = np.linspace(-1.05, 1.05, 4201)
    ramp = (fine[:, None] - edges) / max(rounded, 1e-9)
    angles = np.clip((ramp + 1) / 2, 0, 1) @ turns
    angles -= angles.mean()
    steps = np.stack([np.cos(angles), np.sin(angles)], axis=1) * (fine[1] - fine[0])
    line = np.cumsum(steps, axis=0)
    line -= line.mean(axis=0)
    wide, sag = rng.uniform(0.4, 1.0), rng.choice([0.0, rng.uniform(-0.2, 0.2)])

    def place(at: Floats) -> Floats:
        across = at[:, 1] * wide
        x, z = (np.interp(at[:, 0], fine, line[:, axis]) for axis in (0, 1))
        return np.column_stack([x, across, z + sag * across**2])

    return OpenSheet(place, _outline(rng))


def _all(at: Floats) -> npt.NDArray[np.bool_]:
    return np.ones(len(at), bool)


def _outline(rng: np.random.Generator) -> Callable[[Floats], npt.NDArray[np.bool_]]:
    """Return an edge: a rectangle's, a rounded one's or a circle's, at times with windows."""
    power = rng.choice([np.inf, rng.uniform(2.0, 6.0)])
    windows = int(rng.choice([0, 0, 1, 2]))
    centres, radii = rng.uniform(-0.6, 0.6, (windows, 2)), rng.uniform(0.1, 0.35, windows)

    def kept(at: Floats) -> npt.NDArray[np.bool_]:
        inside: npt.NDArray[np.bool_] = np.linalg.norm(at, ord=power, axis=1) < 1
        for centre, radius in zip(centres, radii, strict=True):
            inside &= np.linalg.norm(at - centre, axis=1) > radius
        return inside

    return kept


OPEN_SHEETS: Sequence[Callable[[np.random.Generator], OpenSheet]] = [relief, folds, relief, dish, relief, profile]
