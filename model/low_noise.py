"""Clouds with little noise beside the distance between their points: how far the points of one may go.

Where the distance between points is a good part of a shape's radii of curvature, the network takes shape for noise: it
moves 1000 clean points of a bust by 0.5 % of its radius. A surface of second order through a few neighbours tells the
two apart, as long as noise does not tilt it (docs/filter.md, "Little noise").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.arrays import Array, namespace, on_host
from straightpcf.model.neighbourhoods import Nearest, Neighbourhoods, surface_terms

__all__ = [
    "EXACT_PLANE_RATIO",
    "FIT_NEIGHBOURS",
    "HIGH_NOISE_RATIO",
    "LINES_NEIGHBOURS",
    "SCENE_NEIGHBOURS",
    "NeighbourhoodNoise",
    "limited_to_surfaces",
    "low_noise_weight",
    "noise_on_surfaces",
    "wiener_share",
    "wiener_weighted",
]

Floats = npt.NDArray[np.float64]

FIT_NEIGHBOURS, _FIT_TERMS = 16, 6  # points to which a surface is fitted, and its coefficients
LINES_NEIGHBOURS = 64  # of which those are chosen where the nearest of most points are of one line
_RIDGE = 1e-9  # points in a line have a surface, too; in units of the neighbourhood's radius
# The noise of so many points near each other is what a quarter of their surfaces leave, or less: the others have edges,
# bends and thin parts. It is not that of the whole patch, for noise may differ from place to place.
_NOISE_QUANTILE, _NOISE_NEIGHBOURS = 0.25, 80
# Noise beside the radius of the 16: up to the first a cloud has little, from the second on it has not at all.
_LOW_NOISE_RATIO, HIGH_NOISE_RATIO = 0.05, 0.08
# A point so many times that noise from its neighbours' surface, of which the network takes off so much, is one
# with more noise than the others.
_OUTLIER_STDS, _OUTLIER_STEP_SHARE = 6.0, 0.6
# Of a scene the noise of a place is what a tenth of its surfaces leave, or less, which is so much less than the noise
# where all are of one plane (the std of so few heights, chi of 10 degrees of freedom). Each is fitted to 16 of so many
# nearest; those of lines tell nothing (the lesser std along their plane below a share of the greater).
_SCENE_QUANTILE, _SCENE_QUANTILE_STD, SCENE_NEIGHBOURS, _LINE_RATIO = 0.1, 0.7, 32, 0.5
# It is not the noise where that is as large as the neighbourhood: the nearest of a thick slab fill a ball. So many
# times what is believed of any place is no slab's thickness: there it is how rough the place is.
_SEEN_UP_TO_RADII, _UNSEEN_FROM_RADII, _THICKEST_RATIO = 0.05, 0.1, 4.0
EXACT_PLANE_RATIO = 1e-3  # of its width: below it a plane is drawn, not scanned: of the noise beside it it says nothing
_LEAST_LEVERAGE_LEFT = 0.1  # of a point's residual, what the fit to itself has left


@dataclass(frozen=True)
class _Surfaces:
    """What surfaces fitted to the neighbours of n points leave.

    stds: (n,), of the neighbours; own_residuals: (n,), of the point itself, had the surface been fitted to the others
    only; radii: (n,), of the neighbourhoods; normals: (n, 3), of length 1.
    """

    stds: Array
    own_residuals: Array
    radii: Array
    normals: Array


@dataclass(frozen=True)
class NeighbourhoodNoise:
    """What surfaces fitted to neighbours leave of the points of M patches, all (M,).

    in_radii, stds: their noise, in radii of the neighbourhoods and in the unit of the points; loud_shares: how many of
    them are many times that noise off their neighbours' surface; breadths: how broad the neighbourhoods are beside
    their length, as stds.
    """

    in_radii: Floats
    stds: Floats
    loud_shares: Floats
    breadths: Floats

    @classmethod
    def of(cls, near: Nearest, patches: int) -> NeighbourhoodNoise:
        """Look at the nearest points of some, as many of each patch, patch after patch."""
        return cls._on(near.first(FIT_NEIGHBOURS), patches)

    @classmethod
    def of_lines(cls, near: Nearest, patches: int) -> NeighbourhoodNoise:
        """Do the same where points lie in lines: the nearest of most are of one, which is in the plane of its beams."""
        return cls._on(_around(near, LINES_NEIGHBOURS), patches)

    @classmethod
    def _on(cls, near: Neighbourhoods, patches: int) -> NeighbourhoodNoise:
        here = _surfaces(near)
        left, own, radii = (a.reshape(patches, -1) for a in (here.stds, here.own_residuals, here.radii))
        quantile = namespace(left).quantile
        stds = quantile(left, _NOISE_QUANTILE, 1)
        loud_shares = (abs(own) > _OUTLIER_STDS * stds[:, None]).sum(1) / own.shape[1]
        variances = near.variances.clip(min=np.finfo(np.float64).tiny).reshape(patches, -1, 3)
        breadths = quantile(variances[:, :, 1] / variances[:, :, 2], 0.5, 1) ** 0.5
        return cls(*map(on_host, (quantile(left / radii, _NOISE_QUANTILE, 1), stds, loud_shares, breadths)))


def low_noise_weight(ratios: Floats) -> float:
    """Say how little noise a cloud has beside the distances of its points, 0 to 1.

    1: a surface fitted to neighbours reads the noise well. 0: noise hides it. ratios: (M,), as of
    `NeighbourhoodNoise.in_radii`, of some patches, of which half say.
    """
    return float(np.clip((HIGH_NOISE_RATIO - np.median(ratios)) / (HIGH_NOISE_RATIO - _LOW_NOISE_RATIO), 0.0, 1.0))


def wiener_weighted(step: Floats, nearest: Nearest, low_noise: float) -> Floats:
    """Return a step (n, 3), less of it where it is more than the noise.

    low_noise: as of `low_noise_weight`; nearest: 16 or more of each of the n >= 1 points. Of moves m across the
    surface, with noise n, a share of n^2 / m^2 leaves least error (Wiener's weight): what else they have is independent
    of the noise.
    """
    here = _surfaces(nearest.first(FIT_NEIGHBOURS))
    rise = (step * here.normals).sum(axis=1)
    place = _places(nearest)
    noise = np.quantile(here.stds[place], _NOISE_QUANTILE, axis=1)
    moves = np.square(rise)[place].mean(axis=1)
    weight = wiener_share(noise**2, moves)
    own = here.own_residuals
    out = (np.abs(own) > _OUTLIER_STDS * noise) & (-rise * own > _OUTLIER_STEP_SHARE * own**2)
    less: Floats = step * np.where(out, 1.0, 1.0 - low_noise * (1.0 - weight))[:, None]
    return less


def limited_to_surfaces(step: Floats, nearest: Nearest, most: float = np.inf) -> Floats:
    """Return a scene's step (n, 3), less of it where it is more than what surfaces through few neighbours leave.

    nearest: 32 of each of the n >= 1 points; most: the noise std that is believed of any place. Where points are few
    beside what was scanned, edges and kerbs are noise to a patch of 1000. Weights are Wiener's, as of
    `wiener_weighted`.
    """
    near, place = _around(nearest), _places(nearest)
    noise = _noise_of_places(near, place)
    in_radii = np.minimum(noise, _THICKEST_RATIO * most) / near.radii[place].mean(axis=1)
    known = np.clip((_UNSEEN_FROM_RADII - in_radii) / (_UNSEEN_FROM_RADII - _SEEN_UP_TO_RADII), 0.0, 1.0)
    moves = np.square(step).sum(axis=1)[place].mean(axis=1)
    less_of_it: Floats = step * (1.0 - known * (1.0 - wiener_share(np.minimum(noise, most) ** 2, moves)))[:, None]
    return less_of_it


def noise_on_surfaces(nearest: Nearest, patches: int) -> Floats:
    """Return what surfaces through few neighbours leave of a scene's points: (M,), infinite where they tell nothing.

    nearest: 32 or more of some points, as many of each of the M patches, patch after patch.
    """
    near, place = _around(nearest), np.arange(len(nearest.points)).reshape(patches, -1)
    noise = _noise_of_places(near, place)
    noise[noise < EXACT_PLANE_RATIO * near.radii[place].mean(axis=1)] = np.inf
    return noise


def _around(nearest: Nearest, count: int = SCENE_NEIGHBOURS) -> Neighbourhoods:
    """Return 16 of the `count` nearest, which lie in all directions, on the host."""
    distances, points = (on_host(array[:, :count]) for array in (nearest.distances, nearest.points))
    return Nearest(distances, points).in_all_directions(FIT_NEIGHBOURS).first(FIT_NEIGHBOURS)


def _noise_of_places(near: Neighbourhoods, place: npt.NDArray[np.int64]) -> Floats:
    """Return the noise std of places of a scene, (m,): of some rows each, (m, k); infinite where these tell nothing."""
    stds = _surfaces(near).stds
    _, less, most = np.sqrt(np.maximum(near.variances, 0.0)).T
    tells = less > _LINE_RATIO * most
    counts = tells[place].sum(axis=1)
    rising = np.sort(np.where(tells, stds, np.inf)[place], axis=1)
    lowest = (_SCENE_QUANTILE * np.maximum(counts - 1, 0)).astype(np.int64)
    noise: Floats = rising[np.arange(len(place)), lowest] / _SCENE_QUANTILE_STD
    noise[2 * counts <= place.shape[1]] = np.inf
    return noise


def _places(nearest: Nearest) -> npt.NDArray[np.int64]:
    """Return the rows of the points near each of n whose noise is read as one: (n, 80), or all of them."""
    points = nearest.points[:, 0]
    place: npt.NDArray[np.int64]
    _, place = cKDTree(points).query(points, k=np.arange(1, min(_NOISE_NEIGHBOURS, len(points)) + 1))
    return place


def wiener_share(noise_variances: Floats, moves: Floats) -> Floats:
    """Return the share (n,), 1 at most, that is made of moves of a mean square (n,) among noise of a variance (n,)."""
    share: Floats = np.minimum(1.0, noise_variances / np.maximum(moves, np.finfo(np.float64).tiny))
    return share


def _surfaces(near: Neighbourhoods) -> _Surfaces:
    """Fit heights of second order over their planes to neighbourhoods."""
    along = near.along_axes() / near.radii[:, None, None]
    height, terms = along[:, :, 0], surface_terms(along, bent=True)
    xp, products = namespace(terms), terms.mT @ terms
    for term in range(_FIT_TERMS):
        products[:, term, term] += _RIDGE
    solved = xp.linalg.solve(products, xp.stack([xp.einsum("nkp,nk->np", terms, height), terms[:, 0]], -1))
    left = height - xp.einsum("nkp,np->nk", terms, solved[:, :, 0])
    leverage = xp.einsum("np,np->n", terms[:, 0], solved[:, :, 1])
    own_residuals = left[:, 0] / (1 - leverage).clip(min=_LEAST_LEVERAGE_LEFT)
    stds = xp.sqrt(xp.square(left).sum(1) / (height.shape[1] - _FIT_TERMS))
    return _Surfaces(stds * near.radii, own_residuals * near.radii, near.radii, near.normals)
