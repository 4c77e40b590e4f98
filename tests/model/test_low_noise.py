"""Where noise is little beside the distances of points, steps are no larger than it, but for points with more of it."""

from __future__ import annotations

import numpy as np
import pytest

from straightpcf.model.filter import load_filter
from straightpcf.model.low_noise import limited_to_surfaces, noise_on_surfaces, wiener_weighted
from straightpcf.model.metrics import chamfer_distance
from straightpcf.model.neighbourhoods import Nearest
from straightpcf.model.patches import cut_patches
from straightpcf.model.spacing import Sampling
from tests.clouds import even_sphere, noisy, sphere, torus
from tests.model.neighbours import nearest


def quiet(xyz: np.ndarray) -> float:
    return Sampling.of(xyz, cut_patches(xyz, coverage=3.0, seed=0), 0.0).low_noise


@pytest.mark.parametrize("cloud", [sphere, even_sphere])
@pytest.mark.parametrize("count", [1000, 6000])
def test_noise_is_little_or_much_beside_the_distance_of_points(cloud, count: int) -> None:
    spacing = np.sqrt(4 * np.pi / count)
    assert quiet(cloud(count)) == 1.0
    assert quiet(noisy(cloud(count), 0.08 * spacing)) == 1.0
    assert quiet(noisy(cloud(count), 0.4 * spacing)) == 0.0


def test_as_few_points_as_are_filtered_and_points_in_a_line_are_no_error() -> None:
    line = np.linspace(0, 1, 400)[:, None] * [1.0, 2.0, 3.0]
    for xyz in (sphere(33), line):
        step = np.full((20, 3), 0.1)
        assert 0 <= quiet(xyz) <= 1
        assert np.isfinite(wiener_weighted(step, nearest(step, xyz), 1.0)).all()


def test_a_step_across_is_made_smaller_by_wieners_weight() -> None:
    rng = np.random.default_rng(0)
    noise, around = 0.001, np.column_stack([rng.uniform(-1, 1, (1000, 2)), 0.001 * rng.standard_normal(1000)])
    around = around[np.argsort((around**2).sum(axis=1))]
    asked = np.column_stack([np.zeros((300, 2)), 4 * noise * rng.standard_normal(300)])
    made = wiener_weighted(asked, nearest(asked, around), 1.0)
    share = np.linalg.norm(made, axis=1) / np.linalg.norm(asked, axis=1)
    assert np.median(share) == pytest.approx(1 / 16, rel=0.5)
    np.testing.assert_array_equal(wiener_weighted(asked, nearest(asked, around), 0.0), asked)
    small = np.column_stack([np.zeros((300, 2)), -0.5 * around[:300, 2]])
    np.testing.assert_array_equal(wiener_weighted(small, nearest(small, around), 1.0), small)


def test_a_point_with_more_noise_than_others_goes_all_the_way() -> None:
    rng = np.random.default_rng(0)
    around = np.column_stack([rng.uniform(-1, 1, (1000, 2)), 0.0005 * rng.standard_normal(1000)])
    around = around[np.argsort((around**2).sum(axis=1))]
    around[:300:30, 2] += 0.02
    step = np.column_stack([np.zeros((300, 2)), 0.002 * rng.standard_normal(300)])
    step[::30, 2] = -0.02
    share = np.linalg.norm(wiener_weighted(step, nearest(step, around), 1.0), axis=1) / np.linalg.norm(step, axis=1)
    assert (share[::30] == 1.0).all()
    assert np.median(share) < 0.2


@pytest.mark.parametrize(("clean", "moved", "at_most"), [(sphere(1000), 0.0, 5e-6), (torus(1500), 0.001, 1.0e-5)])
def test_few_points_with_hardly_any_noise_stay_where_they_are(clean: np.ndarray, moved: float, at_most: float) -> None:
    result = load_filter(threads=2).denoise(noisy(clean, moved))
    assert chamfer_distance(result.xyz, clean) < at_most


def test_noise_that_half_of_a_surface_has_is_taken_off_there() -> None:
    clean = even_sphere(900)
    noise = noisy(clean, 0.02) - clean
    rough = clean + np.where(clean[:, :1] > 0, noise, 0.0)
    result = load_filter(threads=2).denoise(rough)
    assert chamfer_distance(result.xyz, clean) < 0.65 * chamfer_distance(rough, clean)


