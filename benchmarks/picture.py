"""Draw the picture of the README: a body and a room, as they came and as the filter leaves them.

python -m benchmarks.picture docs/before-after.jpg

A turned body with 2 % of Gaussian noise, and the room of `benchmarks.scenes` as its depth camera has it, seen from
beside that camera. Points are discs, lit by the plane of the 16 nearest of each.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.command import errors_in_one_line, file_to_write, positive
from benchmarks.scenes import SCANNERS, Rod, distance_to
from benchmarks.shapes import evenly_on, make_noise, turned
from straightpcf.model.filter import load_filter
from straightpcf.model.metrics import unit_sphere
from straightpcf.model.normals import recompute_normals

__all__: list[str] = []

Floats = npt.NDArray[np.float64]
_NOISE = 0.02  # of the body, in radii
_WIDE, _HIGH = 640, 480  # pixels of a view
_FINER = 3  # drawn so many times as large, then made smaller
_LIGHT = np.array([-0.4, 0.5, 0.77])  # from the left, above and the eye
_DARK, _BRIGHT = np.array([0.10, 0.14, 0.22]), np.array([0.72, 0.84, 0.95])


@dataclass(frozen=True)
class _Eye:
    """Where a view is seen from, what it looks at, both (3,), how wide it is there, and a point's radius."""

    place: Floats
    at: Floats
    wide: float
    disc: float

    def _seen(self, xyz: Floats) -> Floats:
        """Return points (N, 3) to the right of what is looked at, above it, and towards the eye."""
        back = self.place - self.at
        back = back / np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        seen: Floats = (xyz - self.at) @ np.stack([right, np.cross(back, right), back], axis=1)
        return seen

    def draw(self, xyz: Floats) -> Floats:
        """Draw points (N, 3): (H, W, 3), 0 to 1."""
        seen, far = self._seen(xyz), float(np.linalg.norm(self.place - self.at))
        ahead = far - seen[:, 2]
        seen, ahead = seen[ahead > 0], ahead[ahead > 0]
        size = np.array([_HIGH, _WIDE]) * _FINER
        pixels = size[1] / self.wide * far / ahead  # one unit of length, there
        colours = _DARK + _lit(seen)[:, None] * (_BRIGHT - _DARK)
        middle = size / 2 + pixels[:, None] * seen[:, 1::-1] * [-1, 1]
        radius = np.maximum(1.0, self.disc * pixels)
        most = int(np.ceil(radius.max()))
        rows, columns = np.mgrid[-most : most + 1, -most : most + 1].reshape(2, -1)
        order = np.argsort(seen[:, 2])
        image = np.ones((*size, 3))
        for some in np.array_split(order, max(1, len(order) * len(rows) // 2**22)):  # from behind
            place = np.round(middle[some]).astype(np.int64)[:, None, :] + np.stack([rows, columns], axis=1)
            shown = (np.hypot(rows, columns) <= radius[some, None]) & ((place >= 0) & (place < size)).all(axis=2)
            of = np.broadcast_to(some[:, None], shown.shape)[shown]
            image[place[shown][:, 0], place[shown][:, 1]] = colours[of]
        smaller: Floats = image.reshape(_HIGH, _FINER, _WIDE, _FINER, 3).mean(axis=(1, 3))
        return smaller


_BODY = _Eye(np.array([3.0, -6.0, 3.5]), np.array([0, 0, 0.75]), wide=2.45, disc=0.008)
_ROOM = _Eye(np.array([1.9, -1.2, 2.5]), np.array([-0.1, 3.3, 0.85]), wide=4.4, disc=0.008)


def _lit(seen: Floats) -> Floats:
    """Return how bright points are, 0 to 1, (N,), each by the plane of its nearest."""
    towards_the_eye = np.broadcast_to([0.0, 0.0, 1.0], seen.shape)
    lit: Floats = np.clip(recompute_normals(seen, towards_the_eye) @ _LIGHT, 0, 1)
    return lit


def _outline() -> Floats:
    """Return radius and height of a turned body from below to its top: (M, 2)."""
    foot = np.array([
        (0, 0), (0.42, 0), (0.42, 0.08), (0.36, 0.12), (0.36, 0.2), (0.24, 0.3), (0.17, 0.45), (0.14, 0.7),
        (0.13, 0.95), (0.24, 1.0), (0.24, 1.05), (0.14, 1.1),
    ])  # fmt: skip
    angle = np.linspace(np.deg2rad(146), 0, 40)
    return np.concatenate([foot, np.stack([0.25 * np.sin(angle), 1.28 + 0.25 * np.cos(angle)], axis=1)])


def _body(outline: Floats, points: int) -> Floats:
    """Sample what an outline (M, 2) makes when turned, evenly: (points, 3)."""
    steps = [np.linspace(a, b, 12, endpoint=False) for a, b in pairwise(outline)]
    return evenly_on(*turned(np.concatenate([*steps, outline[-1:]])), points, np.random.default_rng(0))


def _from_outline(xyz: Floats, outline: Floats) -> Floats:
    """Return the distances (N,) of points (N, 3) from the surface that an outline (M, 2) makes when turned."""
    beside_axis = np.stack([np.hypot(xyz[:, 0], xyz[:, 1]), np.zeros(len(xyz)), xyz[:, 2]], axis=1)
    ends = [(float(radius), 0.0, float(height)) for radius, height in outline]
    return distance_to([Rod("", *some, radius=0.0) for some in pairwise(ends)], beside_axis)


@errors_in_one_line()
def main() -> None:
    """Filter both, draw all four views, and print how far points lie from the truth."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.picture", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("picture", type=file_to_write, help="a PNG or JPEG file")
    parser.add_argument("--points", type=positive, default=50_000, help="of the body")
    parser.add_argument("--every", type=positive, default=1, help="take each n-th point of the room only")
    parser.add_argument("--threads", type=positive)
    options = parser.parse_args()
    denoiser = load_filter(threads=options.threads)
    outline, scan = _outline(), SCANNERS["depth"](1.0)
    clean = _body(outline, options.points)
    body, room = make_noise("gaussian", clean, _NOISE, 0), scan.noisy[:: options.every]
    percent = unit_sphere(clean)[1] / 100
    views = []
    for said, xyz in (("as it came", body), ("filtered", denoiser.denoise(body).xyz)):
        off = _rms(_from_outline(xyz, outline)) / percent
        views.append((f"{len(xyz):,} points, 2 % of noise, {said}: {off:.2f} % from the truth", _BODY.draw(xyz)))
    for said, xyz in (("as it came", room), ("filtered", denoiser.denoise(room).xyz)):
        off = 1000 * _rms(distance_to(scan.parts, xyz))
        views.append((f"{len(xyz):,} points of a depth camera, {said}: {off:.1f} mm", _ROOM.draw(xyz)))
    print("\n".join(title for title, _ in views))
    _write(views, options.picture)


def _rms(distances: Floats) -> float:
    return float(np.sqrt(np.mean(distances**2)))


def _write(views: list[tuple[str, Floats]], file: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 2, figsize=(11, 8.6), layout="constrained")
    for (title, image), axis in zip(views, axes.flat, strict=True):
        axis.imshow(image)
        axis.set_title(title)
        axis.axis("off")
    figure.savefig(file, dpi=100)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
