"""Smooth training bodies are sampled on their surface, evenly, with the normals of that surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from straightpcf.model.train.bodies import Body, Limb, carving, creature
from tests.model.numeric import numeric_gradient

STILL = (np.zeros((1, 3)), np.zeros(1), np.zeros(1))  # no relief
UP = np.array([0.0, 0.0, 1.0])


def ball(radius: float) -> Body:
    return Body([Limb(np.zeros(3), 1e-6 * UP, (radius, radius), np.array([1.0, 0, 0]))], 0.05, *STILL)


def test_a_ball_is_sampled_evenly() -> None:
    xyz, normals = ball(0.7).sample(np.random.default_rng(0), 20_000)
    assert xyz.shape == normals.shape == (20_000, 3)
    assert np.linalg.norm(xyz, axis=1) == pytest.approx(0.7, abs=1e-6)
    assert np.abs(normals - xyz / 0.7).max() < 1e-5
    # Archimedes: every slab of the same height has the same area.
    counts = np.histogram(xyz[:, 2], bins=10, range=(-0.7, 0.7))[0]
    assert counts == pytest.approx(2000, abs=5 * np.sqrt(2000))


def test_a_flattened_limb_is_as_thin_as_it_says() -> None:
    across = np.array([0.0, 1.0, 0.0])
    flat = Body([Limb(np.zeros(3), UP, (0.4, 0.4), across, 4.0)], 0.05, *STILL)
    xyz, normals = flat.sample(np.random.default_rng(0), 20_000)
    assert np.abs(xyz).max(axis=0) == pytest.approx([0.4, 0.1, 1.4], abs=0.01)
    # Half of a strip along the flat sides has half of its points.
    side = np.abs(normals[:, 1]) > 0.9
    middle = side & (np.abs(xyz[:, 0]) < 0.1) & (xyz[:, 2] > 0.2) & (xyz[:, 2] < 0.8)
    other = side & (np.abs(xyz[:, 0]) < 0.1) & (xyz[:, 2] > 0.2) & (xyz[:, 2] < 0.5)
    assert other.sum() / middle.sum() == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("family", [creature, carving])
def test_the_gradient_is_that_of_the_value(family: Callable[[np.random.Generator], Body]) -> None:
    body = family(np.random.default_rng(0))
    xyz, normals = body.sample(np.random.default_rng(1), 200)
    value, gradient = body.value(xyz)
    assert np.abs(value).max() < 1e-8
    numeric = numeric_gradient(lambda points: body.value(points)[0], xyz)
    # Limbs have creases of their own, at the seam to their round ends; no more than a few points lie there.
    assert np.median(np.linalg.norm(gradient - numeric, axis=1)) < 1e-5
    assert (np.linalg.norm(gradient - numeric, axis=1) < 1e-3).mean() > 0.98
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
