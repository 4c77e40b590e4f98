"""Every point is covered and has one owner."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from straightpcf.model.device_patches import cut_patches_on
from straightpcf.model.patches import Patches, cut_patches
from tests.clouds import noisy, torus

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
both = pytest.mark.parametrize("cut_cloud", [cut_patches, partial(cut_patches_on, DEVICE)], ids=["host", "device"])


@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(1, 3000),
    coverage=st.floats(0.2, 4),
    seed=st.integers(0, 2**32 - 1),
    clump=st.sampled_from(["even", "clustered", "equal"]),
)
@both
def test_every_point_has_an_owner_that_contains_it(
    cut_cloud: Callable[..., Patches], count: int, coverage: float, seed: int, clump: str
) -> None:
    xyz = noisy(torus(count, seed % 1000), 0.01)
    if clump == "clustered":
        xyz *= np.exp(np.random.default_rng(seed).uniform(-6, 3, (count, 1)))
    elif clump == "equal":
        xyz[: count // 2 + 1] = xyz[0]
    cut = cut_cloud(xyz, coverage=coverage, seed=seed, patch_size=200)
    owned = np.concatenate([cut.owned_points(m) for m in range(len(cut.seeds))])
    assert np.array_equal(np.sort(owned), np.arange(count))


@both
def test_the_owner_is_the_patch_that_is_nearest_in_its_own_radius(cut_cloud: Callable[..., Patches]) -> None:
    xyz = torus(4000)
    cut = cut_cloud(xyz, coverage=3, seed=0, patch_size=300)
    relative = np.linalg.norm(xyz[:, None] - xyz[cut.seeds], axis=2) / cut.radii
    inside = np.zeros_like(relative, dtype=bool)
    for m, rows in enumerate(cut.index):
        inside[rows, m] = True
    best = np.where(inside, relative, np.inf).min(axis=1)
    for m in range(len(cut.seeds)):
        np.testing.assert_allclose(relative[cut.owned_points(m), m], best[cut.owned_points(m)], rtol=1e-5)


def test_a_cloud_smaller_than_a_patch_is_one_patch() -> None:
    cut = cut_patches(torus(700), coverage=3, seed=5)
    assert cut.index.shape == (1, 700)
    assert cut.owned_points(0).size == 700


@pytest.mark.parametrize("seed", [0, 17])
def test_the_same_seed_cuts_the_same_patches(seed: int) -> None:
    a, b = (cut_patches(torus(3000), coverage=2, seed=seed) for _ in range(2))
    assert np.array_equal(a.index, b.index)
    assert np.array_equal(a.owned, b.owned)


def test_seeds_chosen_on_a_device_are_farthest_points() -> None:
    xyz = torus(5000)
    seeds = cut_patches_on(DEVICE, xyz, coverage=3, seed=7).seeds
    assert seeds[0] == 7
    for n in range(1, 15):
        nearest = np.linalg.norm(xyz[:, None] - xyz[seeds[:n]], axis=2).min(axis=1)
        assert nearest[seeds[n]] == pytest.approx(nearest.max(), rel=1e-5)
