"""Whether points lie on their surface evenly or by chance is told from how the room around them varies."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from straightpcf.model import survey
from straightpcf.model.filter import load_filter
from straightpcf.model.metrics import chamfer_distance
from straightpcf.model.patches import cut_patches
from straightpcf.model.spacing import Sampling
from tests.clouds import even_sphere, noisy, profiles, sphere, torus


def irregular(xyz: np.ndarray, noise_std: float) -> bool:
    rough = noisy(xyz, noise_std)
    return Sampling.of(rough, cut_patches(rough, coverage=3.0, seed=0), noise_std).irregular


@pytest.mark.parametrize("count", [1000, 3000, 12_000])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_chance_is_told_from_evenness_while_noise_is_below_the_spacing(count: int, share: float) -> None:
    spacing = np.sqrt(4 * np.pi / count)
    assert irregular(sphere(count), share * spacing)
    assert not irregular(even_sphere(count), share * spacing)


def test_lines_are_not_even() -> None:
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 300, endpoint=False), np.linspace(-0.8, 0.8, 13))
    lines = np.stack([0.5 * np.cos(turn), 0.5 * np.sin(turn), height], axis=-1).reshape(-1, 3)
    assert irregular(lines, 0.0)
    assert irregular(lines, 0.01)
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 90, endpoint=False), np.linspace(-0.8, 0.8, 46))
    squares = np.stack([0.5 * np.cos(turn), 0.5 * np.sin(turn), height], axis=-1).reshape(-1, 3)
    assert not irregular(squares, 0.01)


@pytest.mark.parametrize(("noise_std", "ratio"), [(0.02, 10), (0.02, 7)])  # larger than points are apart
def test_the_noise_of_a_scanners_profiles_shows_beside_them_alone(noise_std: float, ratio: int) -> None:
    rough = profiles(noise_std, ratio, 20)
    patches = cut_patches(rough, coverage=3.0, seed=0)
    found = Sampling.of(rough, patches, 0.01)
    assert found.in_lines
    assert found.low_noise < 0.5
    assert Sampling.of(rough, patches, 0.01, survey=partial(survey.survey_on, torch.device("cpu"))) == found
    walls = np.vstack([even_sphere(3000), 0.98 * even_sphere(3000)])
    for other in (profiles(0.0, ratio, 20), sphere(5000), noisy(even_sphere(5000), 0.002), walls):
        assert not Sampling.of(other, cut_patches(other, coverage=3.0, seed=0), 0.002).in_lines
    assert rms_off_the_ball(load_filter(threads=2).denoise(rough).xyz) < 0.5 * rms_off_the_ball(rough)


def rms_off_the_ball(xyz: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.linalg.norm(xyz, axis=1) - 1) ** 2)))


def test_profiles_that_are_far_apart_are_told_by_points_of_others() -> None:
    rough = profiles(0.003, 20, 26)
    assert Sampling.of(rough, cut_patches(rough, coverage=3.0, seed=0), 0.003).in_lines
    assert rms_off_the_ball(load_filter(threads=2).denoise(rough).xyz) < 0.9 * rms_off_the_ball(rough)


@pytest.mark.parametrize("together", [1, 7, 1000])
def test_how_many_patches_are_looked_at_at_once_changes_nothing(together: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rough = loud(torus(5000), 0.005)
    patches = cut_patches(rough, coverage=3.0, seed=0)
    first = Sampling.of(rough, patches, 0.02)
    monkeypatch.setattr(survey, "_TOGETHER", together)
    assert Sampling.of(rough, patches, 0.02) == first
    assert first.after_pass(rough, patches) == replace(first, uncovered=True)


@pytest.mark.parametrize("count", [99, 900, 5000])
@pytest.mark.parametrize("noise_std", [0.0, 0.005, 0.02])
def test_a_device_sees_what_the_host_sees(count: int, noise_std: float) -> None:
    """Of one patch and of several, even points and such as lie by chance, few loud ones and walls among them."""
    walls = np.vstack([even_sphere(count), 0.98 * even_sphere(count)])
    device = partial(survey.survey_on, torch.device("cpu"))
    for cloud in (noisy(even_sphere(count), noise_std), loud(torus(count), noise_std), walls):
        patches = cut_patches(cloud, coverage=3.0, seed=0)
        seen, expected = (Sampling.of(cloud, patches, 0.02, **how) for how in ({"survey": device}, {}))
        close = pytest.approx(expected.low_noise, abs=1e-6), pytest.approx(expected.noise_of_most, rel=1e-9)
        assert seen == replace(expected, low_noise=close[0], noise_of_most=close[1])
        assert seen.after_pass(cloud, patches, survey=device) == seen.after_pass(cloud, patches)


def test_where_nothing_tells_points_are_taken_for_even() -> None:
    assert not irregular(sphere(3000), 0.06)  # the spacing is 0.065
    assert not irregular(sphere(99), 0.0)  # a third of which have the nearest 32 in common


def test_as_many_points_in_one_place_are_no_error() -> None:
    xyz = np.repeat(sphere(100), 20, axis=0)
    assert Sampling.of(xyz, cut_patches(xyz, coverage=3.0, seed=0), 0.0).irregular in (True, False)


@pytest.mark.parametrize(("noise_std", "at_most"), [(0.0, 5e-6), (0.002, 2.2e-5), (0.01, 4e-4)])
def test_points_that_lie_by_chance_end_nearer_to_where_they_were(noise_std: float, at_most: float) -> None:
    clean = torus(3000)
    rough = noisy(clean, noise_std)
    before, after = chamfer_distance(rough, clean), chamfer_distance(load_filter(threads=2).denoise(rough).xyz, clean)
    assert after < (before or at_most)
    assert after < at_most


def loud(xyz: np.ndarray, noise_std: float) -> np.ndarray:
    """Give one point in ten ten times the noise of the others."""
    rng = np.random.default_rng(1)
    stds = np.where(rng.random((len(xyz), 1)) < 0.1, 10 * noise_std, noise_std)
    return xyz + stds * rng.standard_normal(xyz.shape)


def test_a_few_points_with_much_more_noise_do_not_hide_how_the_others_lie() -> None:
    read = 0.03  # as of all, by the rms
    for cloud, by_chance in ((sphere(5000), True), (even_sphere(5000), False)):
        rough = loud(cloud, 0.005)
        sampling = Sampling.of(rough, cut_patches(rough, coverage=3.0, seed=0), read)
        assert sampling.irregular == by_chance
        assert 0.003 < sampling.noise_of_most < 0.007


@pytest.mark.parametrize("noise_std", [0.005, 0.01, 0.03])
def test_what_all_points_have_is_not_the_noise_of_a_few(noise_std: float) -> None:
    for cloud in (sphere(3000), even_sphere(3000)):
        rough = noisy(cloud, noise_std)
        patches = cut_patches(rough, coverage=3.0, seed=0)
        assert Sampling.of(rough, patches, noise_std).noise_of_most == np.inf


def test_points_that_lie_by_chance_are_not_spread_by_what_a_few_of_them_have() -> None:
    clean = torus(3000)
    result = load_filter(threads=2).denoise(loud(clean, 0.005))
    assert chamfer_distance(result.xyz, clean) < 0.8 * chamfer_distance(loud(clean, 0.005), clean)
