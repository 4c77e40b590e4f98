"""What would move much farther than a scene's noise reaches stays where it is."""

from __future__ import annotations

import numpy as np
import pytest

from straightpcf.model.filter import Run, load_filter
from straightpcf.model.neighbourhoods import Neighbourhoods, neighbourhoods
from straightpcf.model.patches import Patches
from straightpcf.model.reading import Reading
from straightpcf.model.restraint import (
    along_heights,
    held_to_lines,
    held_where_scattered,
    limited_to_noise,
    restrained_step,
    trusted_noise_stds,
    without_tangential_motion,
)
from straightpcf.model.spacing import Sampling
from straightpcf.model.tiles import Tiling, split
from straightpcf.points.options import DenoiseOptions
from tests.clouds import distance_to_torus, far_group, noisy, torus
from tests.model.neighbours import nearest


def one_patch(count: int) -> Patches:
    rows = np.arange(count, dtype=np.int32)[None]
    return Patches(np.array([0]), rows, np.array([count]), np.array([1.0]))


def test_a_step_is_whole_up_to_three_noise_stds_and_none_from_four_on() -> None:
    step = np.array([[0.5, 0, 0], [0, 3.0, 0], [0, 0, 3.5], [4.0, 0, 0], [0, 9.0, 0]])
    shares = np.linalg.norm(limited_to_noise(np.zeros((5, 3)), step, 1.0), axis=1) / np.linalg.norm(step, axis=1)
    np.testing.assert_allclose(shares, [1, 1, 0.5, 0, 0])


def test_earlier_passes_count_and_a_step_back_is_free() -> None:
    moved = np.array([[3.0, 0, 0], [3.0, 0, 0]])
    np.testing.assert_allclose(
        limited_to_noise(moved, np.array([[1.0, 0, 0], [-1.0, 0, 0]]), 1.0), [[0, 0, 0], [-1, 0, 0]]
    )


def test_without_noise_nothing_moves() -> None:
    np.testing.assert_array_equal(limited_to_noise(np.zeros((2, 3)), np.array([[1e-6, 0, 0], [0, 0, 0]]), 0.0), 0.0)


def test_more_than_the_usual_noise_is_believed_of_what_is_flat_alone() -> None:
    noise = np.array([0.1, 0.045, 0.12, 0.01])
    flat = np.array([True, False, False, True])
    np.testing.assert_allclose(trusted_noise_stds(noise, flat, 0.04), [0.1, 0.04, 0.016, 0.04])
    np.testing.assert_allclose(trusted_noise_stds(noise[:1], flat[:1], 0.02), 0.06)


def test_nothing_goes_along_a_surface_and_all_across_it() -> None:
    rng = np.random.default_rng(0)
    sheet = rng.uniform(-1, 1, (500, 3)) * [1, 1, 0] + [0, 0, 1] * (0.01 * rng.standard_normal((500, 1)))
    step = rng.normal(0, 0.01, (200, 3))
    left = without_tangential_motion(step, nearest(step, sheet))
    np.testing.assert_allclose(left[:, 2], step[:, 2], atol=0.3 * 0.01)
    assert np.abs(left[:, :2]).max() < 0.3 * np.abs(step[:, :2]).max()


def test_where_there_is_no_surface_a_step_stays_as_it_is() -> None:
    rng = np.random.default_rng(0)
    step = rng.normal(0, 0.01, (200, 3))
    left = without_tangential_motion(step, nearest(step, rng.standard_normal((1000, 3))))
    assert np.median(np.linalg.norm(left, axis=1) / np.linalg.norm(step, axis=1)) == 1.0
    np.testing.assert_array_equal(without_tangential_motion(step, nearest(step, np.zeros((300, 3)))), step)
    assert without_tangential_motion(step[:0], nearest(step[:0], sheet_of(300))).shape == (0, 3)


def of_first(count: int, patch: np.ndarray) -> Neighbourhoods:
    return neighbourhoods(patch[:count], patch, 8)


def sheet_of(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (count, 3)) * [1, 1, 0]


