"""The contracts of DESIGN.md: same points, same order, big coordinates, any size, same bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from straightpcf.model.bent import parts_of_object
from straightpcf.model.filter import MIN_POINTS, DenoiseResult, Filter, load_filter
from straightpcf.points.errors import InvalidCloud, InvalidOptions, JobCanceled, TooFewPoints
from straightpcf.points.options import DenoiseOptions
from tests.clouds import distance_to_torus, even_sphere, far_group, noisy, sphere, torus

ONE_PASS = DenoiseOptions(iterations=1)


@pytest.fixture(scope="module")
def shipped() -> Filter:
    return load_filter(device="cpu")


@pytest.fixture(scope="module")
def smooth_torus(shipped: Filter) -> DenoiseResult:
    return shipped.denoise(noisy(torus(5000), 0.02))


def test_noise_shrinks_on_a_torus(smooth_torus: DenoiseResult) -> None:
    before, after = (np.square(distance_to_torus(x)).mean() for x in (noisy(torus(5000), 0.02), smooth_torus.xyz))
    assert after < 0.25 * before
    assert smooth_torus.noise_after < smooth_torus.noise_before


def test_what_is_curved_is_not_shrunk(smooth_torus: DenoiseResult) -> None:
    xyz = smooth_torus.xyz
    assert smooth_torus.iterations >= 3
    tube = np.hypot(np.hypot(xyz[:, 0], xyz[:, 1]) - 0.7, xyz[:, 2])
    assert abs(tube.mean() - 0.3) < 0.0007  # the clean points around a noisy one lie H s^2 = 0.0008 beneath its foot


def test_a_clean_sphere_hardly_moves(shipped: Filter) -> None:
    cloud = sphere(2000)
    moved = np.linalg.norm(shipped.denoise(cloud).xyz - cloud, axis=1)
    assert np.median(moved) < 0.02


def test_the_result_moves_and_scales_and_shifts_with_the_cloud(shipped: Filter) -> None:
    """A similarity of the input is the same similarity of the output, up to what rotation the network learnt."""
    cloud = noisy(torus(1500), 0.01)
    straight = shipped.denoise(cloud, ONE_PASS).xyz
    shifted = shipped.denoise(cloud * 250 + [5e5, 4e6, 300], ONE_PASS).xyz
    np.testing.assert_allclose((shifted - [5e5, 4e6, 300]) / 250, straight, atol=2e-3)
    rotation = Rotation.from_euler("xyz", [0.4, 1.1, -0.7]).as_matrix()
    turned = shipped.denoise(cloud @ rotation, ONE_PASS).xyz @ rotation.T
    assert np.linalg.norm(turned - straight, axis=1).mean() < 0.5 * np.linalg.norm(cloud - straight, axis=1).mean()


@settings(max_examples=5, deadline=None)
@given(count=st.integers(MIN_POINTS, 2500), holes=st.integers(0, 20), seed=st.integers(0, 1000))
def test_row_i_stays_row_i_and_invalid_rows_pass_through(tiny: Filter, count: int, holes: int, seed: int) -> None:
    cloud = noisy(torus(count, seed), 0.01)
    where = np.random.default_rng(seed).integers(0, count + 1, holes)
    cloud = np.insert(cloud, where, [[np.nan, 1, np.inf]], axis=0)
    result = tiny.denoise(cloud, ONE_PASS)
    assert result.xyz.shape == cloud.shape
    invalid = ~np.isfinite(cloud).all(axis=1)
    np.testing.assert_array_equal(result.xyz[invalid], cloud[invalid])
    assert np.isfinite(result.xyz[~invalid]).all()
    assert np.linalg.norm(result.xyz[~invalid] - cloud[~invalid], axis=1).max() < 1.0
    assert result.untouched == holes


@pytest.mark.parametrize("far", [1e14, 1e30, 1.7e308])
@pytest.mark.parametrize("count", [1, 2000])
def test_rows_that_mean_no_data_pass_through_and_harm_no_other(tiny: Filter, far: float, count: int) -> None:
    cloud = noisy(torus(1200), 0.01)
    alone = tiny.denoise(cloud, ONE_PASS)
    result = tiny.denoise(np.vstack([cloud, np.full((count, 3), far)]), ONE_PASS)
    np.testing.assert_array_equal(result.xyz[:1200], alone.xyz)
    assert (result.xyz[1200:] == far).all()
    assert result.untouched == count
    assert "1e+12 times as far out" in result.warnings[0]


def test_rows_may_be_far_out_or_all_be_huge(tiny: Filter) -> None:
    cloud = noisy(torus(1200), 0.01)
    assert tiny.denoise(np.vstack([cloud, far_group(1e8)]), ONE_PASS).untouched == 0
    huge = tiny.denoise(cloud * 1e307, ONE_PASS)
    assert huge.untouched == 0
    assert np.isfinite(huge.xyz).all()


def test_the_fewest_points_get_one_pass_of_auto_and_a_warning(shipped: Filter) -> None:
    few = shipped.denoise(noisy(torus(300), 0.01))
    assert few.iterations == 1
    assert "300 points" in few.warnings[0]
    assert shipped.denoise(noisy(torus(300), 0.01), DenoiseOptions(iterations=2)).iterations == 2
    assert shipped.denoise(noisy(torus(600), 0.02)).warnings == ()


def test_few_points_get_further_passes_where_these_take_noise_not_shape(shipped: Filter) -> None:
    along = np.random.default_rng(1).uniform(-1, 1, (700, 2))
    plates = np.column_stack([along, 0.3 * (np.arange(700) % 5) - 0.6])  # as far apart as two of their points
    passes = {
        "plates": shipped.denoise(noisy(plates, 0.01)).iterations,
        "by chance": shipped.denoise(noisy(torus(1500), 0.02)).iterations,
        "even": shipped.denoise(noisy(even_sphere(1500), 0.03)).iterations,
        "loud": shipped.denoise(noisy(even_sphere(1500), 0.08)).iterations,
    }
    assert passes["plates"] == passes["by chance"] == 1
    assert passes["even"] == 2
    assert passes["loud"] > 2


def test_patches_add_up_to_the_result_whatever_the_thread_count(tiny: Filter) -> None:
    cloud = noisy(torus(2500), 0.01)
    options = DenoiseOptions(iterations=2)
    whole = tiny.denoise(cloud, options)
    single = Filter(tiny.network, threads=1, coverage=2)
    stitched, seen = cloud.copy(), []
    for patch in single.patches(cloud, options):
        if patch.final:
            stitched[patch.indices] = patch.xyz
            seen.append(patch.indices)
    assert np.array_equal(np.sort(np.concatenate(seen)), np.arange(2500))
    assert stitched.tobytes() == whole.xyz.tobytes()


def test_the_same_request_gives_the_same_bytes(tiny: Filter) -> None:
    cloud = noisy(torus(2200), 0.01)
    assert tiny.denoise(cloud).xyz.tobytes() == tiny.denoise(cloud).xyz.tobytes()


def test_strength_scales_the_displacement(tiny: Filter) -> None:
    cloud = noisy(torus(1500), 0.01)
    full = tiny.denoise(cloud, ONE_PASS).xyz - cloud
    half = tiny.denoise(cloud, DenoiseOptions(iterations=1, strength=0.5)).xyz - cloud
    none = tiny.denoise(cloud, DenoiseOptions(iterations=1, strength=0)).xyz
    np.testing.assert_allclose(half, full / 2, atol=1e-12)
    assert none.tobytes() == cloud.tobytes()


def test_the_noise_left_is_that_of_what_comes_out() -> None:
    model, cloud = load_filter(threads=2), noisy(torus(1000), 0.02)
    none, some, most, full = (
        model.denoise(cloud, DenoiseOptions(iterations=2, strength=strength)) for strength in (0.0, 0.5, 0.99, 1.0)
    )
    assert none.noise_after == none.noise_before == full.noise_before
    assert full.noise_after < 0.5 * full.noise_before
    assert 1.2 * full.noise_after < some.noise_after < 0.8 * full.noise_before
    assert most.noise_after == pytest.approx(full.noise_after, rel=0.2)
    again = model.denoise(some.xyz, DenoiseOptions(iterations=1))
    assert again.noise_before == pytest.approx(some.noise_after, rel=0.2)


def test_numbers_of_any_type_are_taken(tiny: Filter) -> None:
    single = noisy(torus(300), 0.01).astype(np.float32)
    expected = tiny.denoise(single.astype(np.float64), ONE_PASS).xyz
    assert expected.dtype == np.float64
    for same in (single, single.tolist(), single[::-1][::-1]):
        np.testing.assert_array_equal(tiny.denoise(same, ONE_PASS).xyz, expected)
    assert tiny.denoise((1000 * single).astype(np.int64), ONE_PASS).xyz.shape == (300, 3)


def test_masked_points_pass_through_as_nan_ones_do(tiny: Filter) -> None:
    xyz = np.vstack([noisy(torus(300), 0.01), np.full((1, 3), 1e20)])
    result = tiny.denoise(np.ma.masked_greater(xyz, 1e19), ONE_PASS)
    assert result.untouched == 1
    np.testing.assert_array_equal(result.xyz, tiny.denoise(np.where(xyz > 1e19, np.nan, xyz), ONE_PASS).xyz)


def test_a_tensor_that_is_no_array_is_refused_with_torchs_reason(tiny: Filter) -> None:
    tensor = torch.from_numpy(torus(100))
    for bad in (tensor.requires_grad_(), tensor.bfloat16()):
        with pytest.raises(InvalidCloud, match="numbers: "):
            tiny.denoise(bad)


@pytest.mark.parametrize(
    "bad", [np.zeros((100, 2)), np.zeros(300), np.full((100, 3), "a"), np.zeros((100, 3), complex)]
)
def test_what_is_no_array_of_positions_is_refused_by_its_class(tiny: Filter, bad: np.ndarray) -> None:
    with pytest.raises(InvalidCloud, match=r"must be \(N, 3\) numbers, got"):
        tiny.denoise(bad)


@pytest.mark.parametrize("count", [0, 1, 10, MIN_POINTS - 1])
def test_too_few_points_are_refused_with_the_limit(tiny: Filter, count: int) -> None:
    with pytest.raises(TooFewPoints, match=str(MIN_POINTS)):
        tiny.denoise(torus(count))


def test_a_cloud_of_nan_is_refused(tiny: Filter) -> None:
    with pytest.raises(TooFewPoints, match="not finite"):
        tiny.denoise(np.full((100, 3), np.nan))


def test_equal_points_come_back_as_they_are_with_a_warning(tiny: Filter) -> None:
    cloud = np.tile([1e7, -3.0, 0.1], (200, 1))
    result = tiny.denoise(cloud)
    assert result.xyz.tobytes() == cloud.tobytes()
    assert "coincide" in result.warnings[0]


@pytest.mark.parametrize("distinct", [2, 6, 32])
@pytest.mark.parametrize("iterations", [2, "auto"])
def test_few_places_with_many_points_each_come_back_exactly_with_a_warning(
    tiny: Filter, distinct: int, iterations: Any
) -> None:
    places = noisy(torus(distinct), 0.01)
    places[0, 2] = -0.0
    cloud = np.tile(places, (20, 1))
    options = DenoiseOptions(iterations=iterations)
    assert list(tiny.patches(cloud, options)) == []
    result = tiny.denoise(cloud, options)
    assert result.xyz.tobytes() == cloud.tobytes()
    assert result.iterations == 0
    (warning,) = result.warnings
    assert warning == f"all points lie in {distinct} places: nothing is filtered where they are fewer than 33"


def test_as_many_places_as_a_patch_has_at_least_are_filtered(tiny: Filter) -> None:
    result = tiny.denoise(np.tile(noisy(torus(MIN_POINTS), 0.01), (30, 1)), ONE_PASS)
    assert result.iterations == 1
    assert result.warnings == ("all points lie in 33 places: of fewer than 500, shape may be taken for noise",)
    assert np.isfinite(result.xyz).all()


def test_points_in_one_place_move_together_and_cost_no_patches(tiny: Filter) -> None:
    """What fills clouds up to one number of points are copies: thousands of equal points."""
    cloud = noisy(torus(1500), 0.01)
    cloud = np.concatenate([cloud, np.repeat(cloud[:1], 6000, axis=0)])
    patches = list(tiny.patches(cloud, ONE_PASS))
    assert len(patches) < 10
    assert sum(len(patch.indices) for patch in patches) == 7500
    moved = tiny.denoise(cloud, ONE_PASS).xyz[1500:]
    assert (moved == moved[0]).all()


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30, 1e300])
def test_extreme_units_are_filtered_like_any_other(tiny: Filter, scale: float) -> None:
    cloud = noisy(torus(600), 0.01)
    expected = tiny.denoise(cloud, ONE_PASS).xyz
    np.testing.assert_allclose(tiny.denoise(cloud * scale, ONE_PASS).xyz / scale, expected, atol=1e-3)


def test_an_exception_from_the_progress_callback_ends_the_work(tiny: Filter) -> None:
    seen: list[float] = []

    def stop(progress: float) -> None:
        seen.append(progress)
        if len(seen) == 3:
            raise JobCanceled("enough")

    with pytest.raises(JobCanceled):
        tiny.denoise(noisy(torus(2500), 0.01), DenoiseOptions(iterations=3), on_progress=stop)
    assert seen == sorted(seen)
    assert len(seen) == 3


def test_work_can_be_ended_before_a_first_patch_is_settled(tiny: Filter) -> None:
    cloud = noisy(torus(1200), 0.01)

    def stop() -> None:
        raise JobCanceled("enough")

    with tiny.heeding(stop), pytest.raises(JobCanceled):
        next(tiny.patches(cloud, ONE_PASS))
    assert tiny.denoise(cloud, ONE_PASS).iterations == 1  # it is heeded no more


@pytest.mark.parametrize(("iterations", "passes_left"), [(3, None), ("auto", [2, 2, 0]), ("auto", [2, 2, 2, 1, 0])])
def test_progress_never_falls_and_ends_at_one(
    tiny: Filter, monkeypatch: pytest.MonkeyPatch, iterations: Any, passes_left: list[int] | None
) -> None:
    if passes_left is not None:
        foreseen = iter(passes_left)
        monkeypatch.setattr(type(tiny.calibration), "passes_left", lambda *_, **__: next(foreseen))
    seen: list[float] = []
    tiny.denoise(noisy(torus(2500), 0.01), DenoiseOptions(iterations=iterations), on_progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


@pytest.mark.parametrize(("far", "zooms"), [(0.0, 1), (100.0, 0)])  # an object; beside far points: a scene
def test_the_first_pass_over_an_object_is_shown_in_the_size_of_its_noise(
    shipped: Filter, monkeypatch: pytest.MonkeyPatch, far: float, zooms: int
) -> None:
    seen: list[float] = []

    def zoom(noise_std: float, radii: Any) -> float:
        seen.append(noise_std)
        return 1.0

    monkeypatch.setattr("straightpcf.model.noise.zoom_of", zoom)
    cloud = np.concatenate([noisy(torus(1500), 0.02), far_group(far)])
    shipped.denoise(cloud, DenoiseOptions(iterations=2))
    assert len(seen) == zooms
    assert all(0.015 < noise < 0.03 for noise in seen)


@pytest.mark.slow
def test_noise_as_large_as_the_patches_of_dense_points_is_read(shipped: Filter) -> None:
    result = shipped.denoise(noisy(torus(300_000), 0.02), ONE_PASS)
    assert result.noise_before == pytest.approx(0.02, rel=0.15)


def test_a_part_with_more_noise_is_filtered_like_a_cloud_with_as_much(shipped: Filter) -> None:
    clean = torus(4000)
    loud = clean[:, 0] > 0.3
    noise = np.random.default_rng(1).standard_normal(clean.shape)
    left = [
        distance_to_torus(shipped.denoise(clean + std * noise, ONE_PASS).xyz)[loud]
        for std in (np.where(loud, 0.03, 0.006)[:, None], 0.03)
    ]
    uneven, even = (float(np.sqrt(np.square(distances).mean())) for distances in left)
    assert uneven < 1.2 * even


@pytest.mark.parametrize("noise", [0.03, 0.05, 0.08])
def test_more_noise_than_any_in_training_is_read_and_taken_away(shipped: Filter, noise: float) -> None:
    cloud = noisy(torus(2000), noise)
    result = shipped.denoise(cloud, DenoiseOptions(iterations=2))
    before, after = (np.square(distance_to_torus(x)).mean() for x in (cloud, result.xyz))
    assert result.noise_before == pytest.approx(noise, rel=0.35)
    assert after < 0.25 * before


def test_a_dense_cloud_is_parted_where_its_noise_fills_the_patches(
    shipped: Filter, monkeypatch: pytest.MonkeyPatch
) -> None:
    strip = np.random.default_rng(0).uniform([-1, -0.15, 0], [1, 0.15, 0], (10_000, 3))
    cloud = noisy(strip, 0.03)
    wanted: list[int] = []

    def parts(*given: Any) -> tuple[int, ...]:
        wanted.append(parts_of_object(*given))
        return wanted[-1]

    monkeypatch.setattr("straightpcf.model.noise.parts_of_object", parts)
    filtered, seen = cloud.copy(), []
    for patch in shipped.patches(cloud, ONE_PASS):
        filtered[patch.indices] = patch.xyz
        seen.append(patch.indices)
    assert wanted[0][-1] > 1
    assert np.array_equal(np.sort(np.concatenate(seen)), np.arange(len(cloud)))
    before, after = (np.square(xyz[:, 2]).mean() for xyz in (cloud, filtered))
    assert after < 0.4 * before


def test_an_open_sheet_with_more_noise_than_any_in_training_does_not_end_in_layers(shipped: Filter) -> None:
    square = np.random.default_rng(0).uniform([-0.7, -0.7, 0], [0.7, 0.7, 0], (10_000, 3))
    filtered = shipped.denoise(noisy(square, 0.04), DenoiseOptions(iterations=2)).xyz
    # In whole, or in the parts of a body, twice as far: half of the points in either layer.
    assert np.median(np.abs(filtered[:, 2])) < 0.006


@pytest.mark.parametrize("parts", [(3,), (1, 2)])
def test_parts_and_tiles_add_up_to_the_result_whatever_the_thread_count(
    tiny: Filter, monkeypatch: pytest.MonkeyPatch, parts: tuple[int, ...]
) -> None:
    monkeypatch.setattr("straightpcf.model.noise.parts_of_object", lambda *_: parts)
    monkeypatch.setattr("straightpcf.model.filter.MIN_TILE_POINTS", 4000)
    cloud = noisy(torus(4400), 0.01)
    options = DenoiseOptions(iterations=1)
    results = [
        Filter(tiny.network, threads=threads, coverage=2, tile_points=4000).denoise(cloud, options)
        for threads in (1, 2)
    ]
    assert results[0].xyz.tobytes() == results[1].xyz.tobytes()
    assert not np.array_equal(results[0].xyz, cloud)


def test_as_a_whole_and_in_parts_is_the_mean_of_both(tiny: Filter, monkeypatch: pytest.MonkeyPatch) -> None:
    cloud, results = noisy(torus(2500), 0.02), []
    for parts in ((1,), (2,), (1, 2)):
        monkeypatch.setattr("straightpcf.model.noise.parts_of_object", lambda *_, parts=parts: parts)
        patches = list(tiny.patches(cloud, ONE_PASS))
        order = np.concatenate([patch.indices for patch in patches])
        assert np.array_equal(np.sort(order), np.arange(len(cloud)))
        progress = [patch.progress for patch in patches]
        assert progress == sorted(progress)
        assert progress[-1] == 1.0
        results.append(np.concatenate([patch.xyz for patch in patches])[np.argsort(order)])
    assert np.array_equal(results[2], tiny.denoise(cloud, ONE_PASS).xyz)
    np.testing.assert_allclose(results[2], (results[0] + results[1]) / 2, atol=1e-12)
    assert not np.allclose(results[0], results[1])


@pytest.mark.parametrize(("name", "value"), [("coverage", 0.5), ("euler_steps", 0)])
def test_a_filter_is_told_what_it_needs_at_least(tiny: Filter, name: str, value: float) -> None:
    with pytest.raises(InvalidOptions, match=f"{name} is {value}; it must be at least 1"):
        Filter(tiny.network, **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "value"), [("euler_steps", "3"), ("tile_points", 1e5)])
def test_a_filter_takes_whole_numbers_alone(tiny: Filter, name: str, value: object) -> None:
    with pytest.raises(InvalidOptions, match=f"{name} is {value!r}; it must be a whole number"):
        Filter(tiny.network, **{name: value})  # type: ignore[arg-type]


def test_options_may_be_numbers_of_numpy(tiny: Filter) -> None:
    said = DenoiseOptions(iterations=np.int64(1), seed=np.uint32(3), strength=np.float32(0.5))  # type: ignore[arg-type]
    assert said == DenoiseOptions(iterations=1, seed=3, strength=0.5)
    assert [type(value) for value in (said.iterations, said.seed, said.strength)] == [int, int, float]
    for wrong in ({"iterations": np.int64(11)}, {"seed": np.float64(1)}, {"strength": np.nan}, {"iterations": True}):
        with pytest.raises(InvalidOptions, match="must be"):
            DenoiseOptions(**wrong)
