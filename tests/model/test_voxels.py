"""Voxels of what bends are steps: their points go to anywhere in their cells before the first pass."""

from __future__ import annotations

import numpy as np
import pytest

from straightpcf.model.filter import load_filter
from straightpcf.model.voxels import edge_of_voxels, within_voxels
from straightpcf.points.options import DenoiseOptions
from tests.clouds import noisy, sphere


def voxels(xyz: np.ndarray, edge: float) -> np.ndarray:
    """Return the middle of each cell that points of a cloud are in."""
    return (np.unique(np.floor(xyz / edge), axis=0) + 0.5) * edge


def rms_height(xyz: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.linalg.norm(xyz, axis=1) - 1) ** 2)))


@pytest.mark.parametrize("edge", [0.04, 0.1])
@pytest.mark.parametrize("away", [0.0, 5.0])
def test_the_edge_of_a_cell_is_found(edge: float, away: float) -> None:
    cloud = voxels(sphere(100_000), edge) + away
    assert edge_of_voxels(cloud.astype(np.float32).astype(np.float64)) == pytest.approx(edge, rel=1e-4)


def test_rounded_coordinates_and_other_clouds_are_no_voxels() -> None:
    assert edge_of_voxels(np.unique(np.round(sphere(5000), 2), axis=0)) == 0.0
    assert edge_of_voxels(sphere(5000)) == 0.0
    assert edge_of_voxels(noisy(voxels(sphere(100_000), 0.05), 0.01)) == 0.0
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(60.0), np.arange(60.0)))
    assert edge_of_voxels(np.column_stack([x, y, 5 * np.sin(x / 9) * np.cos(y / 7)])) == 0.0  # heights


def test_points_stay_in_their_cells() -> None:
    step = within_voxels(1000, 0.1, 3)
    assert np.abs(step).max() <= 0.05
    assert np.array_equal(step, within_voxels(1000, 0.1, 3))


def test_voxels_of_what_bends_come_nearer_to_it() -> None:
    cloud = voxels(sphere(100_000), 0.07)
    result = load_filter(threads=2).denoise(cloud)
    assert rms_height(result.xyz) < 0.4 * rms_height(cloud)
    assert any("voxels" in warning for warning in result.warnings)


def test_voxels_of_what_is_flat_stay_flat() -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(50.0), np.arange(50.0)))
    flat = np.column_stack([x, y, np.zeros_like(x)])
    result = load_filter(threads=2).denoise(flat, DenoiseOptions(iterations=1))
    assert not result.warnings
    assert np.abs(result.xyz[:, 2]).max() < 0.05
