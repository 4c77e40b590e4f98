"""Training clouds made in code: smooth bodies with limbs, ears and relief, sampled on a level set.

Solids of plates and tubes (`model.train.solids`) teach thin walls and edges; what animals and statues have beside them
is curvature everywhere. A body is where a smooth union of tapering limbs, less a relief of waves, is below zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from straightpcf.model.train.level_set import LevelSet

__all__ = ["Body", "Limb", "carving", "creature", "direction"]

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Limb:
    """A capsule from `start` to `end` (3,) whose radius goes from radii[0] to radii[1], flattened along `across`.

    across: (3,) a unit vector, best at right angles to the axis; flat: how many times thinner the limb is along it.
    """

    start: Floats
    end: Floats
    radii: tuple[float, float]
    across: Floats
    flat: float = 1.0

    def distance(self, xyz: Floats) -> tuple[Floats, Floats]:
        """Return how far points (N, 3) are in the frame that makes the limb round, (N,), and the gradient (N, 3)."""
        stretch = np.eye(3) + (self.flat - 1) * np.outer(self.across, self.across)
        axis = (self.end - self.start) @ stretch
        from_start = (xyz - self.start) @ stretch
        along = from_start @ axis / (axis @ axis)
        share = along.clip(0, 1)
        off = from_start - share[:, None] * axis
        length = np.linalg.norm(off, axis=1)
        taper = self.radii[1] - self.radii[0]
        gradient = off / np.maximum(length, 1e-12)[:, None]
        gradient -= np.where((along > 0) & (along < 1), taper, 0.0)[:, None] * axis / (axis @ axis)
        return length - self.radii[0] - share * taper, gradient @ stretch


@dataclass(frozen=True)
class Body(LevelSet):
    """Limbs grown together, with a relief.

    blend: how far around a joint it is rounded; waves: (J, 3) wave vectors, phases: (J,), heights: (J,) of the relief.
    """

    limbs: Sequence[Limb]
    blend: float
    waves: Floats
    phases: Floats
    heights: Floats

    def value(self, xyz: Floats) -> tuple[Floats, Floats]:
        """Return the function that is below zero inside, at points (N, 3): (N,), and its gradient (N, 3)."""
        distances, gradients = zip(*(limb.distance(xyz) for limb in self.limbs), strict=True)
        every = np.stack(distances)
        nearest = every.min(axis=0)
        weights = np.exp((nearest - every) / self.blend)
        total = weights.sum(axis=0)
        value = nearest - self.blend * np.log(total)
        gradient = np.einsum("ln,lnd->nd", weights / total, np.stack(gradients))
        angles = xyz @ self.waves.T + self.phases
        return value - np.sin(angles) @ self.heights, gradient - np.cos(angles) * self.heights @ self.waves

    def box(self) -> tuple[Floats, Floats]:
        """Return the corners, (3,) each, of a box around the surface."""
        ends = np.stack([end for limb in self.limbs for end in (limb.start, limb.end)])
        widest = max(max(limb.radii) for limb in self.limbs) + self.blend * np.log(len(self.limbs))
        margin = widest + np.abs(self.heights).sum()
        return ends.min(axis=0) - margin, ends.max(axis=0) + margin

    def slope(self) -> float:
        """Return the steepest that the function is anywhere, or more."""
        slope = max(limb.flat + abs(limb.radii[1] - limb.radii[0]) for limb in self.limbs)
        return slope + float(np.abs(self.heights) @ np.linalg.norm(self.waves, axis=1))


def direction(rng: np.random.Generator, across: Floats | None = None) -> Floats:
    """Return a unit vector, at right angles to `across` where that is given."""
    way = rng.standard_normal(3)
    if across is not None:
        way -= way @ across / (across @ across) * across
    return np.asarray(way / np.linalg.norm(way))


def _limb(rng: np.random.Generator, start: Floats, end: Floats, radii: tuple[float, float], flat: float = 1.0) -> Limb:
    return Limb(start, end, radii, direction(rng, end - start), flat)


def _relief(rng: np.random.Generator, lengths: tuple[float, float], slope: float) -> tuple[Floats, Floats, Floats]:
    """Return waves of such lengths whose slopes add up to `slope` on average: wave vectors, phases, heights."""
    count = int(rng.integers(3, 9))
    wave = 2 * np.pi / np.exp(rng.uniform(np.log(lengths[0]), np.log(lengths[1]), count))
    vectors = wave[:, None] * np.stack([direction(rng) for _ in range(count)])
    return vectors, rng.uniform(0, 2 * np.pi, count), slope / np.sqrt(count) / wave


def creature(rng: np.random.Generator) -> Body:
    """A trunk with two to four pairs of jointed limbs, a head with flat ears and a tail; hardly any relief."""
    spine = np.array([0.0, 0, rng.uniform(0.3, 0.8)])
    limbs = [_limb(rng, -spine, spine, (rng.uniform(0.3, 0.55), rng.uniform(0.25, 0.5)), rng.uniform(1, 1.5))]
    for _ in range(rng.integers(2, 5)):
        root = rng.uniform(-1, 1) * spine
        thick = rng.uniform(0.07, 0.22)
        knee = root + rng.uniform(0.5, 1.0) * direction(rng)
        foot = knee + rng.uniform(0.3, 0.8) * direction(rng)
        narrow = rng.uniform(0.5, 1.0)
        for mirror in (np.ones(3), np.array([-1.0, 1, 1])):
            limbs.append(_limb(rng, root * mirror, knee * mirror, (1.2 * thick, thick)))
            limbs.append(_limb(rng, knee * mirror, foot * mirror, (thick, narrow * thick)))
    head = 1.2 * spine + 0.5 * direction(rng) * [0.2, 1, 1]
    snout = head + rng.uniform(0.1, 0.5) * direction(rng) * [0.2, 1, 1]
    limbs.append(_limb(rng, 0.9 * spine, head, (0.2, 0.25)))
    limbs.append(_limb(rng, head, snout, (rng.uniform(0.2, 0.35), rng.uniform(0.1, 0.25))))
    ear, size = rng.uniform(0.25, 0.6) * direction(rng), rng.uniform(0.15, 0.3)
    flat = rng.uniform(2, 4)
    for mirror in (np.ones(3), np.array([-1.0, 1, 1])):
        limbs.append(_limb(rng, head, head + ear * mirror, (size, 0.6 * size), flat))
    limbs.append(_limb(rng, -spine, -spine + rng.uniform(0.4, 1.2) * direction(rng), (0.12, rng.uniform(0.04, 0.1))))
    return Body(limbs, rng.uniform(0.02, 0.06), *_relief(rng, (0.2, 0.8), rng.uniform(0, 0.25)))


def carving(rng: np.random.Generator) -> Body:
    """A few large masses with a relief all over: folds, hair, bark."""
    centres = rng.uniform(-0.6, 0.6, (rng.integers(3, 7), 3))
    limbs = []
    for centre in centres:
        end = centre + rng.uniform(0.2, 1.0) * direction(rng)
        radii = rng.uniform(0.25, 0.6, 2)
        limbs.append(_limb(rng, centre, end, (radii[0], radii[1]), rng.uniform(1, 2.5)))
    return Body(limbs, rng.uniform(0.02, 0.12), *_relief(rng, (0.15, 0.7), rng.uniform(0.25, 0.7)))