def test_a_line_of_points_goes_off_it_no_farther_than_it_scatters() -> None:
    rng = np.random.default_rng(0)
    wire = np.stack([np.linspace(-1, 1, 60), *rng.normal(0, 0.002, (2, 60))], axis=1)
    wall = sheet_of(940) + np.array([0, 0, 0.5])
    drawn = np.tile([0.05, 0.0, 0.1], (60, 1))
    patch = np.concatenate([wire, wall])
    left = held_to_lines(drawn, patch, of_first(60, patch))
    np.testing.assert_allclose(left[:, 0], 0.05, atol=0.003)  # along it all is made
    assert np.abs(left[:, 2]).max() < 3 * 0.002
    back = -wire * [0, 1, 1]
    denoised = held_to_lines(back, patch, of_first(60, patch))
    assert np.linalg.norm(denoised) > 0.9 * np.linalg.norm(back)


def test_a_rasters_step_across_a_slope_becomes_one_of_its_heights() -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(20.0), np.arange(20.0)))
    slope = np.column_stack([x, y, 0.5 * x])
    across = np.array([-0.5, 0, 1]) / np.sqrt(1.25)
    asked = np.array([0.2 * across, [1.0, 0, 0.5], [0, 0, 0.3]])
    step = along_heights(asked, nearest(asked, slope), 2)
    np.testing.assert_allclose(step, [[0, 0, 0.2 * np.sqrt(1.25)], [0, 0, 0], [0, 0, 0.3]], atol=1e-9)
    cliff = slope * [0.1, 1, 10]
    step = np.array([[0.3, 0, 0.1]])
    np.testing.assert_allclose(along_heights(step, nearest(step, cliff), 2), [[0, 0, 0.1]])


def test_a_rasters_heights_go_farther_than_a_few_neighbours_show_noise() -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(20.0), np.arange(20.0)))
    hill, step = np.column_stack([x, y, 0.002 * x * x]), np.array([[0.0, 0, 0.5]])
    of = {"sampling": Sampling(irregular=True), "trusted_noise": 1.0}
    restrained, _ = restrained_step(step, np.zeros((1, 3)), hill, **of)
    assert np.linalg.norm(restrained) < 0.1 * np.linalg.norm(step)
    restrained, _ = restrained_step(step, np.zeros((1, 3)), hill, **of, height_axis=2)
    np.testing.assert_allclose(restrained, step, rtol=0.05)


def test_what_is_no_line_is_not_held_to_one() -> None:
    rng = np.random.default_rng(0)
    step = rng.normal(0, 0.1, (400, 3))
    held = held_to_lines(step, sheet := sheet_of(1000), of_first(400, sheet))
    assert np.mean(np.linalg.norm(held - step, axis=1) > 1e-9) < 0.05
    nowhere, few = np.zeros((33, 3)), sheet_of(33)
    np.testing.assert_array_equal(held_to_lines(step[:20], nowhere, of_first(20, nowhere)), step[:20])
    assert np.isfinite(held_to_lines(step[:1], few, of_first(1, few))).all()


def test_what_lies_in_no_surface_stays_and_what_does_moves() -> None:
    rng = np.random.default_rng(0)
    step = rng.normal(0, 0.01, (400, 3))
    sheet = noisy(sheet_of(1000), 0.01)
    assert np.linalg.norm(held_where_scattered(step, of_first(400, sheet), 0.01) - step) < 0.1 * np.linalg.norm(step)
    crown = rng.uniform(-1, 1, (1000, 3))
    assert np.mean(held_where_scattered(step, of_first(400, crown), 0.005) == 0) > 0.95
    np.testing.assert_array_equal(held_where_scattered(step, of_first(400, np.zeros((1000, 3))), 0.0), step)
    shown_larger = held_where_scattered(10 * step, of_first(400, 10 * sheet), 0.1)
    np.testing.assert_allclose(shown_larger, 10 * held_where_scattered(step, of_first(400, sheet), 0.01))


