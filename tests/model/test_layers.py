"""A depth camera's points lie in layers, and go to anywhere in their own before the first pass."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.model.filter import load_filter
from straightpcf.model.layers import Layers
from straightpcf.model.patches import cut_patches
from straightpcf.model.spacing import Sampling
from tests.clouds import distance_to_torus, noisy, profiles, sphere, torus

Floats = npt.NDArray[np.float64]


def seen(step: float, *, noise: float = 0.0, side: int = 70) -> tuple[Floats, Floats]:
    """Return a bent wall as a camera in the origin sees it along z, (N, 3), as it is and in whole disparities.

    These are `step` apart; noise: in disparities.
    """
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.5, 0.5, side), np.linspace(-0.4, 0.4, side)))
    depth = 2 / (1 - 0.5 * u) + 0.1 * np.sin(5 * v)
    rays = np.column_stack([u, v, np.ones_like(u)])
    disparity = 1 / (step * depth) + noise * np.random.default_rng(0).standard_normal(len(depth))
    return rays * depth[:, None], rays / (step * np.round(disparity))[:, None]


def depth_of_wall(xyz: Floats) -> Floats:
    u, v = xyz[:, 0] / xyz[:, 2], xyz[:, 1] / xyz[:, 2]
    depth: Floats = 2 / (1 - 0.5 * u) + 0.1 * np.sin(5 * v)
    return depth


def rms_off_the_wall(xyz: Floats) -> float:
    return float(np.sqrt(np.mean((xyz[:, 2] - depth_of_wall(xyz)) ** 2)))


def layers_of(xyz: Floats, *, raster: bool = False, in_lines: bool = False) -> Layers | None:
    return Layers.of(xyz, cut_patches(xyz, coverage=3.0, seed=0), raster=raster, in_lines=in_lines)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("step", "noise"), [(0.01, 0.0), (0.02, 0.5)])
def test_layers_are_found_along_any_axis_and_are_as_wide_as_they_are_apart(
    axis: int, step: float, noise: float
) -> None:
    true, told = (np.roll(cloud, axis - 2, axis=1) for cloud in seen(step, noise=noise))
    for cloud in (told, told.astype(np.float32).astype(np.float64)):
        layers = layers_of(cloud)
        assert layers is not None
        assert (layers.axis, layers.wide) == (axis, True)
        assert layers.widths == pytest.approx(step * told[:, axis] ** 2, rel=0.35)
    if not noise:
        assert np.mean(np.abs(true - told)[:, axis] <= 0.55 * layers.widths) > 0.95


def test_layers_no_farther_apart_than_points_are_narrow() -> None:
    layers = layers_of(in_layers(torus(8000), 0.016))
    assert layers is not None
    assert (layers.axis, layers.wide) == (2, False)


def in_layers(xyz: Floats, step: float) -> Floats:
    return np.column_stack([xyz[:, :2], step * np.round(xyz[:, 2] / step)])


def stairs() -> Floats:
    places = np.random.default_rng(0).uniform(0, 1, (20_000, 2)) * [5, 2]
    return np.column_stack([places, 0.5 * np.floor(places[:, 0] / 0.28)])


def slices() -> Floats:
    turn, height = np.random.default_rng(0).uniform(0, 1, (2, 10_000))
    height = np.round(height / 0.05) * 0.05
    return np.column_stack([np.cos(6.28 * turn), np.sin(6.28 * turn), height]) * (1 - 0.5 * height[:, None])


def sheet_in_profiles() -> Floats:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(0, 2, 0.04), np.arange(0, 2, 0.01)))
    return np.column_stack([x, y, 0.1 * np.sin(4 * x) * np.cos(3 * y)])


def floor_and_ball() -> Floats:
    places = np.random.default_rng(0).uniform(-2, 2, (30_000, 2))
    return np.concatenate([np.column_stack([places, np.zeros(30_000)]), 0.3 * sphere(300) + [0, 0, 0.5]])


def box() -> Floats:
    rng = np.random.default_rng(0)
    out, face = rng.uniform(-1, 1, (10_000, 3)), rng.integers(3, size=10_000)
    out[np.arange(10_000), face] = np.sign(out[np.arange(10_000), face])
    return out


@pytest.mark.parametrize(
    "cloud",
    [
        sphere(10_000),
        noisy(seen(0.01)[1], 0.001),
        np.unique(np.round(sphere(10_000), 2), axis=0),  # rounded
        np.unique(np.round(sphere(50_000) / 0.05) * 0.05, axis=0),  # voxels
        stairs(),
        slices(),
        sheet_in_profiles(),
        profiles(0.005, 10, 38),
        floor_and_ball(),
        box(),
        np.round(box(), 2),
        sphere(5000) * [1, 1, 0],
        np.concatenate([sphere(5000) * [1, 1, 0], sphere(5000) * [1, 1, 0] + [0, 0, 0.03]]),
    ],
    ids=[
        "sphere",
        "noise",
        "rounded",
        "voxels",
        "stairs",
        "slices",
        "profiles",
        "noisy-profiles",
        "floor",
        "box",
        "rounded-box",
        "flat",
        "two",
    ],
)
def test_other_clouds_have_no_layers(cloud: Floats) -> None:
    assert layers_of(cloud) is None


def test_profiles_whose_noise_hides_that_they_are_lines_have_none_either() -> None:
    rough, told = profiles(0.014, 10, 20), seen(0.02, noise=0.5)[1]
    in_lines, of_layers = (
        Sampling.of(xyz, cut_patches(xyz, coverage=3.0, seed=0), 0.01).in_lines for xyz in (rough, told)
    )
    assert layers_of(rough) is not None
    assert layers_of(rough, in_lines=in_lines) is None
    assert not of_layers


def test_points_stay_in_their_layers() -> None:
    layers = layers_of(seen(0.01)[1])
    assert layers is not None
    within = layers.anywhere_within(3)
    assert not within[:, :2].any()
    assert np.all(np.abs(within[:, 2]) <= layers.widths / 2)
    assert np.abs(within[:, 2] / layers.widths).mean() == pytest.approx(0.25, rel=0.05)
    assert np.array_equal(within, layers.anywhere_within(3))
    assert not np.array_equal(within, layers.anywhere_within(4))


@pytest.mark.slow
@pytest.mark.parametrize(("step", "noise"), [(0.006, 0.0), (0.01, 0.3)])
def test_what_a_depth_camera_sees_comes_nearer_to_it(step: float, noise: float) -> None:
    _, told = seen(step, noise=noise, side=100)
    result = load_filter(threads=2).denoise(told)
    assert rms_off_the_wall(result.xyz) < 0.4 * rms_off_the_wall(told)
    assert result.iterations >= 3
    assert any("layers along z" in warning for warning in result.warnings)


@pytest.mark.slow
def test_narrow_layers_are_filtered_as_they_are_and_often_enough() -> None:
    told = in_layers(torus(8000), 0.016)
    result = load_filter(threads=2).denoise(told)
    before, after = (np.sqrt(np.mean(distance_to_torus(xyz) ** 2)) for xyz in (told, result.xyz))
    assert after < 0.6 * before
    assert result.iterations >= 3
    assert not result.warnings


def test_layers_that_are_wide_beside_a_patch_stay_as_they_are() -> None:
    _, told = seen(0.02, side=100)
    result = load_filter(threads=2).denoise(told)
    assert rms_off_the_wall(result.xyz) < 1.05 * rms_off_the_wall(told)
