"""Recomputed normals are the surface's, on the side that they were."""

from __future__ import annotations

import numpy as np
import pytest

from straightpcf.model.normals import recompute_normals
from tests.clouds import sphere


@pytest.mark.parametrize("scale", [1.0, 1e-30, 1e6])
def test_on_a_sphere_they_point_away_from_its_centre_or_to_it(scale: float) -> None:
    xyz = sphere(3000) * scale
    outwards = xyz / scale
    for old in (outwards, -outwards):
        normals = recompute_normals(xyz, old + 0.3)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
        assert np.median(np.einsum("ni,ni->n", normals, np.sign((old * outwards).sum()) * outwards)) > 0.999


def test_rows_that_are_not_finite_keep_theirs() -> None:
    xyz, old = sphere(200), np.full((200, 3), 7.0)
    xyz[5] = np.nan
    old[6] = np.nan
    normals = recompute_normals(xyz, old)
    assert (normals[5] == 7.0).all()
    np.testing.assert_allclose(np.linalg.norm(np.delete(normals, 5, axis=0), axis=1), 1.0)


def test_equal_points_end_in_unit_vectors() -> None:
    normals = recompute_normals(np.ones((50, 3)), np.zeros((50, 3)))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
