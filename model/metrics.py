"""How far a cloud is from the truth: the two published measures, exact, on numpy and scipy.

Both are squared distances after scaling to the unit sphere, returned as they are (papers print them x 1e4).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

__all__ = ["chamfer_distance", "point_to_mesh_distance", "unit_sphere"]

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

PAIRS_AT_ONCE = 1 << 18  # point-triangle pairs tested in one numpy call: some 100 MB of temporaries
FIRST_NEIGHBOURS = 8
SLIVER = 1e-10  # a triangle this much thinner than long has no normal in float64


def chamfer_distance(denoised: Array, clean: Array) -> float:
    """Return the mean squared nearest-neighbour distance, both directions summed, in the clean cloud's unit sphere.

    denoised: (N, 3), clean: (M, 3), the same unit; M may differ from N.
    """
    denoised, clean = _points(denoised, "denoised"), _points(clean, "clean")
    centre, radius = unit_sphere(clean)
    denoised, clean = (denoised - centre) / radius, (clean - centre) / radius
    to_clean, _ = cKDTree(clean).query(denoised)
    to_denoised, _ = cKDTree(denoised).query(clean)
    return float(np.mean(to_clean**2) + np.mean(to_denoised**2))


def point_to_mesh_distance(denoised: Array, vertices: Array, faces: Array) -> float:
    """Return the mean squared point-to-surface distance plus the mean squared triangle-to-nearest-point distance.

    denoised: (N, 3); vertices: (V, 3), the same unit, which set centre and radius; faces: (F, 3) integers.
    Both terms are exact point-triangle distances: pytorch3d's point_face_distance + face_point_distance.
    """
    denoised, vertices = _points(denoised, "denoised"), _points(vertices, "vertices")
    faces = _faces(faces, len(vertices))
    centre, radius = unit_sphere(vertices)
    points, triangles = (denoised - centre) / radius, ((vertices - centre) / radius)[faces]
    centroids = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - centroids[:, None], axis=2).max(axis=1)
    to_surface = _points_to_triangles(points, triangles, centroids, reach)
    to_points = _triangles_to_points(points, triangles, centroids, reach)
    return float(np.mean(to_surface) + np.mean(to_points))


def unit_sphere(xyz: Array) -> tuple[Floats, float]:
    """Return the bounding box's centre, (3,), and the largest distance from it; xyz: (N, 3).

    Raises ValueError where all points are equal, or so far apart that float64 holds no distance.
    """
    xyz = np.asarray(xyz, dtype=np.float64)
    centre = xyz.min(axis=0) / 2 + xyz.max(axis=0) / 2
    offset = xyz - centre
    _, power = np.frexp(np.abs(offset).max())  # squares of what is tiny or huge are 0 or infinite
    with np.errstate(over="ignore"):
        radius = float(np.ldexp(np.linalg.norm(np.ldexp(offset, -power), axis=1).max(), power))
    if radius == 0:
        raise ValueError("all points are equal: there is no unit sphere to measure in")
    if radius == np.inf:
        raise ValueError(f"the points are {np.abs(offset).max():g} from their centre: float64 holds no distance so far")
    return centre, radius


def _points_to_triangles(points: Floats, triangles: Floats, centroids: Floats, reach: Floats) -> Floats:
    """Return each point's squared distance to the surface, (N,)."""
    best = np.full(len(points), np.inf)
    # Triangles of one order of size share a tree, so that one long sliver does not widen every search.
    size = np.round(np.log2(np.maximum(reach, reach.max() * 1e-6)))
    for members in (np.flatnonzero(size == level) for level in np.unique(size)):

        def squared(point: Indices, item: Indices, members: Indices = members) -> Floats:
            return _squared_distance(points[point], triangles[members[item]])

        slack = np.full(len(points), reach[members].max())
        _search(points, slack, cKDTree(centroids[members]), squared, best)
    return best


