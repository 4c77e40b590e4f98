"""Training clouds made in code: thin-walled solids of plates, tubes, shells, ribs and rods, smooth bodies, open sheets.

python -m straightpcf.model.train.solids solids.npz --count 36
python -m straightpcf.model.train.solids casings.npz --kind casing

Thin walls are what a denoiser takes for noise, and PUNet's training split has few of them. A solid is made of
`primitives`, a body or a casing is a level set: their surfaces are sampled with no mesh in between, normals are exact.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

import fpsample
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from straightpcf.model.normalize import CloudFrame
from straightpcf.model.train.archive import write_archive
from straightpcf.model.train.bodies import carving, creature
from straightpcf.model.train.casings import CASINGS, UNSEEN
from straightpcf.model.train.command import archive_to_write, errors_in_one_line, positive, seed_number
from straightpcf.model.train.level_set import LevelSet
from straightpcf.model.train.open_sheets import OPEN_SHEETS, OpenSheet
from straightpcf.model.train.primitives import (
    Box,
    Cylinder,
    Ellipsoid,
    Primitive,
    Ring,
    Solid,
    along,
    log_uniform,
    pose,
)

__all__ = ["FAMILIES", "KINDS", "RESOLUTIONS", "even_clouds", "write_solids"]

Floats = npt.NDArray[np.float64]
Sample = Callable[[np.random.Generator, int], tuple[Floats, Floats]]

RESOLUTIONS = (10_000, 30_000, 50_000)
# Of so many times the points wanted, the farthest from each other are kept: spacings are then as even as PUNet's (the
# nearest neighbour's distance varies by 10 %).
_CANDIDATES = 10
_WALL = (0.05, 0.25)  # thickness, in a frame where solids have a radius of about 2: 0.025 to 0.12 in radii


def write_solids(
    path: Path, count: int, *, seed: int = 0, resolutions: Collection[int] | None = None, kind: str = "solid"
) -> None:
    """Write an .npz of `count` solids as PUNet's training split is written: `solid<number>/<resolution>`, float32.

    With them their normals, `solid<number>/normals`, of the points at the finest of RESOLUTIONS. All in the frame where
    the bounding sphere has radius 1. resolutions: those of RESOLUTIONS to train on, all by default; without the finest,
    that is `solid<number>/surface`. kind: another one of KINDS, and its name. Raises ValueError for others of either.
    """
    if resolutions is not None and (not resolutions or not set(resolutions) <= set(RESOLUTIONS)):
        raise ValueError(f"resolutions are {', '.join(map(str, RESOLUTIONS))}, not {', '.join(map(str, resolutions))}")
    if kind not in KINDS:
        raise ValueError(f"kinds are {', '.join(KINDS)}, not {kind}")
    arrays: dict[str, npt.NDArray[np.float32]] = {}
    families = KINDS[kind]
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        # Every family in turn: as many of each.
        made = families[number % len(families)](rng)
        arrays |= even_clouds(rng, f"{kind}{number:03d}", made.sample, resolutions)
    write_archive(path, arrays, save=np.savez_compressed)


def even_clouds(
    rng: np.random.Generator, shape: str, sample: Sample, wanted: Collection[int] | None = None
) -> dict[str, npt.NDArray[np.float32]]:
    """Return a shape's arrays for an archive, as `write_solids` has them.

    sample: draws so many points by area, (M, 3), and their normals. wanted: those of RESOLUTIONS to train on, all by
    default.
    """
    arrays: dict[str, npt.NDArray[np.float32]] = {}
    wanted = RESOLUTIONS if wanted is None else wanted
    xyz, normals = sample(rng, _CANDIDATES * max(RESOLUTIONS))
    xyz = CloudFrame.of(xyz).enter(xyz)
    for resolution in RESOLUTIONS:
        some = rng.permutation(len(xyz))[: _CANDIDATES * resolution]
        kept = some[fpsample.bucket_fps_kdline_sampling(xyz[some].astype(np.float32), resolution, 7, 0)]
        if resolution in wanted:
            arrays[f"{shape}/{resolution}"] = xyz[kept].astype(np.float32)
    if resolution not in wanted:
        arrays[f"{shape}/surface"] = xyz[kept].astype(np.float32)
    arrays[f"{shape}/normals"] = normals[kept].astype(np.float32)
    return arrays


def _wall(rng: np.random.Generator) -> float:
    return log_uniform(rng, _WALL)


def _bracket(rng: np.random.Generator) -> Solid:
    """Two to four plates at right angles, with round holes."""
    parts: list[Primitive] = []
    holes: list[Primitive] = []
    for _ in range(rng.integers(2, 5)):
        axis = int(rng.integers(3))
        half = rng.uniform(0.5, 1.3, 3)
        half[2] = _wall(rng) / 2
        turn, centre = pose(rng, axis), rng.uniform(-0.7, 0.7, 3)
        parts.append(Box(centre, turn, half))
        for _ in range(rng.integers(0, 4)):
            place = centre + turn @ (rng.uniform(-0.8, 0.8, 3) * half * [1, 1, 0])
            holes.append(Cylinder(place, turn, rng.uniform(0.08, 0.35), 2 * half[2]))
    return Solid(parts, holes)


def _fins(rng: np.random.Generator) -> Solid:
    """A base with parallel ribs: walls with gaps between them."""
    thick, gap = _wall(rng), rng.uniform(0.1, 0.5)
    count = int(np.clip(2.4 / (thick + gap), 3, 12))
    width = count * (thick + gap) / 2
    parts: list[Primitive] = [Box(np.zeros(3), np.eye(3), np.array([width, rng.uniform(0.6, 1.4), _wall(rng) / 2]))]
    for place in np.linspace(-width + thick, width - thick, count):
        half = np.array([thick / 2, rng.uniform(0.4, 1.2), rng.uniform(0.3, 0.8)])
        parts.append(Box(np.array([place, 0, half[2]]) + rng.normal(0, 0.01, 3), pose(rng, 2), half))
    return Solid(parts)


def _pipes(rng: np.random.Generator) -> Solid:
    """One to three tubes that cross, with flanges."""
    parts: list[Primitive] = []
    holes: list[Primitive] = []
    for axis in rng.permutation(3)[: rng.integers(1, 4)]:
        turn, centre = pose(rng, int(axis)), rng.normal(0, 0.1, 3)
        radius, half, wall = rng.uniform(0.25, 0.7), rng.uniform(0.9, 1.6), _wall(rng)
        parts.append(Cylinder(centre, turn, radius, half))
        holes.append(Cylinder(centre, turn, max(0.3 * radius, radius - wall), half + 0.1))
        for side in (-1, 1):
            if rng.random() < 0.6:
                thick = _wall(rng)
                end = centre + turn @ [0, 0, side * (half - thick)]
                parts.append(Cylinder(end, turn, radius + rng.uniform(0.1, 0.4), thick / 2))
    return Solid(parts, holes)


def _shell(rng: np.random.Generator) -> Solid:
    """A hollow box, cylinder or ellipsoid, open at one side, some with windows."""
    half, wall = rng.uniform(0.6, 1.3, 3), _wall(rng)
    kind = rng.integers(3)
    body: Primitive
    hollow: Primitive
    if kind == 0:
        body, hollow = Box(half=half), Box(half=half - wall)
    elif kind == 1:
        body, hollow = Cylinder(radius=half[0], half=half[2]), Cylinder(radius=half[0] - wall, half=half[2] - wall)
    else:
        body, hollow = Ellipsoid(half=half), Ellipsoid(half=half - wall)
    holes = [hollow, Box(np.array([0, 0, 2 + rng.uniform(0.1, 0.7) * half[2]]), pose(rng, 2), np.full(3, 2.0))]
    for _ in range(rng.integers(0, 4)):
        direction = rng.standard_normal(3) * [1, 1, 0.5]
        holes.append(Cylinder(direction, along(direction), rng.uniform(0.1, 0.4), 1.5))
    return Solid([body], holes)


def _wheel(rng: np.random.Generator) -> Solid:
    """A rim, some with flanges or teeth, around a hub; between them a disc with holes, or spokes."""
    radius, half, wall = rng.uniform(0.9, 1.6), rng.uniform(0.1, 0.5), _wall(rng)
    hub, bore = rng.uniform(0.2, 0.45), rng.uniform(0.1, 0.15)
    inside = radius - wall
    parts: list[Primitive] = [
        Ring(_off(rng), pose(rng, 2), radius, half, inside),
        Ring(_off(rng), pose(rng, 2), hub, half * rng.uniform(1.05, 1.6), bore),
    ]
    holes: list[Primitive] = []
    if rng.random() < 0.5:
        thick, reach = min(_wall(rng), 0.6 * half), rng.uniform(0.08, 0.3)
        for side in (-1, 1):
            end = np.array([0, 0, side * (half - 0.6 * thick)])
            parts.append(Ring(end + _off(rng), pose(rng, 2), radius + reach, thick / 2, inside + 0.3 * wall))
    elif rng.random() < 0.5:
        teeth = int(rng.integers(12, 36))
        size = np.array([rng.uniform(0.05, 0.15) + wall / 2, 0.5 * np.pi * radius / teeth, 0.97 * half])
        parts += [Box(radius * turn[:, 0], turn, size) for turn in _around(rng, teeth)]
    middle, long = (hub + inside) / 2, (inside - hub) / 2
    if rng.random() < 0.5:
        parts.append(Ring(_off(rng), pose(rng, 2), inside + wall / 2, _wall(rng) / 2, (hub + bore) / 2))
        hole = rng.uniform(0.3, 0.9) * long
        turns = _around(rng, int(rng.integers(0, 8)))
        holes = [Cylinder(middle * turn[:, 0], np.eye(3), hole, 0.9 * half) for turn in turns]
    else:
        size = np.array([long + 0.4 * wall, _wall(rng) / 2, rng.uniform(0.3, 0.9) * half])
        parts += [Box(middle * turn[:, 0], turn, size) for turn in _around(rng, int(rng.integers(3, 9)))]
    return Solid(parts, holes)


def _off(rng: np.random.Generator) -> Floats:
    return rng.normal(0, 0.004, 3)


def _around(rng: np.random.Generator, count: int) -> list[Floats]:
    """Return `count` poses about the z axis, evenly turned, whose x axis points outwards."""
    angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(count) / max(1, count)
    return [np.asarray(Rotation.from_rotvec([0, 0, angle]).as_matrix()) for angle in angles]


def _rods(rng: np.random.Generator) -> Solid:
    """A frame of thin rods between random nodes, with a plate."""
    nodes = rng.uniform(-1.1, 1.1, (rng.integers(4, 8), 3))
    parts: list[Primitive] = []
    for first, second in zip(nodes, np.roll(nodes, 1, axis=0), strict=True):
        way = second - first
        parts.append(Cylinder((first + second) / 2, along(way), _wall(rng), float(np.linalg.norm(way)) / 2 + 0.05))
    half = rng.uniform(0.5, 1.1, 3)
    half[2] = _wall(rng) / 2
    parts.append(Box(rng.uniform(-0.3, 0.3, 3), Rotation.random(random_state=rng).as_matrix(), half))
    return Solid(parts)


def _blob(rng: np.random.Generator) -> Solid:
    """Ellipsoids grown together, some of them flat or thin: bodies with ears, fins and limbs."""
    parts: list[Primitive] = [Ellipsoid(half=rng.uniform(0.4, 0.9, 3))]
    for _ in range(rng.integers(4, 9)):
        half = rng.uniform(0.3, 0.8, 3)
        half[2] = rng.choice([_wall(rng), half[2]])
        if rng.random() < 0.4:
            half[1] = half[2]
        turn = Rotation.random(random_state=rng).as_matrix()
        parts.append(Ellipsoid(rng.uniform(-0.8, 0.8, 3), turn, half))
    return Solid(parts)


FAMILIES: Sequence[Callable[[np.random.Generator], Solid | LevelSet]] = [
    _bracket,
    _fins,
    _pipes,
    _shell,
    _wheel,
    _rods,
    _blob,
    creature,
    carving,
]
# What an archive may hold; "unseen" is for judging alone.
KINDS: Mapping[str, Sequence[Callable[[np.random.Generator], Solid | LevelSet | OpenSheet]]] = {
    "solid": FAMILIES,
    "casing": CASINGS,
    "open": OPEN_SHEETS,
    "unseen": UNSEEN,
}


@errors_in_one_line()
def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=archive_to_write)
    parser.add_argument("--count", type=positive, default=36)
    parser.add_argument("--seed", type=seed_number, default=0)
    parser.add_argument("--kind", choices=tuple(KINDS), default="solid")
    parser.add_argument(
        "--resolutions", type=int, nargs="+", choices=RESOLUTIONS, help="those to train on, all by default"
    )
    options = parser.parse_args()
    write_solids(options.path, options.count, seed=options.seed, resolutions=options.resolutions, kind=options.kind)


if __name__ == "__main__":
    _main()
