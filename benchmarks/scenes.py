"""Filter scenes that are known exactly, as six scanners see them; how far points lie from the truth, part by part.

python -m benchmarks.scenes [lidar ... disparity raster] [--noise 1.0] [--iterations auto] [--json FILE]

A street (ground, kerbs, walls with sills, cars, poles, railings, wires, leaves) and a room, of boxes, rods and balls.
Beams meet them exactly; noise is along the beam: 0.02 m for a spinning LiDAR of 64 rings and for a profile scanner
driven through the street, 0.03 m from the air, and 0.0012 + 0.0019 (z - 0.4)^2 m at depth z for a depth camera (Nguyen,
Izadi, Lovell 2012, axial noise of the Kinect). Another one, turned by 25 degrees, tells depths apart by whole
disparities alone, 0.00285 z^2 m apart, and has half of that as noise (Khoshelham, Elberink 2012); its points are in the
camera's frame, as such files are. A raster has heights of hills, every metre, with 0.6 m of noise in height
alone. --noise multiplies it.
"""

from __future__ import annotations

import argparse
import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from benchmarks.command import errors_in_one_line, file_to_write, noise_level, positive
from straightpcf.model.filter import load_filter
from straightpcf.points.options import DenoiseOptions

__all__ = ["SCANNERS", "Part", "Rod", "Scan", "distance_to", "room", "street"]

Floats = npt.NDArray[np.float64]
_DISPARITY = 0.00285  # 1 / m: depths that a Kinect tells apart are this times their square apart
_LEAST = 30  # points of a part that make a row of the table


@dataclass(frozen=True)
class Part(ABC):
    """A body of a scene and what it is called in the table."""

    name: str

    @abstractmethod
    def meet(self, origin: Floats, beam: Floats) -> Floats:
        """Return how far beams (N, 3) of length 1 from origins (N, 3) go until they meet it, inf where never: (N,)."""

    @abstractmethod
    def distance(self, xyz: Floats) -> Floats:
        """Return the distances (N,) of points (N, 3) from its surface, negative inside."""


@dataclass(frozen=True)
class Box(Part):
    """An upright box between two corners."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def meet(self, origin: Floats, beam: Floats) -> Floats:
        """Cut the beam with three slabs."""
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = (np.array(self.low) - origin) / beam, (np.array(self.high) - origin) / beam
        near = np.nanmax(np.minimum(*walls), axis=1)
        far = np.nanmin(np.maximum(*walls), axis=1)
        return np.where((near < far) & (near > 0), near, np.inf)

    def distance(self, xyz: Floats) -> Floats:
        """Measure from the nearest wall, edge or corner."""
        low, high = np.array(self.low), np.array(self.high)
        beyond = np.abs(xyz - (low + high) / 2) - (high - low) / 2
        outside: Floats = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
        return outside


@dataclass(frozen=True)
class Rod(Part):
    """A round rod between two points; beams meet its side, not its ends."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float

    def meet(self, origin: Floats, beam: Floats) -> Floats:
        """Solve for the side's quadric."""
        axis = np.array(self.end) - np.array(self.start)
        length = float(np.linalg.norm(axis))
        axis /= length
        offset = origin - np.array(self.start)
        across = beam - np.outer(beam @ axis, axis)
        away = offset - np.outer(offset @ axis, axis)
        a, b, c = (across**2).sum(axis=1), (across * away).sum(axis=1), (away**2).sum(axis=1) - self.radius**2
        inside = b * b - a * c
        hits = inside > 0
        far = np.where(hits, (-b - np.sqrt(np.where(hits, inside, 0))) / np.maximum(a, 1e-300), 0.0)
        along = (offset + far[:, None] * beam) @ axis
        return np.where(hits & (far > 0) & (along > 0) & (along < length), far, np.inf)

    def distance(self, xyz: Floats) -> Floats:
        """Measure from the axis, less the radius."""
        start = np.array(self.start)
        axis = np.array(self.end) - start
        along = np.clip((xyz - start) @ axis / (axis @ axis), 0, 1)
        side: Floats = np.linalg.norm(xyz - start - along[:, None] * axis, axis=1) - self.radius
        return side


