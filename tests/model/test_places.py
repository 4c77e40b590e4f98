"""Pieces of streets, rooms, roofs, trees and masts: what a scanner sees of them is their surface, thin parts too."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial import cKDTree

from straightpcf.model.normalize import CloudFrame
from straightpcf.model.train.places import PLACES, Place
from straightpcf.model.train.primitives import Box
from straightpcf.model.train.scanned import Scanner


@pytest.mark.parametrize("place", dict.fromkeys(PLACES), ids=lambda place: place.__name__.strip("_"))
def test_a_scanner_sees_the_surface_of_a_place_and_what_is_thin_in_it(
    place: Callable[[np.random.Generator], Place],
) -> None:
    rng = np.random.default_rng(4)
    solid, way = place(rng)
    xyz, normals = solid.sample(rng, 100_000)
    assert len(xyz) == pytest.approx(100_000, rel=0.1)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    assert not solid.contains(xyz + 1e-6 * normals).any()
    assert solid.contains(xyz - 1e-6 * normals).all()

    frame = CloudFrame.of(xyz)
    eye = way / np.linalg.norm(way) * 3
    points = Scanner(frame.enter(xyz), normals, eye, 0.3).raster(rng, 12_000, 1.0, shifted=False)
    assert len(points) == pytest.approx(12_000, rel=0.1)
    seen = frame.centre + frame.radius * points
    gaps, _ = cKDTree(xyz).query(seen)
    # A beam that misses a rod by less than two samples lie apart, 0.01, meets it all the same.
    assert np.quantile(gaps, (0.5, 0.98)) == pytest.approx([0.005, 0.02], abs=0.01)
    boxes = [part for part in solid.parts if isinstance(part, Box)]
    beyond = np.min([(np.abs((seen - box.centre) @ box.turn) - box.half).max(axis=1) for box in boxes], axis=0)
    assert (beyond > 0.03).sum() > 50  # on rods, wires, branches, leaves, balls
