"""Few points of a place, told from an object, and what stands or hangs there left alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.model.filter import load_filter
from straightpcf.model.openness import is_of_open_place
from tests.clouds import even_sphere, noisy, sphere, torus

Floats = npt.NDArray[np.float64]


def field(noise_std: float) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return points of a field with crowns of leaves over it, and which of them are leaves."""
    rng = np.random.default_rng(3)
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.7, 0.7, 90)] * 2))
    ground = np.column_stack([x, y, 0.01 * np.sin(6 * x)]) + [0.004, 0.004, 0] * rng.uniform(-1, 1, (len(x), 3))
    crowns = np.column_stack([*rng.uniform(-0.6, 0.6, (2, 12)), rng.uniform(0.12, 0.2, 12)])
    leaves = np.repeat(crowns, 40, axis=0) + 0.05 * rng.normal(size=(480, 3))
    xyz = np.concatenate([ground, leaves])
    return noisy(xyz, noise_std), np.arange(len(xyz)) >= len(ground)


def plate(count: int) -> Floats:
    """Return points of a thin closed plate, in random places."""
    x, y, side = np.random.default_rng(5).uniform(-0.7, 0.7, (3, count))
    rim = 0.05 * np.sqrt(np.clip(1 - (np.maximum(np.abs(x), np.abs(y)) / 0.7) ** 8, 0, 1))
    return np.column_stack([x, y, np.sign(side) * rim])


def test_a_field_is_a_place() -> None:
    assert is_of_open_place(field(0.0006)[0])


@pytest.mark.parametrize("object_", [torus(8000), sphere(6000), even_sphere(5000), plate(9000)])
def test_closed_objects_are_none_also_with_strays(object_: Floats) -> None:
    strays = np.random.default_rng(2).permutation(len(object_)) < 0.03 * len(object_)
    assert not is_of_open_place(noisy(object_, 0.001))
    assert not is_of_open_place(object_ + np.where(strays, 0.03, 0.001)[:, None] * noisy(0 * object_, 1.0))


def test_leaves_over_a_thinned_field_stay_where_they_are_and_its_ground_is_filtered() -> None:
    rough, leaves = field(0.0006)
    clean, _ = field(0.0)
    result = load_filter(device="cpu").denoise(rough)
    moved = np.linalg.norm(result.xyz - rough, axis=1)
    assert np.sqrt(np.square(moved[leaves]).mean()) < 0.001
    before, after = (np.square((xyz - clean)[~leaves, 2]).mean() for xyz in (rough, result.xyz))
    assert after < 0.7 * before
