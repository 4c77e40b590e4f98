"""A cloud cut tile by tile is filtered as if it were cut at once."""

from __future__ import annotations

import threading

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from straightpcf.model import tiles as model_tiles
from straightpcf.model.filter import Filter, load_filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.spread import spread
from straightpcf.model.tiles import Tiling, split
from straightpcf.points.errors import InvalidOptions
from straightpcf.points.options import MIN_TILE_POINTS, DenoiseOptions
from tests.clouds import distance_to_torus, noisy, torus


@settings(max_examples=25, deadline=None)
@given(count=st.integers(1, 3000), tile_points=st.integers(1, 1000), equal=st.booleans())
def test_every_row_is_in_one_tile_and_none_is_too_large(count: int, tile_points: int, *, equal: bool) -> None:
    xyz = np.zeros((count, 3)) if equal else torus(count)
    tiles = split(xyz, tile_points)
    assert np.array_equal(np.sort(np.concatenate(tiles)), np.arange(count))
    assert max(map(len, tiles)) <= tile_points


def tiling_of(xyz: npt.NDArray[np.float64], tiles: list[npt.NDArray[np.int64]]) -> Tiling:
    return Tiling(xyz, tiles, coverage=3, seed=0)


@settings(max_examples=25, deadline=None)
@given(count=st.integers(1, 3000), tile_points=st.integers(100, 3000), parts=st.integers(1, 6), equal=st.booleans())
def test_every_row_is_in_one_part(count: int, tile_points: int, parts: int, *, equal: bool) -> None:
    xyz = np.zeros((count, 3)) if equal else torus(count)
    tiles = split(xyz, tile_points)
    rows = tiling_of(xyz, tiles).subsamples(parts)
    assert np.array_equal(np.sort(np.concatenate(rows)), np.arange(count))
    assert max(map(len, rows)) - min(map(len, rows)) <= len(tiles)
    assert all((np.diff(part) > 0).all() for part in rows)


def test_a_pass_that_is_parted_again_builds_no_second_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = torus(3000)
    tiling = tiling_of(xyz, tiles := split(xyz, 1000))
    expected = [tiling_of(xyz, tiles).subsamples(parts) for parts in (1, 2, 5)]
    built: list[int] = []
    monkeypatch.setattr(model_tiles, "cKDTree", lambda points: built.append(len(points)) or cKDTree(points))
    for parts, rows in zip((1, 2, 5), expected, strict=True):
        assert all(map(np.array_equal, tiling.subsamples(parts), rows))
    assert len(built) == len(tiles)


@pytest.mark.parametrize(("device", "is_ahead"), [("cpu", False), ("cpu:0", True)])  # "cpu" is the host's own way
def test_beside_a_device_the_tree_is_built_ahead_and_once(
    device: str, is_ahead: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    xyz = torus(3000)
    expected = tiling_of(xyz, tiles := split(xyz, 3000)).subsamples(3)
    built: list[threading.Thread] = []
    monkeypatch.setattr(
        model_tiles, "cKDTree", lambda points: built.append(threading.current_thread()) or cKDTree(points)
    )
    tiling = Tiling(xyz, tiles, coverage=3, seed=0, device=device)
    for _ in range(2):
        tiling.expect_parts()
    assert all(map(np.array_equal, tiling.subsamples(3), expected))
    assert [thread is not threading.main_thread() for thread in built] == [is_ahead]


def test_parts_are_as_evenly_spread_as_the_whole() -> None:
    xyz = torus(12_000)
    for part in tiling_of(xyz, split(xyz, 4000)).subsamples(3):
        alone = cKDTree(xyz[part])
        among = [len(near) for near in alone.query_ball_point(xyz[::50], 0.15)]
        of_all = [len(near) for near in cKDTree(xyz).query_ball_point(xyz[::50], 0.15)]
        np.testing.assert_allclose(3 * np.array(among), of_all, rtol=0.35)


def test_every_point_is_owned_once_by_patches_of_its_own_tiles_cut() -> None:
    xyz = noisy(torus(30_000), 0.01)
    tiles = split(xyz, 10_000)
    tiling = Tiling(xyz, tiles, coverage=3, seed=0)
    tiling.probes(48)
    owned = [np.concatenate([cut.owned_points(m) for m in range(len(cut.seeds))]) for cut in tiling.cuts()]
    assert [sorted(rows) for rows in owned] == [tile.tolist() for tile in tiles]


def test_a_devices_cuts_are_made_once_and_read_again() -> None:
    xyz = noisy(torus(12_000), 0.01)
    tiling = Tiling(xyz, split(xyz, 6_000), coverage=3, seed=0, device="cpu:0")
    tiling.probes(48)
    once, again = list(tiling.cuts()), list(tiling.cuts())
    assert len(once) == 2
    assert all(first is second for first, second in zip(once, again, strict=True))


def test_a_halo_that_would_be_the_whole_cloud_is_held_to_the_size_of_its_tile() -> None:
    # Half of the points lie in one dense spot, so sparse patches reach everywhere.
    xyz = np.concatenate([0.001 * torus(20_000), torus(20_000)])
    tiling = Tiling(xyz, split(xyz, 10_000), coverage=3, seed=0)
    tiling.probes(48)
    for cut, tile in zip(tiling.cuts(), split(xyz, 10_000), strict=True):
        assert len(np.unique(cut.index)) <= 2 * len(tile)


@pytest.mark.slow
def test_no_seam_is_to_be_seen() -> None:
    clean = torus(20_000)
    xyz = noisy(clean, 0.01)
    options = DenoiseOptions(iterations=1)
    model = load_filter(device="cpu")
    at_once = model.denoise(xyz, options).xyz
    in_tiles = Filter(model.network, calibration=model.calibration, tile_points=10_000).denoise(xyz, options).xyz
    tile_of = np.empty(len(xyz), dtype=int)
    for number, tile in enumerate(split(xyz, 10_000)):
        tile_of[tile] = number
    _, near = cKDTree(xyz).query(xyz, k=64)
    at_a_seam = (tile_of[near] != tile_of[:, None]).any(axis=1)
    assert 0.02 < at_a_seam.mean() < 0.5
    off = [np.square(distance_to_torus(cloud[at_a_seam])).mean() for cloud in (in_tiles, at_once)]
    assert off[0] < 1.05 * off[1]
    assert np.linalg.norm(in_tiles - at_once, axis=1)[at_a_seam].mean() < 0.2 * np.abs(xyz - clean).mean()


def test_a_tile_and_its_halo_are_spread_as_the_whole_cloud_is() -> None:
    xyz = noisy(torus(20_000), 0.005)
    tiling = Tiling(xyz, split(xyz, 6000), coverage=3, seed=0)
    tiling.probes(48)
    expected = spread(xyz, 0.01)
    seen = 0
    for rows, own in tiling.surroundings():
        np.testing.assert_allclose(spread(xyz[rows], 0.01)[:own], expected[rows[:own]], atol=1e-12)
        seen += own
    assert seen == len(xyz)


def test_tiles_smaller_than_a_few_patches_are_refused() -> None:
    with pytest.raises(InvalidOptions, match=f"at least {MIN_TILE_POINTS}"):
        Filter(StraightPCF(width=16, distance_width=16), tile_points=1000)
