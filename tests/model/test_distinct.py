"""Points in one place, or nearly, are one to the network and move together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from straightpcf.model import distinct
from straightpcf.model.distinct import Distinct, cell_of
from straightpcf.model.filter import Filter, load_filter
from tests.clouds import distance_to_torus, far_group, noisy, sphere, torus


@pytest.fixture(scope="module")
def shipped() -> Filter:
    return load_filter(device="cpu", threads=1)


def near(xyz: np.ndarray) -> Distinct:
    return Distinct(xyz, cell=cell_of(xyz))


@pytest.mark.parametrize("scale", [5e-324, 1e-310, 1e-300, 1.0, 1e300])
def test_points_that_are_apart_stay_as_they_are(scale: float) -> None:
    xyz = noisy(torus(20_000), 0.01) * (scale if scale > 1e-320 else 1.0)
    if scale < 1e-320:
        xyz = np.round(xyz * 1000) * scale  # multiples of the least number there is
        xyz = np.unique(xyz, axis=0)[::-1]
    found = near(xyz)
    assert found.xyz is xyz
    assert not found.repeated
    np.testing.assert_array_equal(found.inverse, np.arange(len(xyz)))


@settings(max_examples=30, deadline=None)
@given(count=st.integers(1, 300), places=st.integers(1, 40), scale=st.sampled_from([0.0, 5e-324, 1e-300, 1.0, 1e307]))
def test_equal_points_are_one_place_in_any_unit(count: int, places: int, scale: float) -> None:
    rng = np.random.default_rng(count)
    xyz = (rng.integers(-9, 10, (places, 3)) * scale)[rng.integers(0, places, count)]
    expected, inverse = np.unique(xyz + 0.0, axis=0, return_inverse=True)
    for found in (Distinct(xyz), near(xyz)):
        np.testing.assert_array_equal(found.xyz, xyz if len(expected) == count else expected)
        np.testing.assert_array_equal(found.xyz[found.inverse], xyz)
        if len(expected) < count:
            np.testing.assert_array_equal(found.inverse, inverse.reshape(-1))


@pytest.mark.parametrize("offset", [0.0, 0.25, 1e4])  # many coordinates, or all, lie on a cell's border
@pytest.mark.parametrize("jitter", [1e-12, 1e-9])
def test_near_copies_are_one_place_on_borders_of_cells_too(jitter: float, offset: float) -> None:
    sheet = np.stack([*np.meshgrid(*2 * [np.arange(64) / 64]), np.zeros((64, 64))], axis=-1).reshape(-1, 3) + offset
    rows = np.random.default_rng(0).permutation(np.repeat(np.arange(len(sheet)), 3))
    found = near(noisy(sheet[rows], jitter))
    assert len(found.xyz) == len(sheet)
    assert (np.diff(found.inverse[np.argsort(rows, kind="stable")].reshape(-1, 3), axis=1) == 0).all()


def test_a_scan_and_its_float32_copy_are_one() -> None:
    xyz = noisy(sphere(20_000), 0.01)
    found = near(np.vstack([xyz, xyz.astype(np.float32)]))
    assert len(found.xyz) < 1.005 * len(xyz)  # a border of both grids parts the others
    assert (found.inverse[:20_000] == found.inverse[20_000:]).mean() > 0.995
    assert len(np.unique(found.inverse[:20_000])) == len(xyz)


@pytest.mark.parametrize("times", [2, 3])
@pytest.mark.parametrize("jitter", [1e-5, 3e-4])
def test_a_scan_and_its_copies_of_few_decimals_or_moved_a_little_are_one(jitter: float, times: int) -> None:
    xyz = noisy(torus(3000), 0.01)
    copies = noisy(np.tile(xyz, (times, 1)), jitter, seed=3)
    found = near(copies)
    assert 2950 <= len(found.xyz) <= 3050  # chance puts a few points as near to others
    assert (found.inverse.reshape(times, -1) == found.inverse[:3000]).mean() > 0.97
    assert np.linalg.norm(found.xyz[found.inverse] - copies, axis=1).max() < 0.01  # a tenth of what the 8th is away
    np.testing.assert_array_equal(near(copies * 2.0**1000).inverse, found.inverse)


def test_copies_are_looked_for_where_all_points_share_a_coordinate_however_large() -> None:
    sheet = np.random.default_rng(0).uniform(size=(500, 3)) * [1e-10, 1e-10, 0] + [0, 0, 1e300]
    assert len(near(sheet).xyz) > 490


def test_points_that_chance_puts_near_one_another_stay_apart() -> None:
    rng = np.random.default_rng(0)
    line, sheet = rng.uniform(size=(5000, 1)) * [1, 0, 0], rng.uniform(size=(5000, 3)) * [1, 1, 0]
    dense = np.vstack([sheet, 1e-3 * sheet])  # all of its points are near one another beside the others' distance
    rings = np.stack([np.tile(np.arange(1000) / 1000, 8), np.repeat(np.arange(8.0), 1000), np.zeros(8000)], axis=1)
    for cloud in (line, sheet, dense, rings, np.vstack([torus(5000), torus(500)])):  # some copies are few
        assert len(near(cloud).xyz) > 0.98 * len(np.unique(cloud, axis=0))


def test_far_points_do_not_make_one_place_of_all_others() -> None:
    cloud = np.vstack([noisy(torus(1200), 0.01), far_group(1e8)])
    assert len(near(cloud).xyz) >= 1200


def test_cells_are_told_apart_also_where_their_hashes_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = noisy(np.repeat(torus(300), 3, axis=0), 1e-12)
    expected = near(xyz)
    monkeypatch.setattr(distinct, "_hashed", lambda xyz, *_: np.zeros(len(xyz), dtype=np.uint64))
    found = near(xyz)
    np.testing.assert_array_equal(found.xyz, expected.xyz)
    np.testing.assert_array_equal(found.inverse, expected.inverse)
    assert near(torus(300)).repeated is False


def test_copies_that_a_border_of_two_grids_parts_are_in_one_place() -> None:
    spread = 100.0 * np.arange(1, 40)[:, None] * np.ones(3)
    parted = np.array([[9.999, 10.499, 0.25], [10.001, 10.501, 0.25]])  # by x in the first, by y in the second
    found = Distinct(np.vstack([spread, spread[:1], parted]), cell=1.0)
    assert len(found.xyz) == 40
    assert found.inverse[-1] == found.inverse[-2]


def test_every_point_is_among_the_copies_of_its_place() -> None:
    xyz = noisy(np.tile(torus(200), (3, 1)), 1e-10)
    found = near(xyz)
    copies = [found.copies(np.array([place], dtype=np.int32)) for place in range(len(found.xyz))]
    assert np.array_equal(np.sort(np.concatenate(copies)), np.arange(600))
    assert all((found.inverse[rows] == place).all() for place, rows in enumerate(copies))


def test_a_scan_given_twice_comes_out_as_the_scan_does(shipped: Filter) -> None:
    """Pairs of points are each other's nearest, and noise that both of a pair have was read as none."""
    cloud = noisy(torus(3000), 0.01)
    twice = np.vstack([cloud, np.round(cloud, 3)])
    alone, both = shipped.denoise(cloud), shipped.denoise(twice)
    left, of_alone = (float(np.sqrt(np.square(distance_to_torus(r.xyz)).mean())) for r in (both, alone))
    assert left == pytest.approx(of_alone, rel=0.1)  # 0.0095 of 0.0102 stayed
    assert both.noise_before == pytest.approx(alone.noise_before, rel=0.15)
    assert np.linalg.norm((both.xyz - twice)[:3000] - (both.xyz - twice)[3000:], axis=1).mean() < 1e-3