def floor(noise: float, spacing: float, *, rings: bool = False) -> np.ndarray:
    """Return 1000 points of a plane, the middle first, with noise across it or along a scanner's beams."""
    rng = np.random.default_rng(0)
    if not rings:
        xyz = np.column_stack([spacing * rng.uniform(-15, 15, (1000, 2)), noise * rng.standard_normal(1000)])
        return xyz[np.argsort((xyz**2).sum(axis=1))]
    far, turn = np.meshgrid(np.linspace(6.0, 8.0, 10), np.linspace(-0.2, 0.2, 100), indexing="ij")
    xyz = np.column_stack([(far * np.cos(turn)).ravel(), (far * np.sin(turn)).ravel(), np.full(1000, -1.8)])
    xyz *= 1 + noise * rng.standard_normal((1000, 1)) / np.linalg.norm(xyz, axis=1, keepdims=True)
    return xyz[np.argsort(np.linalg.norm(xyz - [7.0, 0.0, -1.8], axis=1))]


def test_a_scenes_step_is_no_larger_than_the_noise_that_a_few_neighbours_show() -> None:
    around = floor(0.01, 0.3)
    rng = np.random.default_rng(1)
    wrong = rng.standard_normal((300, 3)) * 0.1
    made = limited_to_surfaces(wrong, nearest(wrong, around))
    assert np.sqrt(np.square(made).sum(axis=1).mean()) < 0.02 < np.sqrt(np.square(wrong).sum(axis=1).mean())
    right = np.column_stack([np.zeros((300, 2)), -around[:300, 2]])
    assert np.linalg.norm(limited_to_surfaces(right, nearest(right, around))) > 0.8 * np.linalg.norm(right)


def test_a_scenes_step_stays_where_few_neighbours_do_not_show_its_noise() -> None:
    """On a scanner's ring, which is a cone's whatever its noise, and where points lie closer than the noise is wide."""
    for around in (floor(0.02, 0.0, rings=True), floor(0.3, 0.1)):
        height = around[:300, 2] - np.median(around[:, 2])
        right = np.column_stack([np.zeros((300, 2)), -height])
        assert np.linalg.norm(limited_to_surfaces(right, nearest(right, around))) > 0.8 * np.linalg.norm(right)


def test_a_rough_place_whose_neighbourhoods_are_wide_beside_the_noise_is_not_noisy() -> None:
    around = floor(0.3, 0.1)
    step = np.column_stack([np.zeros((300, 2)), -around[:300, 2]])
    near = nearest(step, around)
    np.testing.assert_array_equal(limited_to_surfaces(step, near, 0.1), step)
    assert np.sqrt(np.square(limited_to_surfaces(step, near, 0.002)).sum(axis=1).mean()) < 1e-4
    line = np.linspace(0, 1, 400)[:, None] * [1.0, 2.0, 3.0]
    step = np.full((20, 3), 0.1)
    assert (np.linalg.norm(limited_to_surfaces(step, nearest(step, line), 1e-6), axis=1) < 1e-9).all()


def test_far_places_of_few_points_are_not_believed_to_have_more_noise_than_the_rest() -> None:
    around = floor(0.01, 0.3)
    step = np.random.default_rng(1).standard_normal((300, 3)) * 0.1
    free, held = (limited_to_surfaces(step, nearest(step, around), most) for most in (np.inf, 0.001))
    assert np.sqrt(np.square(held).sum(axis=1).mean()) < 0.0001 < np.sqrt(np.square(free).sum(axis=1).mean())
    asked = nearest(np.zeros((200, 3)), around)
    two = Nearest.joined([asked, nearest(np.zeros((200, 3)), 3 * around)])
    near, far = noise_on_surfaces(two, 2)
    assert far == pytest.approx(3 * near)
    assert 0.005 < near < 0.02
    assert noise_on_surfaces(nearest(np.zeros((200, 3)), floor(1e-5, 0.3)), 1) == np.inf  # drawn, not scanned
    assert noise_on_surfaces(nearest(np.zeros((50, 3)), np.linspace(0, 1, 400)[:, None] * [1.0, 2, 3]), 1) == np.inf


def test_a_scenes_few_points_and_points_in_a_line_are_no_error() -> None:
    line = np.linspace(0, 1, 400)[:, None] * [1.0, 2.0, 3.0]
    for xyz in (sphere(33), line, np.zeros((40, 3))):
        step = np.full((20, 3), 0.1)
        assert np.isfinite(limited_to_surfaces(step, nearest(step, xyz))).all()
    np.testing.assert_array_equal(limited_to_surfaces(step, nearest(step, line)), step)
    assert len(limited_to_surfaces(step[:1], nearest(step[:1], line))) == 1
