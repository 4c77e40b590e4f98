"""The metrics are exact, have the published normalisation and refuse what they cannot measure."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.model.metrics import chamfer_distance, point_to_mesh_distance, unit_sphere

Floats = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]


def torus(major: int = 24, minor: int = 12) -> tuple[Floats, Faces]:
    """Return a closed triangulated torus: vertices (V, 3), faces (F, 3)."""
    u, v = np.meshgrid(np.arange(major), np.arange(minor), indexing="ij")
    a, b = 2 * np.pi * u.ravel() / major, 2 * np.pi * v.ravel() / minor
    ring = 1 + 0.4 * np.cos(b)
    vertices = np.stack([ring * np.cos(a), ring * np.sin(a), 0.4 * np.sin(b)], axis=1)
    right, up = ((u + 1) % major).ravel(), ((v + 1) % minor).ravel()
    here, east = u.ravel() * minor + v.ravel(), right * minor + v.ravel()
    north, both = u.ravel() * minor + up, right * minor + up
    return vertices, np.concatenate([np.stack([here, east, both], 1), np.stack([here, both, north], 1)])


def ericson(p: Floats, a: Floats, b: Floats, c: Floats) -> Floats:
    """Return the closest point of one triangle: Ericson, Real-Time Collision Detection, 5.1.5."""
    ab, ac, ap, bp, cp = b - a, c - a, p - a, p - b, p - c
    d1, d2, d3, d4, d5, d6 = ab @ ap, ac @ ap, ab @ bp, ac @ bp, ab @ cp, ac @ cp
    if d1 <= 0 and d2 <= 0:
        return a
    if d3 >= 0 and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= 0 <= d1 and d3 <= 0:
        return np.asarray(a + d1 / (d1 - d3) * ab)
    if d6 >= 0 and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= 0 <= d2 and d6 <= 0:
        return np.asarray(a + d2 / (d2 - d6) * ac)
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 >= d3 and d5 >= d6:
        return np.asarray(b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b))
    return np.asarray(a + (ab * vb + ac * vc) / (va + vb + vc))


def brute_force(points: Floats, vertices: Floats, faces: Faces) -> float:
    centre, radius = unit_sphere(vertices)
    points, vertices = (points - centre) / radius, (vertices - centre) / radius
    squared = np.array([[((p - ericson(p, *vertices[f])) ** 2).sum() for f in faces] for p in points])
    return float(squared.min(axis=1).mean() + squared.min(axis=0).mean())


def test_point_to_mesh_distance_equals_brute_force() -> None:
    rng = np.random.default_rng(0)
    vertices, faces = torus(10, 6)
    points = vertices[rng.integers(len(vertices), size=150)] + rng.normal(scale=0.1, size=(150, 3))
    assert point_to_mesh_distance(points, vertices, faces) == pytest.approx(
        brute_force(points, vertices, faces), rel=1e-9
    )


def test_triangles_of_very_different_size_are_still_exact() -> None:
    rng = np.random.default_rng(1)
    vertices = np.concatenate([rng.normal(size=(40, 3)), rng.normal(scale=0.01, size=(40, 3)) + 0.3])
    faces = np.concatenate([rng.integers(0, 40, size=(12, 3)), rng.integers(40, 80, size=(60, 3))])
    points = rng.normal(scale=0.7, size=(120, 3))
    faces = faces[[len(set(face)) == 3 for face in faces.tolist()]]
    assert point_to_mesh_distance(points, vertices, faces) == pytest.approx(
        brute_force(points, vertices, faces), rel=1e-9
    )


def test_a_triangle_without_area_counts_as_its_edges() -> None:
    vertices = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 0, 0], [0.5, 0, 0]])
    points = np.array([[0.25, 0.5, 0], [2.0, 0, 0]])
    faces = np.array([[0, 1, 2], [3, 3, 3]])
    expected = (0.5**2 + 1.0**2) / 2 + (0.5**2 + (0.25**2 + 0.5**2)) / 2
    assert point_to_mesh_distance(points, vertices, faces) == pytest.approx(expected)


def test_a_cloud_on_the_surface_is_at_no_distance_from_it() -> None:
    vertices, faces = torus()
    squared_to_surface = point_to_mesh_distance(vertices[faces].mean(axis=1), vertices, faces)
    assert squared_to_surface == pytest.approx(0, abs=1e-20)


def test_chamfer_distance_is_the_hand_computed_one() -> None:
    clean = np.array([[-2.0, 0, 0], [2, 0, 0]])  # centre 0, radius 2
    denoised = np.array([[-2.0, 1, 0], [2, 0, 0], [2, 0, 0]])
    assert chamfer_distance(denoised, clean) == pytest.approx(0.25 / 3 + 0.25 / 2)


def test_a_cloud_is_at_no_distance_from_itself_in_any_order() -> None:
    points = np.random.default_rng(2).normal(size=(500, 3))
    assert chamfer_distance(points[::-1], points) == 0


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_metrics_do_not_depend_on_unit_or_place(scale: float) -> None:
    rng = np.random.default_rng(3)
    vertices, faces = torus()
    points = vertices + rng.normal(scale=0.02, size=vertices.shape)
    shift = np.array([3.0, -7.0, 11.0])
    assert chamfer_distance(points * scale + shift, vertices * scale + shift) == pytest.approx(
        chamfer_distance(points, vertices), rel=1e-6
    )
    assert point_to_mesh_distance(points * scale + shift, vertices * scale + shift, faces) == pytest.approx(
        point_to_mesh_distance(points, vertices, faces), rel=1e-6
    )


def test_point_to_mesh_distance_agrees_with_open3d() -> None:
    o3d = pytest.importorskip("open3d", reason="open3d is an optional extra", exc_type=ImportError)
    rng = np.random.default_rng(4)
    vertices, faces = torus()
    points = vertices + rng.normal(scale=0.05, size=vertices.shape)
    centre, radius = unit_sphere(vertices)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(((vertices - centre) / radius).astype(np.float32), faces.astype(np.uint32))
    distance = scene.compute_distance(((points - centre) / radius).astype(np.float32)).numpy()
    dense = np.concatenate([points, *(vertices[faces] @ w for w in ([0.2, 0.3, 0.5], [0.6, 0.2, 0.2]))])
    many = np.concatenate([distance**2, np.zeros(2 * len(faces))])
    assert point_to_mesh_distance(dense, vertices, faces) == pytest.approx(many.mean(), rel=1e-3, abs=1e-9)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "N >= 1"),
        (np.zeros((4, 2)), r"\(4, 2\)"),
        (np.array([[0.0, np.nan, 0.0]]), "1 points that are not finite"),
    ],
)
def test_unusable_clouds_are_refused(points: Floats, message: str) -> None:
    vertices, faces = torus()
    with pytest.raises(ValueError, match=message):
        point_to_mesh_distance(points, vertices, faces)
    with pytest.raises(ValueError, match=message):
        chamfer_distance(points, vertices)


def test_a_face_that_names_no_vertex_is_refused() -> None:
    with pytest.raises(ValueError, match=r"0\.\.3, the mesh has 0\.\.2"):
        point_to_mesh_distance(np.zeros((1, 3)), np.eye(3), np.array([[0, 1, 3]]))


def test_equal_points_have_no_unit_sphere() -> None:
    with pytest.raises(ValueError, match="all points are equal"):
        chamfer_distance(np.zeros((2, 3)), np.ones((5, 3)))


@pytest.mark.parametrize("scale", [2.0**-1030, 2.0**-664, 2.0**531, 2.0**1020])
def test_a_cloud_of_any_size_is_measured_in_its_unit_sphere(scale: float) -> None:
    rng = np.random.default_rng(0)
    clean = rng.integers(-(2**20), 2**20, (50, 3)) / 2**20  # so that nothing is rounded where it is subnormal
    denoised = clean + rng.integers(-(2**10), 2**10, clean.shape) / 2**20
    faces = np.arange(48).reshape(16, 3)
    wanted = chamfer_distance(denoised, clean), point_to_mesh_distance(denoised, clean, faces)
    scaled = denoised * scale, clean * scale
    assert (chamfer_distance(*scaled), point_to_mesh_distance(*scaled, faces)) == pytest.approx(wanted, rel=1e-9)


def test_points_so_far_apart_that_float64_holds_no_distance_are_refused() -> None:
    with pytest.raises(ValueError, match="float64 holds no distance"):
        chamfer_distance(np.zeros((2, 3)), np.array([[1.7e308] * 3, [-1.7e308] * 3]))
