"""Depths in steps: a depth camera tells only so many apart, and its points lie in layers, the farther the wider."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.arrays import on_host
from straightpcf.model.grid import repeats
from straightpcf.model.neighbourhoods import INNER_SHARE, Nearest
from straightpcf.model.patches import Patches
from straightpcf.model.processor import Floats
from straightpcf.model.survey import Survey, survey

__all__ = ["Layers"]

_POINTS_A_LAYER = 50  # at least, as a mean: coordinates that are merely rounded to few digits have as many, too
# A point is within a layer where so many of its nearest others share its coordinate and fill a plane, and so do those
# of more: points of a profile or of a contour lie in a line, which noise in its plane hides from the nearest. A depth
# camera's frames have 0.05 to 0.5 of their points there along its axis, and none along the others, as faces of a box.
_NEAREST, _SHARING, _WIDE_RATIO, _WIDE_RATIO_OF_MORE = 12, 10, 0.3, 0.2
_LAYERED_SHARE, _OTHER_AXES = 0.03, 1 / 3
_FEWEST_LAYERS = 4  # that have such points
# How far apart layers are beside the points in them: floors without noise are much nearer to the next coordinate that
# there is, the steps of stairs much farther from it. To the network those from the middle one on are surfaces.
_LEAST_WIDTH, _WIDE, _MOST_WIDTH = 0.5, 1.25, 10.0
# Of a point's nearest as seen along the axis, so many may share its layer. Without noise, layers that are wide beside a
# patch stay steps, whatever is done, and that of a wall that is seen from the front is the wall.
_BESIDE, _MIXED_SHARE = 8, 0.85
_BESIDE_OTHERS = 1.5  # of the steps of the other axes: where coordinates are rounded, all have the same
_AROUND = 3  # layers on both sides, by which a gap is smoothed: behind an object there is no next one


@dataclass(frozen=True)
class Layers:
    """The layers that points (N, 3) lie in: along which axis, and how wide that of each is, (N,).

    wide: whether they are so far apart that the network takes each for a surface of its own.
    """

    axis: int
    widths: Floats
    wide: bool

    @classmethod
    def of(
        cls, xyz: Floats, patches: Patches, *, raster: bool, in_lines: bool, survey: Survey = survey
    ) -> Layers | None:
        """Look for layers in some patches of points (N, 3); None where there are none.

        raster: whether the points are one, whose other coordinates have steps of their own; in_lines: whether they are
        of a scanner's lines (`Sampling`), which share a coordinate, too.
        """
        axes = [axis for axis in range(3) if repeats(xyz[:, axis], _POINTS_A_LAYER)]
        if in_lines or not axes:
            return None
        layered, spacings, where = map(np.concatenate, zip(*survey(xyz, patches, _layered), strict=True))
        shares = layered.mean(axis=0)
        axis = int(np.argmax(shares))
        others = np.delete(shares, axis)
        if axis not in axes or shares[axis] < _LAYERED_SHARE or others.max() > _OTHER_AXES * shares[axis]:
            return None
        lines, layer = np.unique(xyz[:, axis], return_inverse=True)
        if len(lines) < _FEWEST_LAYERS:
            return None
        widths, seen = _widths(lines), layered[:, axis]
        at = np.searchsorted(lines, where[seen, axis])
        in_spacings = float(np.median(widths[at] / spacings[seen]))
        if len(np.unique(at)) < _FEWEST_LAYERS or not _LEAST_WIDTH <= in_spacings <= _MOST_WIDTH:
            return None
        rounded = [float(np.median(np.diff(np.unique(xyz[:, other])))) for other in axes if other != axis]
        if not raster and any(_BESIDE_OTHERS * step > np.median(widths[at]) for step in rounded):
            return None
        of_patches = seen.reshape(len(patches.index), -1).any(axis=1)
        beside = [_share_beside(xyz[rows], axis) for rows in patches.index[of_patches]]
        if not raster and np.median(beside) > _MIXED_SHARE:
            return None
        return cls(axis, widths[layer], in_spacings >= _WIDE)

    def anywhere_within(self, seed: int) -> Floats:
        """Return how far points go from the middle of their layers to anywhere in them: (N, 3).

        The layer says no more of where a point was; so spread, the points are a surface with noise.
        """
        out = np.zeros((len(self.widths), 3))
        out[:, self.axis] = np.random.default_rng(seed).uniform(-0.5, 0.5, len(self.widths)) * self.widths
        return out


def _layered(near: Nearest, _patches: int) -> tuple[npt.NDArray[np.bool_], Floats, Floats]:
    """Say of points whether they are within a layer along each axis, (n, 3); how far the nearest is, (n,); where."""
    points, distances = on_host(near.points), on_host(near.distances[:, 1])
    layered = np.stack([_fill_plane(points, axis) for axis in range(3)], axis=1)
    return layered, np.maximum(distances, 1e-12), points[:, 0]


def _fill_plane(points: Floats, axis: int) -> npt.NDArray[np.bool_]:
    """Say of points (n, k, 3) whether those that share the first one's coordinate are enough, and in no line: (n,)."""
    sharing = points[:, :, axis] == points[:, :1, axis]
    across = np.delete(points, axis, axis=2)
    few = np.s_[:, : _NEAREST + 1]
    enough = sharing[few].sum(axis=1) > _SHARING
    wide = _are_wide(across[few], sharing[few], _WIDE_RATIO) & _are_wide(across, sharing, _WIDE_RATIO_OF_MORE)
    return np.asarray(enough & wide)


def _are_wide(across: Floats, these: npt.NDArray[np.bool_], ratio: float) -> npt.NDArray[np.bool_]:
    """Say of some of points (n, k, 2) in a plane, one or more of each row, whether they lie in no line: (n,).

    ratio: of the lesser of their stds to the greater, which those of a line do not reach.
    """
    count = these.sum(axis=1)[:, None]
    mean = (across * these[:, :, None]).sum(axis=1) / count
    local = (across - mean[:, None]) * these[:, :, None]
    less, most = np.maximum(np.linalg.eigvalsh(local.swapaxes(1, 2) @ local), 0.0).T
    return np.asarray(less > ratio**2 * most)


def _share_beside(points: Floats, axis: int) -> float:
    """Return how many of the nearest of points (P, 3), as seen along an axis, share their layer: of all looked at."""
    across = np.delete(points, axis, axis=1)
    middle = np.argsort(np.square(across - across.mean(axis=0)).sum(axis=1))[: round(INNER_SHARE * len(points))]
    _, beside = cKDTree(across).query(across[middle], k=np.arange(2, min(_BESIDE + 2, len(points) + 1)))
    return float((points[beside, axis] == points[middle, axis, None]).mean())


def _widths(lines: Floats) -> Floats:
    """Return how wide the layers at some rising coordinates (L,) are: the gap to the nearer one, smoothed."""
    gaps = np.diff(lines)
    nearer = np.minimum(np.append(gaps, gaps[-1]), np.insert(gaps, 0, gaps[0]))
    around = np.pad(nearer, _AROUND, mode="reflect" if len(nearer) > _AROUND else "edge")
    widths: Floats = np.median(np.lib.stride_tricks.sliding_window_view(around, 2 * _AROUND + 1), axis=1)
    return widths