@dataclass(frozen=True)
class Ball(Part):
    """A ball."""

    centre: tuple[float, float, float]
    radius: float

    def meet(self, origin: Floats, beam: Floats) -> Floats:
        """Solve the quadratic."""
        offset = origin - np.array(self.centre)
        b, c = (beam * offset).sum(axis=1), (offset**2).sum(axis=1) - self.radius**2
        inside = b * b - c
        far = -b - np.sqrt(np.maximum(inside, 0))
        return np.where((inside > 0) & (far > 0), far, np.inf)

    def distance(self, xyz: Floats) -> Floats:
        """Measure from the centre, less the radius."""
        shell: Floats = np.linalg.norm(xyz - np.array(self.centre), axis=1) - self.radius
        return shell


@dataclass(frozen=True)
class Hills(Part):
    """Ground of waves; beams meet it straight from above."""

    @staticmethod
    def height(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the height above places, and how steep the ground is there."""
        angles = 0.05 * x, 0.04 * y
        along = 0.625 * np.cos(angles[0]) * np.cos(angles[1]) + 0.002 * y
        across = -0.5 * np.sin(angles[0]) * np.sin(angles[1]) + 0.002 * x
        return 12.5 * np.sin(angles[0]) * np.cos(angles[1]) + 0.002 * x * y, np.hypot(along, across)

    def meet(self, origin: Floats, beam: Floats) -> Floats:
        """Go down to the ground."""
        far: Floats = np.where(beam[:, 2] == -1, origin[:, 2] - self.height(origin[:, 0], origin[:, 1])[0], np.inf)
        return far

    def distance(self, xyz: Floats) -> Floats:
        """Measure across the slope, to first order in the height."""
        height, steep = self.height(xyz[:, 0], xyz[:, 1])
        above: Floats = (xyz[:, 2] - height) / np.hypot(1, steep)
        return above


@dataclass(frozen=True)
class Seen(Part):
    """A body in the frame of a camera: turn (3, 3) and eye (3,) take a place in that to one in the scene."""

    body: Part
    turn: Floats
    eye: Floats

    def meet(self, origin: Floats, beam: Floats) -> Floats:
        """Meet the body in the scene."""
        return self.body.meet(origin @ self.turn.T + self.eye, beam @ self.turn.T)

    def distance(self, xyz: Floats) -> Floats:
        """Measure in the scene."""
        return self.body.distance(xyz @ self.turn.T + self.eye)


def street(seed: int = 0) -> list[Part]:
    """Build a street of 120 m along x, kerbs and walls on both sides, in metres."""
    rng = np.random.default_rng(seed)
    parts: list[Part] = [Box("ground", (-80, -80, -1), (80, 80, 0))]

    def box(name: str, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> None:
        parts.append(Box(name, (x[0], min(y), z[0]), (x[1], max(y), z[1])))

    for side in (-1, 1):
        box("kerb", (-60, 60), (side * 5, side * 8), (0, 0.12))
        x = -55.0
        while x < 55:
            wide, front = rng.uniform(8, 16), 8 + rng.uniform(0, 1)
            box("wall", (x, x + wide), (side * front, side * 20), (0, rng.uniform(5, 12)))
            for sill in np.arange(x + 1, x + wide - 2, 2.5):
                box("sill", (sill, sill + 1.2), (side * (front - 0.15), side * (front + 0.1)), (1.4, 1.5))
            x += wide + rng.choice([0.0, 0.0, 1.5])
        for x in np.arange(-50, 50, 9.0):
            parts.append(Rod("pole", (x, side * 5.5, 0), (x, side * 5.5, 6), rng.choice([0.04, 0.07, 0.12])))
        parts += [Rod("wire", (-50, side * 5.5, z), (50, side * 5.5, z), 0.015) for z in (5.5, 6.0)]
        for x in rng.uniform(-40, 40, 6):
            box("car", (x, x + 4), (side * 3, side * 4.7), (0.25, 0.95))
            box("car", (x + 0.8, x + 3), (side * 3.15, side * 4.55), (0.95, 1.45))
            wheels = [(x + 0.8, 0.3), (x + 3.2, 0.3)]
            parts += [Rod("car", (wheel, side * 3, z), (wheel, side * 4.7, z), 0.3) for wheel, z in wheels]
        for x in rng.uniform(-45, 45, 3):
            parts.append(Rod("pole", (x, side * 6.5, 0), (x, side * 6.5, 3), 0.15))
            parts += _crown(rng, (x, side * 6.5, 4.2), 1.6, count=220, leaf=0.06)
    for x in (-20.0, 15.0):
        parts += [Rod("railing", (x + 0.15 * k, 4.8, 0.12), (x + 0.15 * k, 4.8, 1.1), 0.01) for k in range(30)]
        parts.append(Rod("railing", (x, 4.8, 1.1), (x + 4.35, 4.8, 1.1), 0.02))
    return parts


def room(seed: int = 0) -> list[Part]:
    """Build a room with a table, balls on it, shelves and a plant, in metres; the camera looks along y."""
    rng = np.random.default_rng(seed)
    parts: list[Part] = [
        Box("ground", (-4, -1, -0.5), (4, 7, 0)),
        Box("wall", (-4, 4.2, 0), (4, 4.5, 3)),
        Box("wall", (-2.2, -1, 0), (-2, 7, 3)),
        Box("wall", (2.2, -1, 0), (2.4, 7, 3)),
        Box("table", (-0.8, 1.8, 0.7), (0.6, 2.6, 0.74)),
        Box("table", (0.9, 2.9, 0), (1.7, 3.6, 1.2)),
        Box("bench", (-2, 3.6, 0), (-0.6, 4.2, 0.4)),
    ]
    parts += [Rod("leg", (x, y, 0), (x, y, 0.7), 0.02) for x in (-0.75, 0.55) for y in (1.85, 2.55)]
    parts += [Box("shelf", (-1.9, 4.0, 1.2 + 0.3 * k), (-0.5, 4.2, 1.22 + 0.3 * k)) for k in range(5)]
    parts += [Ball("ball", (rng.uniform(-0.7, 0.5), rng.uniform(1.9, 2.5), 0.8), 0.06) for _ in range(6)]
    for _ in range(12):
        tip = (1.3 + rng.uniform(-0.35, 0.35), 3.2 + rng.uniform(-0.35, 0.35), 1.2 + rng.uniform(0.3, 0.8))
        parts.append(Rod("twig", (1.3, 3.2, 1.2), tip, 0.008))
    return parts + _crown(rng, (1.3, 3.2, 1.8), 0.35, count=60, leaf=0.025)


def _crown(
    rng: np.random.Generator, centre: tuple[float, float, float], wide: float, *, count: int, leaf: float
) -> list[Part]:
    away = rng.standard_normal((count, 3))
    away *= wide * rng.uniform(size=(count, 1)) ** (1 / 3) / np.linalg.norm(away, axis=1, keepdims=True)
    return [Ball("leaf", (centre[0] + x, centre[1] + y, centre[2] + z), leaf) for x, y, z in away]


@dataclass(frozen=True)
class Scan:
    """What a scanner saw of a scene: points without and with noise, (N, 3), and which part each is of, (N,)."""

    parts: list[Part]
    clean: Floats
    noisy: Floats
    part: npt.NDArray[np.int64]


def _scan(parts: list[Part], origin: Floats, beam: Floats, reach: float, noise: Callable[[Floats], Floats]) -> Scan:
    beam = beam / np.linalg.norm(beam, axis=1, keepdims=True)
    origin = np.broadcast_to(origin, beam.shape)
    far, which = np.full(len(beam), np.inf), np.zeros(len(beam), dtype=np.int64)
    for number, part in enumerate(parts):
        met = part.meet(origin, beam)
        nearer = met < far
        far[nearer], which[nearer] = met[nearer], number
    seen = far < reach
    origin, beam, far = origin[seen], beam[seen], far[seen]
    clean = origin + beam * far[:, None]
    along = noise(clean) * np.random.default_rng(1).standard_normal(len(far))
    return Scan(parts, clean, clean + beam * along[:, None], which[seen])


def _grid(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    a, b = np.meshgrid(first, second, indexing="ij")
    return a.ravel(), b.ravel()


def _lidar(noise: float) -> Scan:
    up, round_ = _grid(np.deg2rad(np.linspace(-24.8, 2, 64)), np.linspace(0, 2 * np.pi, 1800, endpoint=False))
    beam = np.stack([np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)], axis=1)
    return _scan(street(), np.array([0, 0, 1.8]), beam, 70.0, lambda xyz: np.full(len(xyz), 0.02 * noise))


def _mobile(noise: float) -> Scan:
    x, round_ = _grid(np.arange(-8, 8, 0.04), np.linspace(0, 2 * np.pi, 400, endpoint=False))
    beam = np.stack([np.cos(round_), np.cos(round_), np.sqrt(2) * np.sin(round_)], axis=1)
    origin = np.stack([x, 0 * x, 0 * x + 2.2], axis=1)
    return _scan(street(), origin, beam, 40.0, lambda xyz: np.full(len(xyz), 0.02 * noise))


def _aerial(noise: float) -> Scan:
    x, y = _grid(np.arange(-40, 40, 0.18), np.arange(-20, 20, 0.12))
    x = x + 0.02 * np.random.default_rng(2).standard_normal(len(x))
    origin = np.stack([x + 8, 0 * x, 0 * x + 60], axis=1)
    return _scan(
        street(), origin, np.stack([x, y, 0 * x], axis=1) - origin, 200.0, lambda xyz: np.full(len(xyz), 0.03 * noise)
    )


def _depth(noise: float) -> Scan:
    column, row = _grid(np.arange(0, 640, 1.5), np.arange(0, 480, 1.5))
    beam = np.stack([(column - 320) / 525, np.ones_like(column), -(row - 240) / 525 - 0.25], axis=1)
    return _scan(
        room(), np.array([0, 0, 1.3]), beam, 8.0, lambda xyz: noise * (0.0012 + 0.0019 * (xyz[:, 1] - 0.4) ** 2)
    )


def _disparity(noise: float) -> Scan:
    turn = Rotation.from_euler("zx", [25, -12], degrees=True).as_matrix()
    parts: list[Part] = [Seen(part.name, part, turn, np.array([0, 0, 1.3])) for part in room()]
    column, row = _grid(np.arange(0, 640, 1.5), np.arange(0, 480, 1.5))
    beam = np.stack([(column - 320) / 525, np.ones_like(column), -(row - 240) / 525], axis=1)
    scan = _scan(parts, np.zeros(3), beam, 8.0, lambda xyz: np.zeros(len(xyz)))
    depth = scan.clean[:, 1]
    disparity = 1 / (_DISPARITY * depth) + 0.5 * noise * np.random.default_rng(1).standard_normal(len(depth))
    told = 1 / (_DISPARITY * np.maximum(1, np.round(disparity)))
    noisy = scan.clean * (told / depth)[:, None]
    noisy[:, 1] = told  # to the bit, as a depth image has it
    return Scan(parts, scan.clean, noisy, scan.part)


def _raster(noise: float) -> Scan:
    x, y = _grid(np.arange(-50, 50, 1.0), np.arange(-50, 50, 1.0))
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), (len(x), 3))
    origin = np.stack([x, y, np.full(len(x), 100.0)], axis=1)
    return _scan([Hills("hills")], origin, down, 200.0, lambda xyz: np.full(len(xyz), 0.6 * noise))


SCANNERS: dict[str, Callable[[float], Scan]] = {
    "lidar": _lidar,
    "mobile": _mobile,
    "aerial": _aerial,
    "depth": _depth,
    "disparity": _disparity,
    "raster": _raster,
}


def distance_to(parts: list[Part], xyz: Floats) -> Floats:
    """Return how far points (N, 3) lie from the nearest surface of a scene: (N,)."""
    nearest = np.full(len(xyz), np.inf)
    for part in parts:
        np.minimum(nearest, np.abs(part.distance(xyz)), out=nearest)
    return nearest


@errors_in_one_line()
def main(arguments: list[str] | None = None) -> None:
    """Filter the scans and print what is left."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if unknown := set(options.scanners) - SCANNERS.keys():
        parser.error(f"{min(unknown)!r} is no scanner; there are {', '.join(SCANNERS)}")
    denoiser = load_filter(options.weights, threads=options.threads)
    rows = []
    for name in options.scanners or SCANNERS:
        scan = SCANNERS[name](options.noise)
        keep = slice(None, None, options.every)
        noisy = scan.noisy[keep]
        began = time.perf_counter()
        result = denoiser.denoise(noisy, DenoiseOptions.parse(iterations=options.iterations))
        seconds = time.perf_counter() - began
        noise = f"noise read {1000 * result.noise_before:.1f} mm"
        print(f"\n{name}: {len(noisy)} points, {result.iterations} passes, {noise}, {seconds:.0f} s")
        for part, points, before, after in _rows(scan, keep, result.xyz):
            print(f"  {part:8s} {points:7d} points  rms distance {before:6.2f} -> {after:6.2f} mm")
            rows.append({"scanner": name, "part": part, "points": points, "before": before, "after": after})
        own = " -> ".join(f"{_rms(np.linalg.norm(xyz - scan.clean[keep], axis=1)):.2f}" for xyz in (noisy, result.xyz))
        print(f"  from where each point would be without noise: rms {own} mm")
        moved = 1000 * np.percentile(np.linalg.norm(result.xyz - noisy, axis=1), (50, 90, 99, 100))
        print("  moved, mm: 50 % {:.1f}  90 % {:.1f}  99 % {:.1f}  most {:.1f}".format(*moved))
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=1))


