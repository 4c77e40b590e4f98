"""The size in which a patch is shown to the network."""

from __future__ import annotations

import numpy as np

from straightpcf.model.normalize import is_scene, patch_scales


def test_an_objects_patches_keep_the_papers_frame() -> None:
    radii = np.array([0.13, 0.2, 0.35, 0.5])
    assert not is_scene(radii)
    np.testing.assert_array_equal(patch_scales(radii, scene=False), 1.0)


def test_a_scenes_patches_are_shown_at_the_usual_size() -> None:
    radii = np.array([0.01, 0.02, 0.04, 0.3, 0.9])
    assert is_scene(radii)
    np.testing.assert_allclose(radii * patch_scales(radii, scene=True), [0.25, 0.25, 0.25, 0.3, 0.58])


def test_a_patch_without_extent_keeps_its_factor() -> None:
    np.testing.assert_array_equal(patch_scales(np.zeros(3), scene=True), 1.0)
