"""What tells a step that takes noise from one that takes shape, and what `auto` makes of it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.model.calibration import Calibration
from straightpcf.model.coherence import summed_coherence
from straightpcf.model.filter import load_filter
from straightpcf.points.options import DenoiseOptions
from tests.clouds import even_sphere, noisy


def coherence(step: npt.NDArray[np.float64], points: npt.NDArray[np.float64]) -> float:
    products, squares = summed_coherence(step, points, points)
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


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_points_have_no_neighbours_to_compare_with(count: int) -> None:
    assert summed_coherence(np.ones((count, 3)), np.zeros((count, 3)), np.eye(3)) == (0.0, 0.0)


def test_a_second_pass_is_made_where_its_step_is_noise_and_none_where_it_is_shape() -> None:
    made = {c: [Calibration().passes_by_coherence(left, c) for left in (0, 2)] for c in (0.02, 0.1, 0.2)}
    assert made == {0.02: [1, 2], 0.1: [0, 2], 0.2: [0, 0]}


def test_only_after_the_first_pass_of_little_noise_the_next_step_is_looked_at() -> None:
    asks = Calibration().asks_for_coherence
    assert asks((0.2, 0.13), 10_000)
    assert not any([asks((0.2,), 10_000), asks((0.2, 0.13, 0.12), 10_000), asks((0.3, 0.13), 10_000)])
    assert not asks((0.2, 0.13), 1000)


def test_a_ball_with_little_noise_gets_a_second_pass_and_ends_nearer_for_it() -> None:
    shipped, noise = load_filter(device="cpu"), noisy(even_sphere(8000), 0.003)
    result = shipped.denoise(noise)
    assert result.iterations == 2
    assert shipped.calibration.passes_left(result.distances[:2]) == 0  # what d alone says after the first
    one = shipped.denoise(noise, DenoiseOptions(iterations=1))
    height, of_one = (np.square(np.linalg.norm(xyz, axis=1) - 1).mean() for xyz in (result.xyz, one.xyz))
    assert height < 0.7 * of_one


def test_tiles_do_not_change_how_many_passes_little_noise_gets() -> None:
    result = load_filter(device="cpu", tile_points=10_000).denoise(noisy(even_sphere(12_000), 0.003))
    assert result.iterations == 2