def _rows(scan: Scan, keep: slice, filtered: Floats) -> list[tuple[str, int, float, float]]:
    before, after = distance_to(scan.parts, scan.noisy[keep]), distance_to(scan.parts, filtered)
    names = np.array([part.name for part in scan.parts])[scan.part[keep]]
    rows = []
    for part in ("all", *sorted(set(names.tolist()))):
        of = (names == part) | (part == "all")
        if of.sum() >= _LEAST:
            rows.append((part, int(of.sum()), _rms(before[of]), _rms(after[of])))
    return rows


def _rms(distances: Floats) -> float:
    return float(1000 * np.sqrt(np.mean(distances**2)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Filter scenes that are known exactly.")
    parser.add_argument("scanners", nargs="*", metavar="SCANNER", help=f"of {', '.join(SCANNERS)}; default: all")
    parser.add_argument("--noise", type=noise_level, default=1.0, help="times each scanner's own")
    parser.add_argument("--iterations", default="auto")
    parser.add_argument("--every", type=positive, default=1, help="take each n-th point only")
    parser.add_argument("--weights", type=Path, help="default: the shipped ones")
    parser.add_argument("--threads", type=positive)
    parser.add_argument("--json", type=file_to_write, help="write the figures here")
    return parser


if __name__ == "__main__":
    main()
