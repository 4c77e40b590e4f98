"""Clouds that were seen from one place: their points lie on a raster of beams, and their noise along these alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from straightpcf.model.patches import Patches
from straightpcf.model.processor import Mapper

__all__ = ["View", "along_beams"]

Floats = npt.NDArray[np.float64]

# Seen along its beams a raster is as regular as it was made, however noisy: the logarithm of the distance to the
# nearest point varies within a patch with a std of 0.00 to 0.02; of even clouds with 0.023 and more, of all others with
# 0.1 and more, from wherever these are looked at. Where the eye is near, parallel beams make a little more of it.
_REGULAR, _REGULAR_ALONG, _REGULAR_SHARE = 0.03, 0.06, 0.75  # the last: of patches
# Patches that are looked at, and how few will do; their nearest points, and of these the middle.
_PATCHES, _FEWEST, _NEAREST, _MIDDLE = 8, 4, 300, 60
_DIRECTIONS, _BEST, _ROUNDS, _AROUND, _FIRST_TURN = 400, 3, 6, 8, 0.08  # that are tried, and how the best are bettered
# By how many trials a view of all is bettered, as what the worst patch counts, and from which mean on it is not tried.
_TRIALS, _MOST_IRREGULAR, _HOPELESS = 120, 0.3, 0.2
_LEAST_APART = 0.1  # of the distance between points: where they are seen nearer, they lie behind one another
_ONE_SIGMA = (0.16, 0.84)
# The surface that a beam meets is a plane of so many of its neighbours in the image, of those that are no deeper beside
# the point than so many times what a quarter of them are, without such as are more than so many of their stds off it.
_PLANE_NEIGHBOURS, _BESIDE_DEPTHS, _PLANE_ROUNDS, _OFF_PLANE_STDS = 48, 5.0, 3, 3.5
# How far that plane is off, beside the noise along the beams; noise stds that a point is off it, or its neighbours are,
# from where on it lies in no such plane; of a patch's points the share whose neighbours are off their planes by noise
# alone, however little of it is believed.
_GRAZING, _ALONE_STDS, _THICK_STDS, _THINNEST = 0.1, 3.0, 2.0, 0.1
_LEAST = 1e-12  # of lengths in the unit ball
_STD_OF_MEDIAN, _RIDGE = 1.4826, 1e-9  # of absolute deviations, normal noise; what is added to a singular matrix
_LEAST_TOWARDS, _NOWHERE = 0.1, 1e9  # cosine of two beams, below which one has no place in the other's image: far away


@dataclass(frozen=True)
class View:
    """The place that a cloud was seen from, maybe far away: its beams pass through `way / nearness`.

    way: (3,); nearness: the beam through a point x is along way - nearness x, and all are parallel where it is 0.
    """

    way: Floats
    nearness: float

    @classmethod
    def of(
        cls, xyz: Floats, patches: Patches, origin: Floats | None, device: str, *, mapper: Mapper = map
    ) -> View | None:
        """Return the view of points (N, 3) in the unit ball, None where they are no raster of beams.

        patches: some, spread over the cloud; origin: (3,), from which scanners count, which is tried first.
        device: that looks at them; mapper: calls a function with each of them, on threads if it has some.
        """
        if patches.index.shape[1] < _NEAREST or len(patches.seeds) < _FEWEST:
            return None
        some = [_Raster.of(_nearest_to(xyz[patches.seeds[n]], xyz[patches.index[n]])) for n in _evenly(patches.owned)]
        if _are_regular(some, [raster.broadside() for raster in some]):
            return None  # as they would from anywhere: there is no noise to speak of
        if origin is not None and (seen := cls(origin, 1.0)).fits(some):
            return seen
        lines: list[Floats] = []
        others = 0
        looked_at = mapper(partial(_Raster.most_regular, device=device), some)
        for raster, (irregularity, direction) in zip(some, looked_at, strict=True):
            if irregularity <= _REGULAR_ALONG:
                lines.append(np.concatenate([raster.points[0], direction]))
            else:
                others += 1
            if others > (1 - _REGULAR_SHARE) * len(some):
                return None
        seen = cls._through(np.array(lines))
        if seen._mean_irregularity(some) > _HOPELESS:
            return None
        seen = seen.bettered(some)
        return seen if seen.fits(some) else None

    @classmethod
    def _through(cls, lines: Floats) -> View:
        """Return the view whose beams are nearest to lines (n, 6), each a point and a direction; least squares."""
        points, directions = lines[:, :3], lines[:, 3:]
        off = np.eye(3) - directions[:, :, None] * directions[:, None]
        terms = np.concatenate([off, -(off @ points[:, :, None])], axis=2).reshape(-1, 4)
        *way, nearness = np.linalg.svd(terms)[2][-1]
        return cls(np.array(way), float(nearness))

    def bettered(self, rasters: list[_Raster]) -> View:
        """Return the view near this one from where rasters are most regular."""
        here = np.append(self.way, self.nearness)
        here /= np.linalg.norm(here)
        others = np.linalg.svd(here[None])[2][1:]

        def view(turn: Floats) -> View:
            *way, nearness = here + turn @ others
            return View(np.array(way), float(nearness))

        simplex = np.concatenate([np.zeros((1, 3)), _FIRST_TURN / 2 * np.eye(3)])
        found = minimize(
            lambda turn: view(turn)._mean_irregularity(rasters),
            simplex[0],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": _TRIALS},
        )
        return view(found.x)

    def fits(self, rasters: list[_Raster]) -> bool:
        """Say whether most of some rasters are regular from here."""
        return _are_regular(rasters, [self] * len(rasters))

    def _mean_irregularity(self, rasters: list[_Raster]) -> float:
        return float(np.mean([min(raster.irregularity(self), _MOST_IRREGULAR) for raster in rasters]))

    def beams(self, points: Floats) -> Floats:
        """Return the directions of the beams to points (n, 3), of length 1, towards the eye or away: (n, 3)."""
        ways = self.way - self.nearness * points
        out: Floats = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), _LEAST)
        return out

    def image(self, points: Floats) -> Floats:
        """Return where points (n, 3) are seen beside the first, (n, 2): on the plane through it across its beam."""
        beams, apart = self.beams(points), points - points[0]
        first, second = np.linalg.svd(beams[:1])[2][1:]
        towards = beams @ beams[0]
        is_ahead = np.abs(towards) > _LEAST_TOWARDS
        seen = apart - beams * (apart @ beams[0] / np.where(is_ahead, towards, 1.0))[:, None]
        across = np.stack([seen @ first, seen @ second], axis=1)
        out: Floats = np.where(is_ahead[:, None], across, _NOWHERE)
        return out


def along_beams(step: Floats, patch: Floats, view: View, noise_std: float) -> Floats:
    """Return steps (n, 3) along the beams to where those that are asked for take the surface.

    patch: (P, 3) points, of which the first n make the step; noise_std: of the patch, across its surface. The more a
    beam grazes the surface the less a step across says of how far along the beam the point was, and the more of it is
    made across. What lies in no surface, as a twig before a wall, has of its step what goes along the beam.
    """
    if len(step) == 0:
        return step
    beams = view.beams(patch[: len(step)])
    normals, off, thickness = _planes_in_image(patch, beams, view)
    upright = (normals * beams).sum(axis=1, keepdims=True)
    across = (step * normals).sum(axis=1, keepdims=True)
    along = across * upright / (np.square(upright) + _GRAZING**2)
    noise_std = max(noise_std, float(np.quantile(thickness, _THINNEST)))
    alone = (off > _ALONE_STDS * np.maximum(noise_std, thickness)) | (thickness > _THICK_STDS * noise_std)
    of_none = (step * beams).sum(axis=1, keepdims=True) * beams
    out: Floats = np.where(alone[:, None], of_none, along * beams + (across - along * upright) * normals)
    return out


def _planes_in_image(patch: Floats, beams: Floats, view: View) -> tuple[Floats, Floats, Floats]:
    """Return the planes that points' neighbours in the image lie in, fitted along their beams.

    patch: (P, 3), of which the first n points have beams (n, 3). Return the normals (n, 3), how far each point is off
    its plane (n,), and the std of its neighbours across it (n,).
    """
    seen = view.image(patch)
    _, near = cKDTree(seen).query(seen[: len(beams)], k=np.arange(1, min(_PLANE_NEIGHBOURS, len(patch)) + 1))
    axes = np.linalg.svd(beams[:, None])[2]  # (n, 3, 3), rows, the first a beam
    deeper, *beside = np.moveaxis((patch[near] - patch[: len(beams), None]) @ axes.mT, 2, 0)
    reach = np.maximum(np.sqrt(np.square(beside).sum(axis=0).max(axis=1, keepdims=True)), _LEAST)
    terms = np.stack([np.ones(near.shape), *(each / reach for each in beside)], axis=2)
    quarter = np.sort(np.abs(deeper), axis=1)[:, near.shape[1] // 4, None]
    among = np.abs(deeper) <= _BESIDE_DEPTHS * quarter
    middle = among.sum(axis=1, keepdims=True) // 2
    weights = among.astype(np.float64)
    for _ in range(_PLANE_ROUNDS):
        weighted = terms * weights[:, :, None]
        plane = np.linalg.solve(weighted.mT @ terms + _RIDGE * np.eye(3), weighted.mT @ deeper[:, :, None])
        off = np.abs(deeper - (terms @ plane)[:, :, 0])
        median = np.take_along_axis(np.sort(np.where(among, off, np.inf), axis=1), middle, axis=1)
        std = np.maximum(_STD_OF_MEDIAN * median, _LEAST)
        weights = among * np.square(np.maximum(1 - np.square(off / (_OFF_PLANE_STDS * std)), 0.0))  # Tukey's
    slopes = plane[:, 1:, 0] / reach
    normals = axes[:, 0] - slopes[:, :1] * axes[:, 1] - slopes[:, 1:] * axes[:, 2]
    upright = 1 / np.linalg.norm(normals, axis=1)
    return normals * upright[:, None], off[:, 0] * upright, std[:, 0] * upright


@dataclass(frozen=True)
class _Raster:
    """Points around a place, nearest first.

    points: (n, 3); nearest: how far the nearest are from each other in the middle; across_places: (m, m), what takes
    from values of the m points of the middle what goes with their places.
    """

    points: Floats
    nearest: float
    across_places: torch.Tensor

    @classmethod
    def of(cls, points: Floats) -> _Raster:
        middle = points[:_MIDDLE]
        distances, _ = cKDTree(points).query(middle, k=2)
        terms = np.linalg.qr(np.column_stack([np.ones(len(middle)), middle - points[0]]))[0]
        across_places = torch.from_numpy(np.eye(len(middle)) - terms @ terms.T)
        return cls(points, float(np.median(distances[:, 1])), across_places)

    def irregularity(self, view: View) -> float:
        """Return how irregular they are from a view: a std of logarithms, infinite where they lie behind each other."""
        seen = view.image(self.points)
        distances, _ = cKDTree(seen).query(seen[:_MIDDLE], k=2)
        found = _irregularity(torch.from_numpy(distances[:, 1:]), self.across_places, self.nearest)
        return float(found[0])

    def broadside(self) -> View:
        """Return the view from far away across the plane that is nearest to them."""
        return View(np.linalg.svd(self.points - self.points.mean(axis=0), full_matrices=False)[2][-1], 0.0)

    def most_regular(self, device: str) -> tuple[float, Floats]:
        """Return how irregular they are along the direction (3,) where they are least so, and that direction."""
        points = torch.from_numpy((self.points - self.points[0]) / self.nearest).to(device, torch.float32)
        apart = points[:_MIDDLE, None] - points
        squared = apart.square().sum(dim=2)
        squared[range(_MIDDLE), range(_MIDDLE)] = torch.inf
        places = self.across_places.to(device, torch.float32)

        def irregularity(directions: torch.Tensor) -> torch.Tensor:  # (m, 3) -> (m,)
            seen = (apart @ directions.T).square_().neg_().add_(squared[:, :, None]).amin(dim=1)
            return _irregularity(seen.clamp_(min=0).sqrt_(), places, 1.0)

        found, best = irregularity(tried := _half_sphere(_DIRECTIONS).to(device)).topk(_BEST, largest=False)
        directions = tried[best]
        turn, angles = _FIRST_TURN, torch.arange(_AROUND, device=device) * (2 * np.pi / _AROUND)
        circle, units = torch.stack([angles.cos(), angles.sin()], dim=1), torch.eye(3, device=device)
        for _ in range(_ROUNDS):
            first = torch.linalg.cross(directions, units[directions.abs().argmin(dim=1)])
            across = torch.stack([first, torch.linalg.cross(directions, first)], dim=1)  # (best, 2, 3)
            across = torch.nn.functional.normalize(across, dim=2)
            around = torch.nn.functional.normalize(directions[:, None] + turn * circle @ across, dim=2)
            each = torch.cat([directions[:, None], around], dim=1)
            found, at = irregularity(each.flatten(0, 1)).view(_BEST, -1).min(dim=1)
            directions, turn = each[range(_BEST), at], turn / 2
        least = found.argmin()
        return float(found[least]), directions[least].double().cpu().numpy()


def _are_regular(rasters: list[_Raster], views: list[View]) -> bool:
    """Say whether most of some rasters are regular, each from its own view."""
    others = 0
    for raster, view in zip(rasters, views, strict=True):
        others += raster.irregularity(view) > _REGULAR
        if others > (1 - _REGULAR_SHARE) * len(rasters):
            return False
    return True


def _irregularity(distances: torch.Tensor, across_places: torch.Tensor, nearest: float) -> torch.Tensor:
    """Return half of what lies between one std below and above the middle of the logarithms of (n, m): (m,).

    across_places: (n, n), of `_Raster`: what is far away is seen small; nearest: the distance in space.
    """
    logs = distances.clamp(min=1e-30).log()
    low, high = torch.quantile(across_places @ logs, torch.tensor(_ONE_SIGMA).to(logs), dim=0)
    behind = distances.median(dim=0).values < _LEAST_APART * nearest
    return torch.where(behind, torch.inf, (high - low) / 2)


def _nearest_to(seed: Floats, points: Floats) -> Floats:
    order = np.argsort(np.square(points - seed).sum(axis=1), kind="stable")
    return points[order[:_NEAREST]]


def _evenly(owned: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return which patches are looked at, (n,), of such as own (M,) points: as even a share of the points has each."""
    count = min(_PATCHES, len(owned))
    below = np.cumsum(owned if owned.any() else np.ones(len(owned), dtype=np.int64))
    return np.unique(np.searchsorted(below, (np.arange(count) + 0.5) / count * below[-1]))


def _half_sphere(count: int) -> torch.Tensor:
    """Return directions (count, 3) spread evenly over half a sphere, on a Fibonacci spiral."""
    number = torch.arange(count) + 0.5
    height, turn = 1 - number / count, np.pi * (1 + np.sqrt(5)) * number
    flat = (1 - height**2).sqrt()
    return torch.stack([turn.cos() * flat, turn.sin() * flat, height], dim=1)
