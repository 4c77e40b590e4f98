"""Which points of a cloud belong to nothing: signs for "no data", and what a scanner saw in the air."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from straightpcf.model.distinct import box_of, half_reach
from straightpcf.model.normalize import CloudFrame, is_scene
from straightpcf.model.patches import PATCH_SIZE

Floats = npt.NDArray[np.float64]

__all__ = ["FAR_OUT", "NEIGHBOURS", "far_out", "isolated", "without_data"]

# A row so many times as far out as half of the rows are is a file's sign for "no data". With it, float64 would hold all
# others in one place.
FAR_OUT = 1e12

NEIGHBOURS = 8  # what lies in a group of more belongs to something
# A scanner's beams without an echo and a camera's pixels without a depth are all written as one place, mostly 0, 0, 0.
# Nothing is within so many times the reach in which the places nearest to it have their 8th neighbour; and it has more
# rows than so many. At 0, 0, 0, which in a map's coordinates may be on a floor, so many times its neighbours' will do.
_SIGN_RATIO, _SIGN_ROWS = 5.0, 8
# How far a point's 8th neighbour is, beside nine tenths of all points and beside the point's own neighbours. Of clouds
# with 3 % of Gaussian noise none is beyond the first pair; the second is for what is near the surface, once the far is
# gone. Laplace noise has a few beyond the first: so few are noise, but for those that make the bounding sphere larger.
_DENSE_QUANTILE = 0.9
_FAR_RATIO, _FAR_NEIGHBOUR_RATIO = 4.5, 5.0
_NEXT_RATIO, _NEXT_NEIGHBOUR_RATIO, _ROUNDS = 2.0, 2.5, 3
_FEW_SHARE, _ALONE_RATIO = 0.001, 20.0  # of the points; where fewer are far, they have to be so far
_MOST_SHARE = 0.1  # of the points; where more seem to belong to nothing, the cloud is of another kind
# What is sparse beside the rest may be a surface all the same: its points are as far apart as their neighbours
# are, and lie in a sheet or a line with them (their least std beside the next; of points in a volume 0.6).
_SHEET_NEIGHBOURS, _SHEET_FLATNESS, _SHEET_SHARE, _SHEET_NEIGHBOUR_RATIO = 16, 0.35, 0.5, 2.0
# Where points in the air are many, nine tenths of all have their 8th neighbour so many times as far as half. Those with
# it twice as far as half, if they are so many, are in the air where their nearest among each other fill a volume, which
# those of a sparse part of a surface do not.
_MANY_SPREAD, _LOOSE_RATIO, _LEAST_MANY, _MOST_MANY = 2.4, 2.0, 0.105, 0.45
_LEAST_COUNT, _VOLUME_NEIGHBOURS, _VOLUME_FLATNESS, _VOLUME_SHARE = 500, 48, 0.5, 0.5
_PROBES = 48
_BLOCK = 2**16  # points whose neighbours are held at once


def far_out(xyz: Floats) -> npt.NDArray[np.bool_]:
    """Say of each finite row (N, 3) whether it is too far from the others to be a point of the cloud: (N,)."""
    none = np.zeros(len(xyz), dtype=bool)
    if len(xyz) == 0:
        return none
    middle, reach = half_reach(xyz)
    ends = np.stack(box_of(xyz)) / 2
    if reach == 0 or np.abs(ends - middle).max() / FAR_OUT <= reach:
        return none
    far: npt.NDArray[np.bool_] = np.abs(xyz / 2 - middle).max(axis=1) / FAR_OUT > reach
    return far


def without_data(places: Floats, shared: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Say of each place (U, 3), all different, whether it is a sign for "no data": (U,).

    shared: (U,) how many rows have it. Asked are 0, 0, 0 and the place that most rows have, if more than 8 do.
    """
    signs = np.zeros(len(places), dtype=bool)
    if len(places) <= NEIGHBOURS + 1:
        return signs
    zero = np.flatnonzero(places[:, 0] == 0)
    zero = zero[~places[zero].any(axis=1)]
    asked, most = set(zero.tolist()), int(shared.argmax())
    if shared[most] > _SIGN_ROWS:
        asked.add(most)
    _, reach = half_reach(places) if asked else (None, 0.0)
    if reach == 0:
        return signs

    def away_from(row: int) -> Floats:
        """Return the squared distance of each place, (U,), in a unit in which none overflows."""
        squares: Floats = sum(np.square((column / 2 - column[row] / 2) / reach) for column in places.T)
        return squares

    for row in asked:
        away = away_from(row)
        away[row] = np.inf
        near = np.argpartition(away, NEIGHBOURS)[:NEIGHBOURS]
        spacing = np.median([np.partition(away_from(other), NEIGHBOURS)[NEIGHBOURS] for other in near])
        alone = away[near].min() > _SIGN_RATIO**2 * spacing
        signs[row] = alone or (row in zero and shared[row] > _SIGN_ROWS * shared[near].max())
    return signs


