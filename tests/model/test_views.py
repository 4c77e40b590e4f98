"""Clouds seen from one place: how that is found, and how far points go along their beams."""

from __future__ import annotations

import threading

import numpy as np
import numpy.typing as npt
import pytest
import torch

from straightpcf.model import views
from straightpcf.model.filter import load_filter
from straightpcf.model.normalize import CloudFrame
from straightpcf.model.tiles import Tiling
from straightpcf.model.views import View, along_beams
from straightpcf.points.options import DenoiseOptions
from tests.clouds import even_sphere, noisy, sphere, torus

Floats = npt.NDArray[np.float64]

_BALL = 0.6  # its radius; a wall is behind it


def seen_from(distance: float, count: int = 90) -> tuple[Floats, Floats]:
    """Return what a pinhole camera at (0, 0, -distance) sees of a ball before a leaning wall, and the beams: (N, 3)."""
    eye = np.array([0.0, 0.0, -distance])
    across = np.linspace(-0.9, 0.9, count)
    x, y = (each.ravel() for each in np.meshgrid(across, across))
    beams = np.stack([x, y, np.full(len(x), distance)], axis=1)
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    lean = np.array([0.5, 0.2, 1.0])  # of the wall
    to_wall = (0.8 - eye @ lean) / (beams @ lean)
    middle = beams @ eye
    hits = middle**2 - eye @ eye + _BALL**2
    to_ball = np.where(hits > 0, -middle - np.sqrt(np.maximum(hits, 0.0)), np.inf)
    return eye + beams * np.minimum(to_wall, to_ball)[:, None], beams


def along(clean: Floats, beams: Floats, noise_std: float) -> Floats:
    return clean + beams * np.random.default_rng(5).normal(0, noise_std, (len(clean), 1))


def view_of(xyz: Floats, *, sensor: bool = False) -> View | None:
    frame = CloudFrame.of(xyz)
    positions = frame.enter(xyz)
    probes, _ = Tiling(positions, [np.arange(len(xyz))], coverage=3.0, seed=0, device="cpu").probes()
    return View.of(positions, probes, -frame.centre / frame.radius if sensor else None, "cpu")


def degrees_off(view: View, xyz: Floats, beams: Floats) -> float:
    found = view.beams(CloudFrame.of(xyz).enter(xyz))
    return float(np.rad2deg(np.arccos(np.clip(np.abs((found * beams).sum(axis=1)), 0, 1))).max())


@pytest.mark.parametrize("distance", [2.5, 8.0, 1e4])
@pytest.mark.parametrize("noise_std", [0.01, 0.03])
def test_the_place_is_found_from_which_a_cloud_was_seen_wherever_it_lies(distance: float, noise_std: float) -> None:
    clean, beams = seen_from(distance)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    xyz = along(clean, beams, noise_std) @ turn.T * 7.0 + 1000.0
    view = view_of(xyz)
    assert view is not None
    assert degrees_off(view, xyz, beams @ turn.T) < 0.5


def test_a_sensor_in_the_origin_is_found_to_the_bit() -> None:
    clean, beams = seen_from(4.0)
    xyz = along(clean, beams, 0.02) + np.array([0.0, 0.0, 4.0])
    view = view_of(xyz, sensor=True)
    assert view is not None
    assert degrees_off(view, xyz, beams) < 1e-5


def test_a_file_of_few_digits_keeps_its_view() -> None:
    clean, beams = seen_from(4.0)
    xyz = np.round(along(clean, beams, 0.02), 4)  # a 200th of the distance between points
    assert view_of(xyz) is not None


def test_the_view_is_looked_for_by_the_filters_threads_with_one_of_torchs_each(monkeypatch: pytest.MonkeyPatch) -> None:
    by: list[tuple[bool, int]] = []
    most_regular = views._Raster.most_regular

    def noted(raster: views._Raster, device: str) -> tuple[float, Floats]:
        by.append((threading.current_thread() is threading.main_thread(), torch.get_num_threads()))
        return most_regular(raster, device)

    monkeypatch.setattr(views._Raster, "most_regular", noted)
    load_filter(device="cpu", threads=2).denoise(noisy(torus(4000), 0.02), DenoiseOptions(iterations=1))
    assert set(by) == {(False, 1)}  # else torch's threads wait for each other where a core is busy


@pytest.mark.parametrize("noise_std", [0.0, 0.003, 0.01, 0.03])
def test_noise_in_all_directions_has_no_view(noise_std: float) -> None:
    clean, _ = seen_from(4.0)
    assert view_of(noisy(clean, noise_std)) is None
    for cloud in (even_sphere(6000), torus(6000), sphere(3000)):
        assert view_of(noisy(cloud, noise_std)) is None


def test_what_lies_behind_one_another_is_no_raster() -> None:
    cells = np.stack(np.meshgrid(*3 * [np.arange(18.0)]), axis=-1).reshape(-1, 3)
    assert view_of(cells + np.random.default_rng(0).uniform(-0.2, 0.2, (len(cells), 1)) * [0, 0, 1.0]) is None


@pytest.mark.parametrize(("believed", "left"), [(0.05, 0.004), (0.01, 0.008)])
def test_a_step_to_a_leaning_wall_is_made_along_the_beams(believed: float, left: float) -> None:
    rng = np.random.default_rng(0)
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 32)))
    eye, normal = np.array([0.0, 0.0, -6.0]), np.array([0.6, 0.0, 0.8])
    beams = np.stack([x, y, np.full(len(x), 6.0)], axis=1)
    clean = eye + beams * (-(eye @ normal) / (beams @ normal))[:, None]
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    patch = clean + beams * rng.normal(0, 0.05, (len(clean), 1))
    step = -(patch @ normal)[:, None] * normal + rng.normal(0, 0.03, (len(patch), 1)) * np.array([0.8, 0.0, -0.6])
    there = patch + along_beams(step, patch, View(eye, 1.0), believed)
    assert np.sqrt(np.mean((there @ normal) ** 2)) < left  # of 0.04
    assert np.sqrt(np.mean((there - clean) ** 2)) < left


def test_what_lies_before_a_wall_is_not_drawn_to_it() -> None:
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 32)))
    patch = np.stack([x, y, np.zeros(len(x))], axis=1)
    patch[500, 2] = -0.5
    step = np.zeros_like(patch)
    step[500] = [0.0, 0.001, 0.002]
    made = along_beams(step, patch, View(np.array([0.0, 0.0, 1.0]), 0.0), 0.01)
    np.testing.assert_allclose(made[500], [0.0, 0.0, 0.002], atol=1e-12)
    assert not made[:500].any()


def test_points_that_were_seen_from_one_place_stay_on_their_beams_and_come_near_to_where_they_were() -> None:
    clean, beams = seen_from(4.0, count=60)
    xyz = along(clean, beams, 0.03)
    made = load_filter(device="cpu").denoise(xyz).xyz
    before, after = (np.linalg.norm(each - clean, axis=1) for each in (xyz, made))
    assert np.median(after) < 0.42 * np.median(before)
    off_beam = np.linalg.norm(np.cross(made - xyz, beams), axis=1)
    assert np.median(off_beam) < 0.1 * np.median(np.linalg.norm(made - xyz, axis=1))