def _triangles_to_points(points: Floats, triangles: Floats, centroids: Floats, reach: Floats) -> Floats:
    """Return each triangle's squared distance to its nearest point, (F,)."""
    best = np.full(len(triangles), np.inf)

    def squared(triangle: Indices, item: Indices) -> Floats:
        return _squared_distance(points[item], triangles[triangle])

    _search(centroids, reach, cKDTree(points), squared, best)
    return best


def _search(
    centres: Floats, slack: Floats, tree: cKDTree, squared: Callable[[Indices, Indices], Floats], best: Floats
) -> None:
    """Lower `best`, the squared distance of each centre's own body to the nearest item, in place until it is exact.

    An item at distance d of a centre is at least d - slack from what it stands for, so a centre is finished as
    soon as its k-th nearest item is farther than best + slack; the rest go on with four times the k.
    """
    active = np.arange(len(centres))
    neighbours = 0
    while len(active):
        seen, neighbours = neighbours, min(max(FIRST_NEIGHBOURS, 4 * neighbours), tree.n)
        unfinished = []
        step = max(1, PAIRS_AT_ONCE // neighbours)
        for rows in (active[start : start + step] for start in range(0, len(active), step)):
            distance, item = tree.query(centres[rows], k=np.arange(seen + 1, neighbours + 1))
            bound = np.sqrt(best[rows]) + slack[rows]
            row, column = np.nonzero(distance <= bound[:, None])
            np.minimum.at(best, rows[row], squared(rows[row], item[row, column]))
            unfinished.append(rows[distance[:, -1] <= np.sqrt(best[rows]) + slack[rows]])
        active = np.concatenate(unfinished) if neighbours < tree.n else active[:0]


def _squared_distance(point: Floats, triangle: Floats) -> Floats:
    """Return the squared distance of pairs: point (M, 3), triangle (M, 3 corners, 3) -> (M,).

    The foot on the plane where it lies inside, else the nearest of the three edges; a triangle without area has
    no inside and is its edges.
    """
    corner = np.ascontiguousarray(triangle.transpose(1, 2, 0))  # (3 corners, 3, M): long contiguous rows
    target = np.ascontiguousarray(point.T)  # (3, M)
    edge = corner[[1, 2, 0]] - corner
    offset = target - corner
    along = _dot(offset, edge) / np.maximum(_dot(edge, edge), np.finfo(np.float64).tiny)
    miss = offset - np.clip(along, 0, 1)[:, None] * edge
    on_edge = _dot(miss, miss).min(axis=0)

    normal = _cross(edge[0], edge[1])
    area = _dot(normal, normal)  # of the parallelogram, squared
    flat = area <= SLIVER**2 * _dot(edge, edge).max(axis=0) ** 2
    inside = ~flat & np.all([_dot(_cross(edge[i], offset[i]), normal) >= 0 for i in range(3)], axis=0)
    height = _dot(offset[0], normal)
    return np.where(inside, height**2 / np.where(flat, 1, area), on_edge)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.sum(a * b, axis=-2))


def _cross(a: Floats, b: Floats) -> Floats:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _points(xyz: Array, name: str) -> Floats:
    xyz = np.asarray(xyz, dtype=np.float64)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or len(xyz) == 0:
        raise ValueError(f"{name} must be (N, 3) with N >= 1, got {xyz.shape}")
    if not np.isfinite(xyz).all():
        raise ValueError(f"{name} holds {int((~np.isfinite(xyz).all(axis=1)).sum())} points that are not finite")
    return xyz


def _faces(faces: Array, vertices: int) -> Indices:
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or faces.dtype.kind not in "iu":
        raise ValueError(f"faces must be (F, 3) integers with F >= 1, got {faces.shape} {faces.dtype}")
    if faces.min() < 0 or faces.max() >= vertices:
        raise ValueError(f"faces name vertices {faces.min()}..{faces.max()}, the mesh has 0..{vertices - 1}")
    return faces.astype(np.int64)
