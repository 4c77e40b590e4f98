"""What tells a step that takes noise from one that takes shape, and what `auto` makes of it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.model.calibration import Calibration
from straightpcf.model.coherence import share_of_noise, summed_coherence
from straightpcf.model.filter import load_filter
from straightpcf.points.options import DenoiseOptions
from tests.clouds import even_sphere, noisy


def coherence(step: npt.NDArray[np.float64], points: npt.NDArray[np.float64]) -> float:
    products, squares, _ = summed_coherence(step, np.zeros_like(step), points, points)
    return products / squares


def test_moves_that_differ_from_point_to_point_are_not_coherent_and_those_alike_are() -> None:
    rng = np.random.default_rng(0)
    points = np.stack([*rng.uniform(size=(2, 2000)), np.zeros(2000)], axis=1)
    up = np.array([0.0, 0.0, 0.01])
    assert abs(coherence(up * rng.normal(size=(2000, 1)), points)) < 0.03
    wave = np.sin(2 * np.pi * points[:, :1])
    assert coherence(up * wave, points) > 0.95
    assert 0.4 < coherence(up * (wave + np.sqrt(0.5) * rng.normal(size=(2000, 1))), points) < 0.6


def test_moves_along_the_surface_say_nothing() -> None:
    rng = np.random.default_rng(1)
    points = np.stack([*rng.uniform(size=(2, 500)), np.zeros(500)], axis=1)
    noise = np.array([0.0, 0.0, 0.01]) * rng.normal(size=(500, 1))
    assert coherence(noise + np.array([0.1, 0.0, 0.0]), points) == pytest.approx(coherence(noise, points))


def test_what_has_moved_counts_along_the_normals_alone() -> None:
    rng = np.random.default_rng(2)
    points = np.stack([*rng.uniform(size=(2, 500)), np.zeros(500)], axis=1)
    moved = np.stack([*rng.normal(size=(2, 500)), rng.normal(size=500)], axis=1)
    _, _, squares = summed_coherence(np.zeros_like(points), moved, points, points)
    assert squares == pytest.approx(np.square(moved[:, 2]).sum())


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_points_have_no_neighbours_to_compare_with(count: int) -> None:
    step, points = np.ones((count, 3)), np.zeros((count, 3))
    assert summed_coherence(step, step, points, np.eye(3)) == (0.0, 0.0, 0.0)
    assert share_of_noise(step, points, np.eye(3)).tolist() == [1.0] * count


def test_a_later_pass_of_a_scene_takes_noise_of_surfaces_and_nothing_of_shapes_rods_and_leaves() -> None:
    rng = np.random.default_rng(0)
    ground = np.stack([*rng.uniform(size=(2, 2000)), 0.001 * rng.normal(size=2000)], axis=1)
    up = np.array([0.0, 0.0, 0.01])
    noise = up * rng.normal(size=(2000, 1))
    wave = up * np.sin(2 * np.pi * ground[:, :1])
    assert share_of_noise(noise, ground, ground).mean() > 0.9
    assert np.median(share_of_noise(wave, ground, ground)) < 0.05
    turn = rng.uniform(0, 2 * np.pi, 300)
    rod = np.stack([0.02 * np.cos(turn), 0.02 * np.sin(turn), rng.uniform(size=300)], axis=1)
    leaves = rng.uniform(size=(2000, 3))
    for points in (rod, leaves):
        assert share_of_noise(0.01 * rng.normal(size=points.shape), points, points).mean() < 0.2


def test_a_second_pass_is_made_where_it_would_take_little_of_the_shape_beside_what_the_first_moved() -> None:
    made = {taken: [Calibration().passes_by_shape(left, taken) for left in (0, 2)] for taken in (-0.01, 0.015, 0.05)}
    assert made == {-0.01: [1, 2], 0.015: [0, 2], 0.05: [0, 0]}
    assert [Calibration().passes_of_scene_by_coherence(c) for c in (0.02, 0.1, 0.2)] == [1, 1, 0]


def test_only_after_the_first_pass_of_little_noise_the_next_step_is_looked_at() -> None:
    asks = Calibration().asks_for_shape
    assert asks((0.3, 0.13), 10_000)
    assert not any([asks((0.2,), 10_000), asks((0.2, 0.13, 0.12), 10_000), asks((0.5, 0.13), 10_000)])
    assert not asks((0.2, 0.13), 1000)


def test_a_ball_with_little_noise_gets_a_second_pass_and_ends_nearer_for_it() -> None:
    shipped, noise = load_filter(device="cpu"), noisy(even_sphere(5000), 0.003)
    result = shipped.denoise(noise)
    assert result.iterations == 2
    assert shipped.calibration.passes_left(result.distances[:2]) == 0  # what d alone says after the first
    one = shipped.denoise(noise, DenoiseOptions(iterations=1))
    height, of_one = (np.square(np.linalg.norm(xyz, axis=1) - 1).mean() for xyz in (result.xyz, one.xyz))
    assert height < 0.7 * of_one


def test_tiles_do_not_change_how_many_passes_little_noise_gets() -> None:
    result = load_filter(device="cpu", tile_points=10_000).denoise(noisy(even_sphere(12_000), 0.003))
    assert result.iterations == 2


def street(noise: float) -> npt.NDArray[np.float64]:
    """Scan 6,000 points of flat ground, the fewer the farther away, and 200 of a pole on it, of radius 0.02."""
    rng = np.random.default_rng(0)
    far, round_ = np.exp(rng.uniform(np.log(0.1), np.log(3), 6000)), rng.uniform(0, 2 * np.pi, 6000)
    about, up = rng.uniform(0, 2 * np.pi, 200), rng.uniform(size=200)
    ground = np.stack([far * np.cos(round_), far * np.sin(round_), np.zeros(6000)], axis=1)
    pole = np.stack([0.5 + 0.02 * np.cos(about), 0.02 * np.sin(about), up], axis=1)
    xyz = np.concatenate([ground, pole])
    return xyz + noise * np.random.default_rng(5).normal(size=xyz.shape)


def test_a_scene_gets_a_second_pass_of_its_ground_where_that_takes_noise_and_none_of_its_poles() -> None:
    shipped, noisy_street = load_filter(device="cpu"), street(0.005)
    result = shipped.denoise(noisy_street)
    assert result.iterations == 2
    assert shipped.calibration.of_scenes().passes_left(result.distances[:2]) == 0  # what d alone says after the first
    one = shipped.denoise(noisy_street, DenoiseOptions(iterations=1))
    heights, of_one = (np.square(xyz[:6000, 2]).mean() for xyz in (result.xyz, one.xyz))
    assert heights < 0.7 * of_one
    np.testing.assert_allclose(result.xyz[6000:], one.xyz[6000:], atol=0.001)


def test_a_scene_without_noise_gets_one_pass() -> None:
    assert load_filter(device="cpu").denoise(street(0.0)).iterations == 1
