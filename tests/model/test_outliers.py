"""A few points in the air are passed through, and are not taken for noise that the whole cloud has."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from straightpcf.model.filter import DenoiseResult, Filter, load_filter
from straightpcf.model.outliers import isolated, without_data
from straightpcf.points.errors import TooFewPoints
from straightpcf.points.options import DenoiseOptions
from tests.clouds import distance_to_torus, noisy, sphere, torus


@pytest.fixture(scope="module")
def shipped() -> Filter:
    return load_filter(device="cpu", threads=2)


@pytest.fixture(scope="module")
def filtered_alone(shipped: Filter) -> Callable[[float], tuple[np.ndarray, DenoiseResult]]:
    """A torus with so much noise, and what the filter makes of it: once for all that is compared to it."""

    @cache
    def of(noise_std: float) -> tuple[np.ndarray, DenoiseResult]:
        rough = noisy(torus(5000), noise_std)
        return rough, shipped.denoise(rough)

    return of


def in_the_air(count: int, reach: float) -> np.ndarray:
    return np.random.default_rng(5).uniform(-reach, reach, (count, 3))


def floor_around_a_scanner(count: int) -> np.ndarray:
    """Points of a floor 1.8 below its scanner at 0, 0, 0, fewer with the distance."""
    rng = np.random.default_rng(0)
    away, turn = rng.exponential(4.0, count) + 1, rng.uniform(0, 2 * np.pi, count)
    return np.stack([away * np.cos(turn), away * np.sin(turn), np.full(count, -1.8)], axis=1)


@pytest.mark.parametrize("reach", [1.3, 4.0, 1000.0])
# Between these levels of noise a last bit decides whether `auto` polishes this torus.
@pytest.mark.parametrize("noise_std", [0.004, 0.01])
def test_a_hundredth_of_points_in_the_air_changes_little_for_the_others(
    shipped: Filter,
    filtered_alone: Callable[[float], tuple[np.ndarray, DenoiseResult]],
    noise_std: float,
    reach: float,
) -> None:
    rough, alone = filtered_alone(noise_std)
    together = shipped.denoise(np.vstack([rough, in_the_air(50, reach)]))
    rms = [np.sqrt(np.square(distance_to_torus(r.xyz[:5000])).mean()) for r in (alone, together)]
    assert rms[1] < 1.3 * rms[0]
    assert together.iterations <= alone.iterations
    assert 35 <= together.untouched <= 52
    assert "apart from all others" in together.warnings[0]


@pytest.mark.parametrize("noise_std", [0.0, 0.01, 0.03])
def test_no_point_of_a_noisy_cloud_is_taken_for_alone(noise_std: float) -> None:
    assert not isolated(noisy(torus(5000), noise_std)).any()
    heavy = np.random.default_rng(1).laplace(scale=noise_std or 1e-6, size=(5000, 3))
    assert not isolated(torus(5000) + heavy).any()


def test_a_sparse_surface_beside_a_dense_one_belongs_to_the_cloud() -> None:
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-1, 1, (900, 2)), 0.01 * rng.standard_normal(900)])
    ball = noisy(0.15 * sphere(10_000), 0.002) + np.array([0, 0, 0.25])
    assert not isolated(np.vstack([ball, table])).any()
    air = rng.uniform(-1, 1, (900, 3)) + np.array([0, 0, 2])
    apart = isolated(np.vstack([ball, air]))
    assert not apart[:10_000].any()
    assert apart[10_000:].mean() > 0.8


@pytest.mark.parametrize(("share", "noise_std"), [(0.15, 0.005), (0.3, 0.005), (0.3, 0.02), (0.5, 0.01)])
def test_many_points_in_the_air_are_found_as_few_are(share: float, noise_std: float) -> None:
    air = in_the_air(round(10_000 * share), 1.4)
    apart = isolated(np.vstack([noisy(torus(10_000), noise_std), air]))
    assert apart[:10_000].mean() < 0.001
    away = distance_to_torus(air) > 0.2
    assert apart[10_000:][away].mean() > 0.95


@pytest.mark.slow
def test_many_points_in_the_air_change_little_for_the_others(
    shipped: Filter, filtered_alone: Callable[[float], tuple[np.ndarray, DenoiseResult]]
) -> None:
    rough, alone = filtered_alone(0.01)
    together = shipped.denoise(np.vstack([rough, in_the_air(1500, 1.4)]))
    rms = [np.sqrt(np.square(distance_to_torus(r.xyz[:5000])).mean()) for r in (alone, together)]
    assert rms[1] < 1.4 * rms[0]
    assert together.untouched > 1000


@pytest.mark.parametrize("noise_std", [0.0, 0.005, 0.02])
@pytest.mark.parametrize("rest", [4, 16])
def test_a_part_with_fewer_points_is_no_air(noise_std: float, rest: int) -> None:
    whole = torus(40_000)
    kept = (whole[:, 0] < 0.2) | (np.arange(len(whole)) % rest == 0)
    fading = np.random.default_rng(2).random(len(whole)) < np.exp(-1.5 * (whole[:, 0] + 1.4))
    for part in (kept, fading):
        assert isolated(noisy(whole[part], noise_std)).mean() < 0.01


def test_one_point_far_away_does_not_make_an_object_a_scene() -> None:
    with_it = np.vstack([torus(5000), [[40.0, 0, 0]]])
    assert np.flatnonzero(isolated(with_it)).tolist() == [5000]


def test_groups_and_halves_belong_to_something() -> None:
    two = np.vstack([torus(3000), 0.1 * torus(300) + [3.0, 0, 0]])
    assert not isolated(two).any()
    sparse = np.vstack([torus(4000)[torus(4000)[:, 0] > 0], torus(400)[torus(400)[:, 0] < 0]])
    assert isolated(sparse).mean() < 0.01


def test_a_scene_keeps_its_sparse_parts() -> None:
    ground = floor_around_a_scanner(40_000)
    assert not isolated(ground / np.abs(ground).max()).any()


@pytest.mark.parametrize(
    ("sign", "rows", "offset"),
    [(0.0, 1, 0.0), (0.0, 300, 0.0), (0.0, 1, 5e6), (0.0, 300, 5e6), (-9999.0, 300, 0.0), (-9999.0, 300, 5e6)],
)
def test_rows_in_a_place_that_means_no_data_stay_and_harm_no_other(
    tiny: Filter, sign: float, rows: int, offset: float
) -> None:
    ground = floor_around_a_scanner(3000) + offset
    alone = tiny.denoise(ground, DenoiseOptions(iterations=1))
    result = tiny.denoise(np.vstack([ground, np.full((rows, 3), sign)]), DenoiseOptions(iterations=1))
    assert np.array_equal(result.xyz[:3000], alone.xyz)
    assert (result.xyz[3000:] == sign).all()
    assert result.untouched == rows + alone.untouched
    assert result.warnings[0] == f'{rows} points are in a place that means "no data" and were passed through'


def test_many_zeros_mean_no_data_on_a_floor_too() -> None:
    floor = np.random.default_rng(0).uniform(-1, 1, (5000, 3)) * [1, 1, 0]
    floor[0] = 0
    assert not without_data(floor, np.ones(5000, dtype=np.int64)).any()
    assert np.flatnonzero(without_data(floor, np.where(np.arange(5000) == 0, 40, 1))).tolist() == [0]


def test_places_that_points_share_mean_something_beside_others() -> None:
    rng = np.random.default_rng(0)
    for cells in (np.round(20 * sphere(20_000)) / 20, np.round(5 * rng.standard_normal((9000, 3)))):
        places, shared = np.unique(cells + 0.0, axis=0, return_counts=True)
        assert shared.max() > 8
        assert not without_data(places, shared).any()
    padded = torus(3000)
    assert not without_data(padded, np.where(np.arange(3000) == 7, 500, 1)).any()


@pytest.mark.parametrize("count", range(12))
def test_few_places_mean_something(count: int) -> None:
    assert not without_data(np.arange(3.0 * count).reshape(-1, 3), np.full(count, 9)).any()


def test_too_few_points_beside_those_without_data_are_refused(tiny: Filter) -> None:
    with pytest.raises(TooFewPoints, match=r"32 points to filter .* 500 no data"):
        tiny.denoise(np.vstack([torus(32) + 10, np.zeros((500, 3))]))
