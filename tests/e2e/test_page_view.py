"""The page's viewer, whatever the cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tests.clouds import torus
from tests.e2e.conftest import picture


def test_a_cloud_of_any_size_is_shown_and_moved(page: Any, tmp_path: Path) -> None:
    box = page.locator("#canvas").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for size in (1e-4, 1e-12, 1e20):
        shown = _shown(page, tmp_path / f"{size}.npy", torus(500) * size)
        page.mouse.move(*middle)
        page.mouse.down(button="right")
        page.mouse.move(middle[0] + 40, middle[1])
        page.mouse.up(button="right")
        assert (shown != _drawn(page)).any(axis=2).mean() > 0.01, size


def test_points_in_one_place_are_shown(page: Any, tmp_path: Path) -> None:
    shown = _shown(page, tmp_path / "one.npy", np.full((3, 3), 7.0))
    height, width, _ = shown.shape
    middle = shown[height // 2 - 5 : height // 2 + 5, width // 2 - 5 : width // 2 + 5]
    assert (middle != shown[5, width // 2]).any()


def test_zeros_that_mean_no_data_change_nothing_of_the_view(page: Any, tmp_path: Path) -> None:
    empty = _drawn(page)
    cloud = torus(900) + np.array([5e5, 4e6, 300.0])  # in a map's coordinates, far from its zeros
    alone = (_shown(page, tmp_path / "alone.npy", cloud) != empty).any(axis=2)
    beside = (_shown(page, tmp_path / "beside.npy", np.vstack([cloud, np.zeros((30, 3))])) != empty).any(axis=2)
    assert alone.mean() > 0.05
    for axis in (0, 1):
        seen = [np.flatnonzero(each.any(axis=axis))[[0, -1]] for each in (alone, beside)]
        np.testing.assert_allclose(*seen, atol=2)
    assert (alone != beside).mean() < 0.2 * alone.mean()


def test_a_long_name_does_not_widen_the_page(page: Any, tmp_path: Path) -> None:
    (file := tmp_path / f"{'a_name_without_a_break_' * 9}.txt").write_text("0 0 0\n1 1 1\n")
    page.set_input_files("#file", file)
    page.wait_for_selector(f"#note:has-text('{file.name}: 2 points')")
    assert page.evaluate("document.documentElement.scrollWidth") == page.viewport_size["width"]


def _shown(page: Any, file: Path, xyz: np.ndarray) -> np.ndarray:
    np.save(file, xyz)
    page.set_input_files("#file", file)
    page.wait_for_selector(f"#note:has-text('{file.name}: {len(xyz)} points')")
    return _drawn(page)


def _drawn(page: Any) -> np.ndarray:
    """Return what is seen once the frame that was asked for is drawn, and the layout has come to rest."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    seen = picture(page)
    for _ in range(20):
        before, seen = seen, picture(page)
        if before.shape == seen.shape and (before == seen).all():
            return seen
    raise AssertionError("the viewer does not come to rest")
