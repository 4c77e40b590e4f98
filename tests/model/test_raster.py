"""Rasters: a height for every cell of a grid, with noise in the heights alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.model.filter import load_filter
from straightpcf.model.raster import height_axis
from tests.clouds import noisy, sphere


def hills(side: int, *, noise_std: float = 0.0, edge: float = 1.0) -> npt.NDArray[np.float64]:
    """Return heights over side x side cells, (N, 3)."""
    x, y = (edge * grid.ravel() for grid in np.meshgrid(np.arange(side), np.arange(side)))
    z = height(x / edge, y / edge) * edge
    return np.column_stack([x, y, z + noise_std * np.random.default_rng(0).standard_normal(len(x))])


def height(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return 3 * np.sin(x / 9) + 2 * np.cos(y / 11 + x / 20)


def rms_off_the_hills(xyz: npt.NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean((xyz[:, 2] - height(*xyz[:, :2].T)) ** 2)))


@pytest.mark.parametrize("up", [0, 1, 2])
@pytest.mark.parametrize("away", [0.0, 5000.0])
def test_heights_over_a_grid_are_a_raster_whichever_axis_they_are_along(up: int, away: float) -> None:
    cloud = np.roll(hills(50, noise_std=0.3, edge=0.5) + away, up - 2, axis=1)
    assert height_axis(cloud) == up
    assert height_axis(cloud.astype(np.float32).astype(np.float64)) == up
    assert height_axis(cloud[np.random.default_rng(1).random(len(cloud)) < 0.7]) == up  # cells without a height


@pytest.mark.parametrize("step", [0.01, 0.1, 1.0])
def test_rounded_heights_are_a_raster_too(step: float) -> None:
    cloud = hills(60, noise_std=0.3)
    cloud[:, 2] = step * np.round(cloud[:, 2] / step)
    assert height_axis(cloud) == 2


def test_heights_in_few_steps_come_nearer_to_the_hills() -> None:
    cloud = hills(60)
    cloud[:, 2] = 2 * np.round(cloud[:, 2] / 2)
    result = load_filter(threads=2).denoise(cloud)
    assert rms_off_the_hills(result.xyz) < 0.6 * rms_off_the_hills(cloud)
    assert result.iterations >= 3
    np.testing.assert_array_equal(result.xyz[:, :2], cloud[:, :2])


@pytest.mark.parametrize("side", [45, 100, 200, 201, 1000])
def test_a_raster_is_one_however_large(side: int) -> None:
    assert height_axis(hills(side)) == 2


def test_other_clouds_are_no_rasters() -> None:
    cloud = hills(50, noise_std=0.3)
    turned = cloud @ np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]])
    assert height_axis(turned) is None
    assert height_axis(noisy(cloud, 0.01)) is None
    assert height_axis(np.concatenate([cloud, cloud + np.array([0, 0, 4])])) is None  # two heights in a cell
    assert height_axis(hills(50) * [1, 1, 0]) is None  # no heights at all
    x, y = np.unique(np.round(np.random.default_rng(0).uniform(0, 40, (3000, 2)), 1), axis=0).T
    assert height_axis(np.column_stack([x, y, height(x, y)])) is None  # a grid, and nearly all of it empty
    assert height_axis(sphere(5000)) is None
    assert height_axis(np.unique(np.round(sphere(5000), 2), axis=0)) is None


@pytest.mark.parametrize("noise_std", [0.2, 0.6])
def test_a_rasters_noise_is_taken_away_and_its_cells_keep_their_places(noise_std: float) -> None:
    cloud = hills(60, noise_std=noise_std)
    result = load_filter(threads=2).denoise(cloud)
    assert rms_off_the_hills(result.xyz) < 0.4 * rms_off_the_hills(cloud)
    assert result.noise_before == pytest.approx(noise_std, rel=0.25)
    np.testing.assert_array_equal(result.xyz[:, :2], cloud[:, :2])


def test_a_raster_without_noise_stays_as_it_is() -> None:
    cloud = hills(60)
    result = load_filter(threads=2).denoise(cloud)
    assert np.linalg.norm(result.xyz - cloud, axis=1).max() < 0.05