def test_a_scenes_ground_is_filtered_and_its_wire_stays() -> None:
    rng = np.random.default_rng(0)
    ground = rng.uniform([-5, -5, 0], [5, 5, 0], (6000, 3))
    wire = np.stack([np.linspace(-4, 4, 60), np.zeros(60), np.full(60, 1.0)], axis=1)
    cloud = np.concatenate([noisy(ground, 0.05), noisy(wire, 0.05), far_group(300.0)])
    run = Run(load_filter(device="cpu"), cloud, DenoiseOptions(iterations=1))
    assert sum(len(patch.indices) for patch in run.patches()) == len(cloud)
    result = run.result(0.0)
    height = result.xyz[:6000, 2]
    assert np.sqrt(np.mean(height**2)) < 0.4 * 0.05
    off = np.linalg.norm((result.xyz[6000:6060] - wire)[:, 1:], axis=1)
    assert np.sqrt(np.mean(off**2)) < 1.5 * np.sqrt(2) * 0.05
    assert result.noise_before == pytest.approx(0.05, rel=0.35)
    (first, _), left = run.readings, run.frame.enter(result.xyz)
    assert first.probes is not None
    assert result.noise_after == pytest.approx(run.frame.radius * run.reader.noise_left(left, first, first.probes))


def test_trees_in_which_noise_is_read_stay_where_the_ground_shows_how_little_there_is() -> None:
    rng = np.random.default_rng(0)
    ground = rng.uniform([-20, -20, 0], [20, 20, 0], (9000, 3))
    trees = np.concatenate([rng.normal([x, y, 3], 0.8, (700, 3)) for x in (-12, 0, 12) for y in (-12, 12)])
    cloud = np.concatenate([noisy(ground, 0.05), trees, far_group(300.0)])
    run = Run(load_filter(device="cpu"), cloud, DenoiseOptions(iterations=1))
    for _ in run.patches():
        pass
    assert run.frame.radius * run.readings[0].noise_of_most < 3 * 0.05
    moved = np.linalg.norm(run.result(0.0).xyz - cloud, axis=1)
    assert np.median(moved[9000 : 9000 + len(trees)]) < 0.01
    assert np.sqrt(np.mean(run.result(0.0).xyz[:9000, 2] ** 2)) < 0.6 * 0.05


def test_what_is_noisy_is_filtered_beside_a_floor_without_noise() -> None:
    rng = np.random.default_rng(0)
    floor, wall = rng.uniform([-20, -20, 0], [20, 20, 0], (12_000, 3)), rng.uniform([-10, 0, 0], [10, 0, 6], (2500, 3))
    cloud = np.concatenate([floor, noisy(wall, 0.05), far_group(300.0)])
    run = Run(load_filter(device="cpu"), cloud, DenoiseOptions(iterations=1))
    for _ in run.patches():
        pass
    assert np.sqrt(np.mean(run.result(0.0).xyz[12_000:14_500, 1] ** 2)) < 0.8 * 0.05


@pytest.mark.slow
def test_a_scenes_noise_beyond_the_table_is_read_and_taken_away() -> None:
    cloud = np.concatenate([noisy(torus(9000), 0.07), far_group(300.0)])
    run = Run(load_filter(device="cpu"), cloud, DenoiseOptions(iterations=2))
    for patch in run.patches():
        cloud[patch.indices] = patch.xyz
    assert run.readings[0].scene
    assert run.readings[0].parts[-1] > 1
    assert run.result(0.0).noise_before == pytest.approx(0.07, rel=0.4)
    assert np.sqrt(np.mean(distance_to_torus(cloud[:9000]) ** 2)) < 0.4 * 0.07


def test_what_was_an_object_before_the_first_pass_stays_one() -> None:
    cloud = noisy(torus(5000), 0.01)
    run = Run(load_filter(device="cpu"), cloud, DenoiseOptions())
    wide = np.concatenate([cloud, far_group(300.0)])
    wide /= 300.0
    tiling = Tiling(wide, split(wide, 10_000), coverage=1.0, seed=0)
    assert run.reader.read(wide, tiling, None).scene
    assert not run.reader.read(wide, tiling, Reading(0.5, 0.01, scene=False, sampling=Sampling())).scene
