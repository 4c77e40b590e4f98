"""Training clouds as a scanner sees them: on the beams of a raster, from one side, with noise along the beams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch

from straightpcf.model.filter import Filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.train import scanned
from straightpcf.model.train.data import ALONG_BEAMS, NOISE_STD, PatchSource, drawn_noise
from straightpcf.model.train.device_data import DevicePatchSource
from straightpcf.model.train.primitives import Box, Ellipsoid, Solid
from straightpcf.model.train.record import write_passed
from straightpcf.model.train.scanned import SCANNED_PLACES, SCANNED_SOLIDS, Scanned, Scanner, write_scanned

EYE = np.array([0.3, -0.2, 4.0])


def scanner(solid: Solid) -> Scanner:
    return Scanner(*solid.sample(np.random.default_rng(0), 200_000), EYE, 0.7)


def scan(scanner: Scanner, count: int = 3000, *, aspect: float = 1.0, shifted: bool = False) -> npt.NDArray[np.float64]:
    return scanner.raster(np.random.default_rng(0), count, aspect, shifted=shifted)


def in_image(points: npt.NDArray[np.float64], scanner: Scanner) -> npt.NDArray[np.float64]:
    """Return where beams to the points (N, 3) go through the plane of rows and columns, (N, 2)."""
    away = (points - EYE) @ scanner.axes.T
    image: npt.NDArray[np.float64] = away[:, :2] / away[:, 2:]
    return image


def test_beams_meet_the_near_side_of_a_ball() -> None:
    points = scan(scanner(Solid([Ellipsoid()])))
    assert len(points) == pytest.approx(3000, rel=0.05)
    assert np.linalg.norm(points, axis=1) == pytest.approx(1, abs=1e-3)
    assert ((points * (points - EYE)).sum(axis=1) < 0).all()


def test_the_points_lie_on_rows_and_columns() -> None:
    ball = scanner(Solid([Ellipsoid()]))
    for places in in_image(scan(ball), ball).T:
        steps = np.diff(np.unique(places.round(9)))
        assert steps == pytest.approx(steps.min(), rel=1e-3)


def test_a_solid_hides_what_is_behind_it() -> None:
    front, behind = Box(np.array([0, 0, 0.5]), half=np.array([0.5, 0.5, 0.02])), Box(half=np.array([1, 1, 0.02]))
    points = scan(scanner(Solid([front, behind])), 6000)
    low = points[:, 2] < 0.3
    assert low.any()
    # Where the beams to points of the rear plate go through the plane of the front one.
    share = ((EYE[2] - 0.52) / (EYE[2] - points[low, 2]))[:, None]
    crossed = EYE[:2] + share * (points[low, :2] - EYE[:2])
    assert (np.abs(crossed).max(axis=1) > 0.49).all()
    assert points[~low, 2].max() == pytest.approx(0.52, abs=1e-6)


def test_rows_may_be_farther_apart_than_points_and_begin_anywhere() -> None:
    plate = scanner(Solid([Box(half=np.array([1, 1, 0.1]))]))
    image = in_image(scan(plate, aspect=4.0, shifted=True), plate)
    counts = sorted(len(np.unique(places.round(9))) for places in image.T)
    assert counts[0] < 60  # sqrt(3000 / 4) rows, and no columns
    assert counts[1] > 2000


@pytest.mark.parametrize("what", [SCANNED_SOLIDS, SCANNED_PLACES])
def test_an_archive_of_scans_is_training_data(what: Scanned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scanned, "COUNTS", (1500, 3000))
    path = tmp_path / "scans.npz"
    write_scanned(path, 2, what=replace(what, dense=50_000, surface=5000))
    with np.load(path) as archive:
        eyes = [archive[f"{what.name}{n:03d}/eye"] for n in (0, 1)]
    assert all(np.linalg.norm(eye) > 0.99 * what.distance[0] for eye in eyes)
    source = PatchSource.read(path)
    assert len(source.clouds) == 4
    for cloud, eye, surface in zip(source.clouds, source.eyes, source.surfaces, strict=True):
        assert eye is not None
        assert len(cloud) == pytest.approx(1500, rel=0.1) or len(cloud) == pytest.approx(3000, rel=0.1)
        assert len(surface.normals) == 5000
    assert source.draw(np.random.default_rng(0), 2).noisy.isfinite().all()
    torch.manual_seed(0)
    network = StraightPCF(width=128, distance_width=128).eval()
    write_passed(tmp_path / "passed.npz", Filter(network, threads=2, coverage=2), [path], 1)
    with np.load(tmp_path / "passed.npz") as recorded:
        assert any(name.startswith(f"scans/{what.name}") for name in recorded.files)


def test_noise_along_beams_is_along_them_and_of_the_usual_size() -> None:
    clean = np.random.default_rng(1).uniform(-1, 1, (2000, 3))
    beams = (clean - EYE) / np.linalg.norm(clean - EYE, axis=1, keepdims=True)
    along = 0
    for seed in range(100):
        noise = drawn_noise(np.random.default_rng(seed), clean, EYE)
        length = (noise * beams).sum(axis=1, keepdims=True)
        along += np.allclose(noise, length * beams)
        assert 0.3 < length.std() < 2
    assert along / 100 == pytest.approx(ALONG_BEAMS, abs=0.12)


@pytest.mark.parametrize("on_device", [False, True])
def test_patches_of_scans_have_noise_along_the_beams(*, on_device: bool) -> None:
    plane = np.random.default_rng(0).uniform(-1, 1, (20_000, 3)).astype(np.float32) * [1, 1, 0]
    far = np.array([0, 0, 1e4], dtype=np.float32)  # all beams are across the plane
    source = PatchSource([[plane], [plane]], eyes=[far, None])
    torch.manual_seed(0)
    device = torch.device("cpu")
    batch = DevicePatchSource(source, device).draw(96) if on_device else source.draw(np.random.default_rng(0), 96)
    noise = (batch.at(batch.time) - batch.drawn) / (NOISE_STD * (1 - batch.time))
    across = batch.normals[:, :1]
    flat = noise - (noise * across).sum(dim=2, keepdim=True) * across
    share = flat.square().sum(dim=(1, 2)) / noise.square().sum(dim=(1, 2))
    assert (share < 0.01).float().mean() == pytest.approx(ALONG_BEAMS / 2, abs=0.13)
    assert (share[share > 0.01] > 0.3).all()
