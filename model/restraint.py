"""How much of a step the network asks for is made: what is more than the noise is not.

The points of a scene go no farther than its noise reaches, not off the line that they lie in, and not along a surface,
nor do those of an object that lie on it by chance. Those of a quiet object go less far (`quiet`), and where walls would
be joined none goes (`walls`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.neighbourhoods import neighbourhoods
from straightpcf.model.patches import Patches
from straightpcf.model.quiet import tempered
from straightpcf.model.spacing import Lie
from straightpcf.model.walls import share_between_walls

__all__ = ["across", "held_to_lines", "made_of", "reaches", "restrained"]

# In noise stds: moves up to the first are made whole, from the last on none is (docs/filter.md, "How far ...").
_WHOLE, _NONE = 3.0, 4.0
_SHEET = 1.3  # a patch is one sheet where its points lie so many of its noise stds from their plane, or nearer
_MOST = 3.0  # of the usual noise, what is believed of any sheet
_DOUBTFUL = 1.2  # of the usual noise; of what is no sheet and reads more, less is believed the more it reads

_HELD = 0.5  # of a step; where less is left between walls, that is said

# Of a point's nearest neighbours, the std across their plane beside the lesser one along it: up to the first nothing
# moves along the plane, from the last on all that was asked does. As much as is asked moves along a line, of which the
# stds along the plane are as 1 : 10 or less; from 1 : 5 on it is none.
_AROUND = 24
_FLAT, _ROUND, _LINE = 0.15, 0.3, 0.1
# So many neighbours lie in a line where the greater of their stds across it is a tenth of that along it, and in none
# from a fifth on. A mean and the line's way take three of them.
_IN_LINE, _THIN, _WIDE, _TAKEN = 8, 0.1, 0.2, 3


def made_of(
    step: npt.NDArray[np.float64],
    moved: npt.NDArray[np.float64],
    around: npt.NDArray[np.float64],
    *,
    lie: Lie,
    believed: float | None,
) -> tuple[npt.NDArray[np.float64], bool]:
    """Return what is made of a step (n, 3), and whether it would have joined walls.

    moved: (n, 3), by the passes before; around: (P, 3), the patch, of which the first n points make the step; believed:
    the noise std of a scene's patch (`reaches`).
    """
    if len(step) == 0:
        return step, False
    if believed is not None:
        step = held_to_lines(restrained(moved, step, believed), around)
    share = share_between_walls(step, around) if lie.walls else 1.0
    if share < 1:
        step = share * step
    if lie.scattered:
        step = across(step, around)
    if lie.quiet > 0:
        step = tempered(step, around, lie.quiet)
    return step, share < _HELD


def reaches(
    here: npt.NDArray[np.float64], cut: Patches, noise: npt.NDArray[np.float64], usual: float
) -> npt.NDArray[np.float64]:
    """Return the noise std that is believed of each patch of points (N, 3): (M,), in their unit.

    noise: (M,), read of each patch; usual: of most points. The network takes a pole, a wire or a leaf for noise, and
    reads more of it there. So more than the usual is believed only of a patch whose noise is all that keeps it from
    being flat, as of the far wall in a depth camera's frame, and less than the usual of any other that reads far more.
    """
    thickness = np.array([_thickness(here[rows]) for rows in cut.index])
    doubt = np.minimum(1.0, _DOUBTFUL * usual / np.maximum(noise, 1e-300))
    return np.where(thickness < _SHEET * noise, np.clip(noise, usual, _MOST * usual), usual * doubt)


def restrained(
    moved: npt.NDArray[np.float64], step: npt.NDArray[np.float64], noise_std: float
) -> npt.NDArray[np.float64]:
    """Return a step (n, 3) of points that have moved by (n, 3) before, less of it the less it is believed.

    A redescending weight as of robust estimators, straight from 1 to 0 (Hampel's outer part).
    """
    distance = np.linalg.norm(moved + step, axis=1)
    weight = np.clip((_NONE - distance / max(noise_std, 1e-300)) / (_NONE - _WHOLE), 0.0, 1.0)
    out: npt.NDArray[np.float64] = step * weight[:, None]
    return out


def held_to_lines(step: npt.NDArray[np.float64], around: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a step (n, 3), less of what goes off the line that points lie in, where they do.

    around: (P, 3), a patch, of which the first n >= 1 points make the step. A wire, a railing or the edge of a ledge is
    a line of points near a wall, to which the network draws them. How they scatter about their line is their noise n;
    of moves m off it a share of n^2 / m^2 leaves least error (Wiener's weight).
    """
    points = around[: len(step)]
    near = neighbourhoods(points, around, _IN_LINE)
    least, less, most = np.maximum(near.variances, 0.0).T
    in_line = np.clip((_WIDE - np.sqrt(less / np.maximum(most, 1e-300))) / (_WIDE - _THIN), 0, 1) * (most > 0)
    if not in_line.any():
        return step
    way = near.axes[:, :, 2]
    off = step - (step * way).sum(axis=1, keepdims=True) * way
    noise = (least + less) / max(1, near.local.shape[1] - _TAKEN)
    _, beside = cKDTree(points).query(points, k=np.arange(1, min(_IN_LINE, len(points)) + 1))
    moves = np.square(off).sum(axis=1)[beside].mean(axis=1)
    kept = in_line * (1 - np.minimum(1.0, noise / np.maximum(moves, 1e-300)))
    out: npt.NDArray[np.float64] = step - off * kept[:, None]
    return out


def across(step: npt.NDArray[np.float64], around: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a step (n, 3) without what goes along the surface, where there is one.

    around: (P, 3), a patch, of which the first n points make the step. Points that lie evenly are spread so again
    (`spread`); others lie as beams or chance have it (`Lie`): to draw them together widens gaps and tears scan
    lines, and to spread them takes them away from where they were.
    """
    near = neighbourhoods(around[: len(step)], around, _AROUND)
    least, less, most = np.sqrt(np.maximum(near.variances, 1e-300)).T
    plane = np.clip((_ROUND - least / less) / (_ROUND - _FLAT), 0, 1) * np.clip(less / most / _LINE - 1, 0, 1)
    along = step - (step * near.normals).sum(axis=1, keepdims=True) * near.normals
    out: npt.NDArray[np.float64] = step - along * plane[:, None]
    return out


def _thickness(points: npt.NDArray[np.float64]) -> float:
    """Return the rms distance of points (n, 3) from the plane that fits them best."""
    local = points - points.mean(axis=0)
    return float(np.sqrt(max(np.linalg.eigvalsh(local.T @ local)[0], 0.0) / len(points)))
