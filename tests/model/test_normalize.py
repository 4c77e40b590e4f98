"""The size in which a patch is shown to the network."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightpcf.model.normalize import (
    is_scene,
    parts_of,
    patch_scales,
    zoom_of,
    zoom_of_each,
    zoom_of_flat,
    zoom_of_rest,
)


def test_an_objects_patches_keep_the_papers_frame() -> None:
    radii = np.array([0.13, 0.2, 0.35, 0.5])
    assert not is_scene(*np.quantile(radii, (0.1, 0.5, 0.9)))
    np.testing.assert_array_equal(patch_scales(radii, scene=False), 1.0)
    tiny, wide = patch_scales(np.array([0.05, 2.0]), scene=False) * [0.05, 2.0]
    assert (tiny, wide) == pytest.approx((0.1, 0.58))


def test_a_scenes_patches_are_shown_at_the_usual_size() -> None:
    radii = np.array([0.01, 0.02, 0.04, 0.3, 0.9])
    assert is_scene(*np.quantile(radii, (0.1, 0.5, 0.9)))
    np.testing.assert_allclose(radii * patch_scales(radii, scene=True), [0.25, 0.25, 0.25, 0.3, 0.58])


def test_a_room_of_few_points_is_a_scene_by_how_unlike_its_patches_are() -> None:
    assert is_scene(0.054, 0.155, 0.249)  # 66,800 points, as a scanner in the room has them
    assert is_scene(0.055, 0.142, 0.214)  # 80,000 from the middle of one
    assert not is_scene(0.2, 0.368, 0.55)  # the most unlike of what scanners see of solids
    assert not is_scene(0.0, 0.2, 0.3)


def test_a_patch_without_extent_keeps_its_factor() -> None:
    np.testing.assert_array_equal(patch_scales(np.zeros(3), scene=True), 1.0)


def test_noise_is_brought_to_one_size() -> None:
    radii = np.array([0.1, 0.2, 0.3])
    shown = [noise * zoom_of(noise, radii) for noise in (0.012, 0.015, 0.02, 0.025, 0.03)]
    np.testing.assert_allclose(shown, shown[0])


@pytest.mark.parametrize(
    ("noise", "radius", "zoom"), [(0.035, 0.2, 1), (0.0, 0.2, 2.5), (0.0, 0.5, 1.3), (0.0, 0.9, 1)]
)
def test_a_zoom_has_limits_of_its_own_and_of_the_patches(noise: float, radius: float, zoom: float) -> None:
    assert zoom_of(noise, np.array([radius])) == pytest.approx(zoom)


def test_loud_patches_of_uneven_noise_are_shown_in_the_size_of_their_own() -> None:
    np.testing.assert_allclose(zoom_of_each(np.array([0.0, 0.005, 0.02, 0.04]), 2.0), [2.0, 2.0, 1.5, 1.0])
    scales = patch_scales(np.array([0.2, 0.2, 0.5, 0.01]), scene=False, zoom=np.array([2.0, 1.5, 1.0, 2.0]))
    np.testing.assert_allclose(scales, [2.0, 1.5, 1.0, 10.0])


def test_what_is_flat_is_shown_smaller_the_more_noise_it_has() -> None:
    np.testing.assert_allclose(zoom_of_flat(np.array([0.0, 0.004, 0.005, 0.008, 0.1])), [1.0, 1.0, 0.8, 0.5, 0.4])


@pytest.mark.parametrize("noise", [0.05, 0.1, 1.0])
def test_noise_that_no_network_bears_is_shown_as_less(noise: float) -> None:
    assert noise * zoom_of(noise, np.array([0.2])) == pytest.approx(0.044)
    assert zoom_of(0.044, np.array([0.2])) == 1.0


def test_waves_that_noise_has_left_are_shown_smaller() -> None:
    assert zoom_of_rest(0.02, at_half_size=0.021) == 1.0  # no more than noise of that size would read
    assert zoom_of_rest(0.02, at_half_size=0.026) == pytest.approx(0.5)
    assert zoom_of_rest(0.02, at_half_size=0.1) == pytest.approx(0.4)


def test_a_cloud_is_parted_where_patches_are_small_beside_the_noise() -> None:
    assert parts_of(0.012, np.array([0.1]), 50_000) == (2,)
    assert parts_of(0.03, np.array([0.17]), 50_000) == (3,)
    assert parts_of(0.03, np.array([0.5]), 10_000) == (1,)
    assert parts_of(0.0, np.array([0.0]), 10_000) == (1,)


def test_between_one_part_and_two_a_cloud_is_filtered_as_both() -> None:
    assert [parts_of(noise, np.array([0.1]), 50_000) for noise in (0.0077, 0.0078, 0.0108, 0.0109)] == [
        (1,), (1, 2), (1, 2), (2,)
    ]  # fmt: skip
    assert parts_of(0.0093, np.array([0.1]), 3_000) == (1,)
    # Of noise that is as large as it is ever shown, both do earlier.
    assert [parts_of(noise, np.array([noise / 0.065]), 10_000) for noise in (0.02, 0.028)] == [(1,), (1, 2)]
    assert [parts_of(0.03, np.array([radius]), 10_000) for radius in (0.485, 0.483)] == [(1,), (1, 2)]


def test_what_is_nothing_but_bent_is_filtered_in_so_many_parts_that_noise_is_small_beside_their_patches() -> None:
    radii = np.array([0.15])
    parts = [parts_of(noise, radii, 50_000, bent=True) for noise in (0.008, 0.0097, 0.0135, 0.027, 0.05)]
    assert parts == [(1,), (2,), (4,), (16,), (24,)]
    assert parts_of(0.027, radii, 10_000, bent=True) == (5,)
    assert parts_of(0.0, np.array([0.0]), 10_000, bent=True) == (1,)


@given(st.floats(0, 1), st.floats(0, 1), st.integers(1, 200_000))
def test_no_part_is_too_small(noise: float, radius: float, count: int) -> None:
    parts = parts_of(noise, np.array([radius]), count)
    assert parts[-1] == 1 or count / parts[-1] >= 2000
    assert 1 <= parts[0] <= parts[-1] <= 6
