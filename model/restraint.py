"""How much of a step the network asks for is made: what is more than the noise is not.

The points of a scene go no farther than its noise reaches, as patches and as a few neighbours read it, nowhere where
they lie in no surface, not off the line that they lie in, and not along a surface, nor do those of an object that lie
on it by chance. Those of an object with little noise go less far (`low_noise`), and where walls would be joined none
goes (`walls`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.low_noise import (
    FIT_NEIGHBOURS,
    LINES_NEIGHBOURS,
    SCENE_NEIGHBOURS,
    limited_to_surfaces,
    wiener_share,
    wiener_weighted,
)
from straightpcf.model.neighbourhoods import Nearest, Neighbourhoods
from straightpcf.model.spacing import Sampling
from straightpcf.model.views import View, along_beams
from straightpcf.model.walls import share_between_walls

__all__ = [
    "along_heights",
    "held_to_lines",
    "held_where_scattered",
    "limited_to_noise",
    "restrained_step",
    "trusted_noise_stds",
    "without_tangential_motion",
]

# In noise stds: moves up to the first are made whole, from the last on none is (docs/filter.md, "How far ...").
_FULL_STEP_STDS, _NO_STEP_STDS = 3.0, 4.0
_MOST_TRUSTED_RATIO = 3.0  # of the noise of most points, what is believed of any flat patch
_DOUBTED_RATIO = 1.2  # of the same; of what is not flat and reads more, less is believed the more it reads

_HELD_BACK_SHARE = 0.5  # of a step; where less is left between walls, that is said

# Of a point's nearest neighbours, the std across their plane beside the lesser one along it: up to the first nothing
# moves along the plane, from the last on all that was asked does. As much as is asked moves along a line, of which the
# stds along the plane are as 1 : 10 or less; from 1 : 5 on it is none.
_PLANE_NEIGHBOURS = 24
_PLANE_RATIO, _VOLUME_RATIO, _LINE_RATIO = 0.15, 0.3, 0.1
_STEEP = 0.5  # of a raster: where the normal has less along the heights, these are not read off the step across
_FEW_NEIGHBOURS = 8
# So many lie in a line where the greater of their stds across it is a tenth of that along it, and in none from a fifth
# on. A mean and the line's direction take three of them (degrees of freedom).
_IN_LINE_RATIO, _OFF_LINE_RATIO, _LINE_FREEDOM = 0.1, 0.2, 3
# Their std across their plane, in those of the noise: up to the first they may be of a surface (of a plane's points it
# is 0.8), from the last on they are of none.
_SURFACE_STDS, _SCATTERED_STDS = 2.0, 3.0


def restrained_step(
    step: npt.NDArray[np.float64],
    moved: npt.NDArray[np.float64],
    patch: npt.NDArray[np.float64],
    *,
    sampling: Sampling,
    trusted_noise: float | None,
    most_on_surfaces: float = np.inf,
    height_axis: int | None = None,
    view: View | None = None,
    noise_std: float = np.inf,
) -> tuple[npt.NDArray[np.float64], bool]:
    """Return what is made of a step (n, 3), and whether it would have joined walls.

    moved: (n, 3), by the passes before; patch: (P, 3) points, of which the first n make the step; sampling: of the
    cloud; trusted_noise: the noise std that is believed of a scene's patch (`trusted_noise_stds`), or of a place of few
    points (`Sampling.noise_of_place`), None of an object's; most_on_surfaces: as of a scene's Reading;
    height_axis: that of a raster's heights, which alone move; view: whose beams points move along alone.
    """
    if len(step) == 0:
        return step, False
    scene, irregular, low_noise = trusted_noise is not None, sampling.irregular, sampling.low_noise
    if not (scene or irregular or low_noise > 0):
        return _between_walls(step, patch, sampling)
    count = LINES_NEIGHBOURS if sampling.in_lines else SCENE_NEIGHBOURS if scene else _PLANE_NEIGHBOURS
    nearest = Nearest.of(patch[: len(step)], patch, count)
    if sampling.in_lines:  # of its own line a point's nearest say nothing
        nearest = nearest.in_all_directions(FIT_NEIGHBOURS)
    if trusted_noise is not None:
        near = nearest.first(_FEW_NEIGHBOURS)
        step = held_to_lines(limited_to_noise(moved, step, trusted_noise), patch, near)
        step = held_where_scattered(step, near, trusted_noise)
    step, held_back = _between_walls(step, patch, sampling)
    if irregular:
        step = without_tangential_motion(step, nearest)
    if low_noise > 0:
        step = wiener_weighted(step, nearest, low_noise)
    if height_axis is not None:
        step = along_heights(step, nearest, height_axis)
    elif scene:
        step = limited_to_surfaces(step, nearest, most_on_surfaces)
    if view is not None:
        step = along_beams(step, patch, view, noise_std if trusted_noise is None else trusted_noise)
    return step, held_back


def _between_walls(
    step: npt.NDArray[np.float64], patch: npt.NDArray[np.float64], sampling: Sampling
) -> tuple[npt.NDArray[np.float64], bool]:
    if not sampling.thin_walls:
        return step, False
    share = share_between_walls(step, patch, uncovered=sampling.uncovered, by_chance=sampling.irregular)
    return (share * step if share < 1 else step), share < _HELD_BACK_SHARE


def trusted_noise_stds(
    noise: npt.NDArray[np.float64], flat: npt.NDArray[np.bool_], noise_of_most: float
) -> npt.NDArray[np.float64]:
    """Return the noise std that is believed of each patch: (M,), in the unit of noise.

    noise: (M,), read of each patch; flat: (M,), whether it is all that keeps the patch from being flat; noise_of_most:
    of most points. The network takes a pole, a wire or a leaf for noise, and reads more of it there. So more than most
    have is believed only of a patch that is flat, as of the far wall in a depth camera's frame, and less than that of
    any other that reads far more.
    """
    doubt = np.minimum(1.0, _DOUBTED_RATIO * noise_of_most / np.maximum(noise, 1e-300))
    of_flat = np.clip(noise, noise_of_most, _MOST_TRUSTED_RATIO * noise_of_most)
    return np.where(flat, of_flat, noise_of_most * doubt)


def limited_to_noise(
    moved: npt.NDArray[np.float64], step: npt.NDArray[np.float64], noise_std: float
) -> npt.NDArray[np.float64]:
    """Return a step (n, 3) of points that have moved by (n, 3) before, less of it the less it is believed.

    A redescending weight as of robust estimators, straight from 1 to 0 (Hampel's outer part).
    """
    distance = np.linalg.norm(moved + step, axis=1)
    weight = np.clip((_NO_STEP_STDS - distance / max(noise_std, 1e-300)) / (_NO_STEP_STDS - _FULL_STEP_STDS), 0.0, 1.0)
    out: npt.NDArray[np.float64] = step * weight[:, None]
    return out


def held_to_lines(
    step: npt.NDArray[np.float64], patch: npt.NDArray[np.float64], near: Neighbourhoods
) -> npt.NDArray[np.float64]:
    """Return a step (n, 3), less of what goes off the line that points lie in, where they do.

    patch: (P, 3) points, of which the first n >= 1 make the step; near: theirs, of a few points. A wire, a railing or
    the edge of a ledge is a line of points near a wall, to which the network draws them. How they scatter about their
    line is their noise n; of moves m off it a share of n^2 / m^2 leaves least error (Wiener's weight).
    """
    least, less, most = np.maximum(near.variances, 0.0).T
    ratio = np.sqrt(less / np.maximum(most, 1e-300))
    in_line = np.clip((_OFF_LINE_RATIO - ratio) / (_OFF_LINE_RATIO - _IN_LINE_RATIO), 0, 1) * (most > 0)
    if not in_line.any():
        return step
    direction = near.axes[:, :, 2]
    off = step - (step * direction).sum(axis=1, keepdims=True) * direction
    noise = (least + less) / max(1, near.local.shape[1] - _LINE_FREEDOM)
    points = patch[: len(step)]
    _, beside = cKDTree(points).query(points, k=np.arange(1, min(_FEW_NEIGHBOURS, len(points)) + 1))
    moves = np.square(off).sum(axis=1)[beside].mean(axis=1)
    kept = in_line * (1 - wiener_share(noise, moves))
    out: npt.NDArray[np.float64] = step - off * kept[:, None]
    return out


def held_where_scattered(
    step: npt.NDArray[np.float64], near: Neighbourhoods, noise_std: float
) -> npt.NDArray[np.float64]:
    """Return a step (n, 3), less of it the farther points scatter from a plane than noise lets a surface's.

    near: those of the n points, of a few. Leaves, a pole or a railing that is seen from above, what is met once behind
    an edge: there is no surface to go to, and the network goes to the nearest that there is.
    """
    thickness = np.sqrt(np.maximum(near.variances[:, 0], 0.0) / near.local.shape[1]) / max(noise_std, 1e-300)
    share = np.clip((_SCATTERED_STDS - thickness) / (_SCATTERED_STDS - _SURFACE_STDS), 0.0, 1.0)
    out: npt.NDArray[np.float64] = step * share[:, None]
    return out


def along_heights(step: npt.NDArray[np.float64], nearest: Nearest, axis: int) -> npt.NDArray[np.float64]:
    """Return steps (n, 3) along an axis alone, to where those that are asked for would take the surface.

    nearest: those of the n points, of a raster; axis: that of its heights. Where the surface is steep, what the step
    has along the axis.
    """
    near = nearest.first(_PLANE_NEIGHBOURS)
    upright = near.normals[:, axis]
    steep = np.abs(upright) < _STEEP
    height = np.where(steep, step[:, axis], (step * near.normals).sum(axis=1) / np.where(steep, 1.0, upright))
    out = np.zeros_like(step)
    out[:, axis] = height
    return out


def without_tangential_motion(step: npt.NDArray[np.float64], nearest: Nearest) -> npt.NDArray[np.float64]:
    """Return a step (n, 3) without what goes along the surface, where there is one.

    nearest: those of the n points. Points that lie evenly are spread so again (`spread`); others lie as beams or chance
    have it (`Sampling.irregular`): to draw them together widens gaps and tears scan lines, and to spread them takes
    them away from where they were.
    """
    near = nearest.first(_PLANE_NEIGHBOURS)
    least, less, most = np.sqrt(np.maximum(near.variances, 1e-300)).T
    plane = np.clip((_VOLUME_RATIO - least / less) / (_VOLUME_RATIO - _PLANE_RATIO), 0, 1)
    plane *= np.clip(less / most / _LINE_RATIO - 1, 0, 1)
    along = step - (step * near.normals).sum(axis=1, keepdims=True) * near.normals
    out: npt.NDArray[np.float64] = step - along * plane[:, None]
    return out
