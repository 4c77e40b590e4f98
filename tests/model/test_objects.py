"""Several objects that lie far from each other are filtered as each would be alone."""

from __future__ import annotations

import numpy as np
import pytest

from straightpcf.model.filter import Filter, load_filter
from straightpcf.model.objects import separate_objects
from straightpcf.points.options import DenoiseOptions
from tests.clouds import even_sphere, noisy, sphere, torus

AWAY = np.array([9.0, 0.0, 0.0])


def parted(*objects: np.ndarray) -> list[int]:
    cloud = np.vstack(objects)
    return [len(rows) for rows in separate_objects(cloud / np.abs(cloud).max() / np.sqrt(3))]


def test_what_lies_far_from_the_rest_is_an_object_of_its_own() -> None:
    row = [torus(3000, seed) + 3 * seed * np.array([1.0, 1.0, 0.0]) for seed in range(4)]
    assert parted(*row) == [3000] * 4
    assert parted(torus(3000), 0.1 * torus(600) + AWAY) == [3000, 600]


def test_two_that_are_near_each_other_beside_a_third_one_are_two() -> None:
    assert parted(torus(1500), torus(900) + AWAY, torus(1200) + 300 * AWAY) == [1500, 900, 1200]
    assert parted(torus(1500), torus(900) + AWAY, torus(1200) + 300 * AWAY, torus(600) + 9000 * AWAY) == [
        1500,
        900,
        1200,
        600,
    ]


def test_a_small_group_belongs_to_the_nearest_object() -> None:
    beside = 0.02 * sphere(30) + AWAY + [0.0, 2.0, 0.0]
    assert parted(torus(3000), torus(2000) + AWAY, beside) == [3000, 2030]


@pytest.mark.parametrize(
    "parts",
    [
        [torus(4000)],
        [torus(450), torus(450) + AWAY],  # of few points nothing tells
        [torus(4000), torus(400) + AWAY],
        [torus(4000), 0.1 * torus(1000)],  # in its hole
        [torus(4000) * [1, 1, 0], torus(4000) * [1, 1, 0] + [0, 0, 0.5]],  # plates over each other
        [torus(4000), torus(4000) + 0.21 * AWAY],  # spheres that meet
    ],
    ids=["one", "few", "a group", "in a hole", "plates", "beside"],
)
def test_what_belongs_together_is_one_object(parts: list[np.ndarray]) -> None:
    assert len(parted(*parts)) == 1


def test_each_object_ends_as_it_would_alone() -> None:
    shipped = load_filter(device="cpu")
    ball, ring = noisy(even_sphere(1500), 0.03), noisy(torus(1200), 0.005) + AWAY
    stray, nowhere = np.full((1, 3), -40.0), np.full((1, 3), np.nan)
    places = np.split(np.random.default_rng(0).permutation(2702), [1500, 2700, 2701])
    cloud = np.empty((2702, 3))
    for rows, part in zip(places, (ball, ring, stray, nowhere), strict=True):
        cloud[np.sort(rows)] = part
    result, alone = shipped.denoise(cloud), [shipped.denoise(part) for part in (ball, ring)]
    assert [part.iterations for part in alone] == [2, 1]
    for rows, part in zip(places, (alone[0].xyz, alone[1].xyz, stray, nowhere), strict=True):
        np.testing.assert_array_equal(result.xyz[np.sort(rows)], part)
    assert (result.iterations, len(result.distances), result.untouched) == (2, 3, 2)
    assert alone[1].noise_before < result.noise_before < alone[0].noise_before
    assert result.warnings == (
        "1 points are not finite and were passed through",
        "1 points lie apart from all others and were passed through",
        "the cloud is 2 objects far from each other: each was filtered as if it were alone",
    )


@pytest.mark.parametrize("away", [1e5, 1e7])
def test_objects_so_far_apart_that_each_is_a_few_of_the_clouds_places_end_as_they_would_alone(
    tiny: Filter, away: float
) -> None:
    ring, options = noisy(torus(600), 0.01), DenoiseOptions(iterations=1)
    objects = [ring + np.array([number * away, 0, 0]) for number in range(3)]
    result = tiny.denoise(np.vstack(objects), options)
    np.testing.assert_array_equal(result.xyz, np.vstack([tiny.denoise(each, options).xyz for each in objects]))
    assert result.warnings == ("the cloud is 3 objects far from each other: each was filtered as if it were alone",)


def test_copies_of_few_points_make_no_object_of_them(tiny: Filter) -> None:
    rings = np.vstack([noisy(torus(450), 0.01), noisy(torus(450), 0.01) + AWAY])
    assert tiny.denoise(np.tile(rings, (3, 1)), DenoiseOptions(iterations=1)).warnings == ()
    # By itself a sign for "no data", and too few points.
    blob = np.vstack([np.tile(-9 * AWAY, (490, 1)), -9 * AWAY + 0.02 * sphere(20)])
    far = np.vstack([noisy(torus(600), 0.01) + number * 1e5 * AWAY for number in range(3)])
    assert len(tiny.denoise(np.vstack([far, blob]), DenoiseOptions(iterations=1)).xyz) == 2310


def test_any_number_of_points_in_one_place_is_filtered_without_a_warning_of_numpys(tiny: Filter) -> None:
    cloud = np.tile([448000.25, 5411000.5, 310.0], (1000, 1))
    result = tiny.denoise(cloud)
    np.testing.assert_array_equal(result.xyz, cloud)
    assert result.warnings == ("all points coincide: nothing to filter",)


def test_patches_of_several_objects_come_pass_by_pass_and_add_up(tiny: Filter) -> None:
    cloud = np.vstack([noisy(torus(1500), 0.01), noisy(torus(2500), 0.02) + AWAY])
    options = DenoiseOptions(iterations=2)
    told, out = [], cloud.copy()
    for patch in tiny.patches(cloud, options):
        told.append((patch.iteration, patch.progress))
        out[patch.indices] = patch.xyz
    iterations, progress = zip(*told, strict=True)
    assert list(iterations) == sorted(iterations)
    assert set(iterations) == {1, 2}
    assert list(progress) == sorted(progress)
    assert 0.9 < progress[-1] <= 1
    np.testing.assert_array_equal(out, tiny.denoise(cloud, options).xyz)


def test_a_filter_without_zoom_takes_all_for_one_object(tiny: Filter) -> None:
    cloud = np.vstack([noisy(torus(1500), 0.01), noisy(torus(1500), 0.01) + AWAY])
    plain = Filter(tiny.network, threads=1, zoom=False)
    assert plain.denoise(cloud, DenoiseOptions(iterations=1)).warnings == ()