@pytest.mark.slow
def test_near_copies_take_no_noise_away_from_the_filter(shipped: Filter) -> None:
    """Each point three times: its copies would be its neighbours, and the surface be seen nowhere."""

    def left(xyz: np.ndarray) -> float:
        return float(np.sqrt(np.square(np.linalg.norm(xyz, axis=1) - 1).mean()))

    cloud = np.unique(noisy(sphere(3000), 0.01), axis=0)  # in the order of places: another one has other patches
    alone = shipped.denoise(cloud)
    rows = np.random.default_rng(3).permutation(np.repeat(np.arange(3000), 3))
    for jitter in (0.0, 1e-12, 1e-9):
        copies = noisy(cloud[rows], jitter)
        result = shipped.denoise(copies)
        assert left(result.xyz) == pytest.approx(left(alone.xyz), rel=0.05)
        assert result.noise_before == pytest.approx(alone.noise_before, rel=0.05)
        moved = (result.xyz - copies)[np.argsort(rows, kind="stable")].reshape(-1, 3, 3)
        # Row i is still row i. A border of both grids may part copies, whose float32 coordinates differ in a last bit.
        np.testing.assert_allclose(moved, moved[:, :1].repeat(3, axis=1), rtol=1e-4, atol=1e-15)


def test_all_points_in_one_place_are_said_once_however_far_out_that_is(shipped: Filter) -> None:
    """Warnings of Python are errors here."""
    cloud = np.tile([5e8, -4e9, 300.0], (50, 1))
    result = shipped.denoise(cloud)
    assert result.warnings == ("all points coincide: nothing to filter",)
    np.testing.assert_array_equal(result.xyz, cloud)