def isolated(xyz: Floats, *, workers: int = 1, spacings: tuple[Floats, Floats] | None = None) -> npt.NDArray[np.bool_]:
    """Say of each point of an object (N, 3) whether it lies apart from all others: (N,).

    None does in a scene, whose far parts are sparse, and where more than _MOST_SHARE would, unless these fill a volume.
    Where some do, everyone's patches have a few, which read as noise that the whole cloud has. spacings: (N,) each,
    where they are known: how far each point's 8th neighbour is, and the median of what that is of its 8 nearest.
    """
    reach, among = spacings or _spacings(xyz, workers)
    apart, sheet, few = _many_apart(xyz, reach, workers), np.zeros(len(xyz), dtype=bool), False
    most = _MOST_MANY if apart.any() else _MOST_SHARE
    if not apart.any():
        beside_most, beside_neighbours = _beside(reach, among)
        apart = (beside_most > _FAR_RATIO) | (beside_neighbours > _FAR_NEIGHBOUR_RATIO)
        sheet = _on_a_sheet(xyz, apart & (beside_neighbours < _SHEET_NEIGHBOUR_RATIO), workers)
        apart &= ~sheet
        if few := bool(apart.mean() < _FEW_SHARE):
            apart = (beside_most > _ALONE_RATIO) & ~sheet
    if not apart.any():
        return apart
    if apart.mean() > most or _is_scene(xyz[~apart]):
        return np.zeros_like(apart)
    for _ in range(0 if few else _ROUNDS):
        rows = np.flatnonzero(~apart)
        beside_most, beside_neighbours = _beside(*_spacings(xyz[rows], workers))
        found = ((beside_most > _NEXT_RATIO) | (beside_neighbours > _NEXT_NEIGHBOUR_RATIO)) & ~sheet[rows]
        if not found.any() or apart.sum() + found.sum() > most * len(xyz):
            break
        apart[rows[found]] = True
    return apart


def _many_apart(xyz: Floats, reach: Floats, workers: int) -> npt.NDArray[np.bool_]:
    """Say of each point (N, 3) whether it is one of many in the air, (N,); reach: (N,) of its 8th neighbour."""
    apart = np.zeros(len(xyz), dtype=bool)
    middle = np.median(reach)
    if np.quantile(reach, _DENSE_QUANTILE) < _MANY_SPREAD * middle:  # as of nearly every cloud
        return apart
    loose = reach > _LOOSE_RATIO * middle
    if loose.sum() < _LEAST_COUNT or not _LEAST_MANY <= loose.mean() <= _MOST_MANY or _is_scene(xyz[~loose]):
        return apart
    rows = np.flatnonzero(loose)
    around, flatness = _looked_around(xyz[rows], xyz[rows], _VOLUME_NEIGHBOURS, workers)
    found = rows[(flatness > _VOLUME_FLATNESS)[around].mean(axis=1) > _VOLUME_SHARE]
    apart[found] = len(found) >= _LEAST_MANY * len(xyz)
    return apart


def _spacings(xyz: Floats, workers: int) -> tuple[Floats, Floats]:
    """Return how far each point's 8th neighbour is, and the median of what that is of its nearest: (N,) each."""
    count = min(NEIGHBOURS, len(xyz) - 1)
    tree, reach, among = cKDTree(xyz), np.empty(len(xyz)), np.empty(len(xyz))
    around = np.empty((len(xyz), count), dtype=np.int32)
    for start in range(0, len(xyz), _BLOCK):
        some = slice(start, start + _BLOCK)
        distance, index = tree.query(xyz[some], k=np.arange(2, count + 2), workers=workers)
        reach[some], around[some] = distance[:, -1], index
    for start in range(0, len(xyz), _BLOCK):
        some = slice(start, start + _BLOCK)
        rising = np.sort(reach.take(around[some]), axis=1)  # of few, sooner than np.median finds the middle
        among[some] = (rising[:, (count - 1) // 2] + rising[:, count // 2]) / 2
    return reach, among


def _beside(reach: Floats, among: Floats) -> tuple[Floats, Floats]:
    """Return distances (N,) beside those of most points, and beside those of each point's neighbours."""
    return reach / max(np.quantile(reach, _DENSE_QUANTILE), 1e-300), reach / np.maximum(among, 1e-300)


def _on_a_sheet(xyz: Floats, asked: npt.NDArray[np.bool_], workers: int) -> npt.NDArray[np.bool_]:
    """Say of each point of a cloud (N, 3) that is `asked` about, (N,), whether it is part of a sheet or a line: (N,).

    Those nearest to it lie in one, and so do those nearest to most of them: a few points lie flat by chance.
    """
    flat, sheet = np.zeros(len(xyz), dtype=bool), np.zeros(len(xyz), dtype=bool)
    if not asked.any():  # as of nearly every cloud: spare it another tree
        return sheet
    rows = np.flatnonzero(asked)
    around, flatness = _looked_around(xyz, xyz[rows], _SHEET_NEIGHBOURS, workers)
    flat[rows] = flatness < _SHEET_FLATNESS
    sheet[rows] = flat[around].mean(axis=1) > _SHEET_SHARE
    return sheet


def _looked_around(xyz: Floats, places: Floats, count: int, workers: int) -> tuple[npt.NDArray[np.int32], Floats]:
    """Return which of points (N, 3) are nearest to places (M, 3), (M, count), and their least std by the next, (M,)."""
    tree = cKDTree(xyz)
    around = np.empty((len(places), min(count, len(xyz))), dtype=np.int32)
    flatness = np.empty(len(places))
    for start in range(0, len(places), _BLOCK):
        some = slice(start, start + _BLOCK)
        around[some] = tree.query(places[some], k=np.arange(1, around.shape[1] + 1), workers=workers)[1]
        near = xyz[around[some]]
        near -= near.mean(axis=1, keepdims=True)
        least, following, _ = np.linalg.eigvalsh(near.transpose(0, 2, 1) @ near).T
        flatness[some] = np.sqrt(np.maximum(least, 0.0) / np.maximum(following, 1e-300))
    return around, flatness


def _is_scene(xyz: Floats) -> bool:
    size = min(PATCH_SIZE, len(xyz))
    radii = cKDTree(xyz).query(xyz[:: max(1, len(xyz) // _PROBES)], k=[size])[0]
    return is_scene(*(np.quantile(radii, (0.1, 0.5, 0.9)) / max(CloudFrame.of(xyz).radius, 1e-300)).tolist())
