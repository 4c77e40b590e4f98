"""Spreading points along the surface: what it evens out, and what it leaves."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import cKDTree

from straightpcf.model.filter import Filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.processor import Mapper
from straightpcf.model.spread import spread
from straightpcf.points.options import DenoiseOptions
from tests.clouds import even_sphere, sphere


def unevenness(xyz: npt.NDArray[np.float64]) -> float:
    nearest = cKDTree(xyz).query(xyz, k=2)[0][:, 1]
    return float(nearest.std() / nearest.mean())


def test_clumps_are_spread_along_the_surface_and_not_off_it() -> None:
    ball = sphere(4000, 0)
    moved = spread(ball, limit=1.0)
    after = ball + moved
    assert unevenness(after) < 0.8 * unevenness(ball)
    height = np.linalg.norm(after, axis=1) - 1
    assert abs(height).max() < 0.2 * np.linalg.norm(moved, axis=1).max()
    assert abs(height.mean()) < 0.02 * np.linalg.norm(moved, axis=1).mean()


def test_each_round_leaves_them_more_even() -> None:
    ball = sphere(4000, 0)
    left = [unevenness(ball + spread(ball, limit=1.0, rounds=rounds)) for rounds in (1, 2)]
    assert unevenness(ball) > left[0] > left[1]


def test_no_point_goes_farther_than_the_limit() -> None:
    ball = sphere(2000, 0)
    far = np.linalg.norm(spread(ball, limit=0.003), axis=1)
    assert far.max() == pytest.approx(0.003)
    assert not spread(ball, limit=0.0).any()


def test_the_border_of_a_sheet_stays() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41), [0.0]), axis=-1).reshape(-1, 3)
    sheet = grid + 0.005 * np.random.default_rng(0).standard_normal(grid.shape) * [1, 1, 0]
    moved = spread(sheet, limit=1.0)
    assert not moved[:, 2].any()
    border = (np.abs(grid[:, :2]) == 1).any(axis=1)
    outward = (moved * grid)[border].sum(axis=1)
    assert outward.max() < 0.25 * 0.05  # of the grid's spacing
    assert abs(outward.mean()) < 0.03 * 0.05


def test_points_may_come_in_any_order_and_on_any_number_of_threads() -> None:
    ball = sphere(1000, 0)
    order = np.random.default_rng(0).permutation(len(ball))
    expected = spread(ball, limit=1.0)
    np.testing.assert_allclose(spread(ball[order], limit=1.0), expected[order], atol=1e-12)
    np.testing.assert_array_equal(spread(ball, limit=1.0, workers=2), expected)
    many = sphere(10_000, 0)  # more than are taken at once
    with ThreadPoolExecutor(3) as pool:
        np.testing.assert_array_equal(spread(many, limit=1.0, mapper=pool.map), spread(many, limit=1.0))


@pytest.mark.parametrize("count", [2, 3, 9, 33])
def test_few_points_and_points_in_a_line_are_borne(count: int) -> None:
    line = np.arange(count)[:, None] * np.array([1.0, 0, 0])
    assert np.isfinite(spread(line, limit=0.1)).all()
    assert np.isfinite(spread(sphere(count), limit=0.1)).all()


def test_the_filter_spreads_between_passes_only(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[float] = []

    def counted(
        xyz: npt.NDArray[np.float64], limit: float, *, rounds: int, workers: int, mapper: Mapper
    ) -> npt.NDArray[np.float64]:
        calls.append(limit)
        return spread(xyz, limit, rounds=rounds, workers=workers, mapper=mapper)

    monkeypatch.setattr("straightpcf.model.on_host.spread", counted)
    model = Filter(StraightPCF(), threads=1)
    for cloud, passes, between in [(even_sphere(500), 1, 0), (even_sphere(500), 3, 2), (sphere(500), 3, 0)]:
        calls.clear()
        model.denoise(cloud, DenoiseOptions(iterations=passes))
        assert len(calls) == between
        assert len(set(calls)) <= 1
    calls.clear()
    Filter(StraightPCF(), threads=1, even=False).denoise(sphere(500), DenoiseOptions(iterations=2))
    assert not calls
