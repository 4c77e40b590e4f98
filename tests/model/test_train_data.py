"""The patches that training draws, and where its losses lead their points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.normalize import LARGEST_RADIUS
from straightpcf.model.patches import PATCH_SIZE
from straightpcf.model.train.data import (
    ALONG_BEAMS,
    EARLIEST,
    NOISE_STD,
    ONE_WAY,
    OTHER_NOISE,
    SCALES,
    TAILLESS,
    Batch,
    PatchSource,
    drawn_noise,
)
from straightpcf.model.train.device_data import DevicePatchSource, random_rotations
from straightpcf.model.train.losses import coupled_loss, distance_loss, precision
from straightpcf.model.turns import turns
from straightpcf.points.errors import InvalidCloud, MalformedFile, TooFewPoints
from tests.clouds import sphere


def drawn(source: PatchSource, count: int, *, on_device: bool) -> Batch:
    if not on_device:
        return source.draw(np.random.default_rng(0), count)
    torch.manual_seed(0)
    return DevicePatchSource(source, torch.device("cpu")).draw(count)


def batch_of(noisy: torch.Tensor, clean: torch.Tensor, time: torch.Tensor) -> Batch:
    """Make a batch of clean points (B, P, 3) that are their own surface, z upwards."""
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(clean)
    return Batch(noisy, clean, time, clean, clean, up, torch.zeros_like(time))


def test_training_shapes_and_validation_shapes_are_disjoint(data: Path) -> None:
    parts = [PatchSource.read(data, validation=v) for v in (False, True)]
    clouds = [{cloud.tobytes() for cloud in part.clouds} for part in parts]
    assert len(clouds[0]) + len(clouds[1]) == 11
    assert not clouds[0] & clouds[1]
    assert clouds[1]


def test_a_batch_is_noisy_clean_pairs_around_its_seeds(data: Path) -> None:
    batch = PatchSource.read(data).draw(np.random.default_rng(0), 4)
    assert batch.noisy.shape == batch.clean.shape == (4, PATCH_SIZE, 3)
    std = (batch.noisy - batch.clean).std(dim=(1, 2))
    assert ((std > 0.015) & (std < 0.025)).all()  # 0.02, scaled by 0.8 to 1.2
    assert (batch.at(batch.time).norm(dim=2).amin(dim=1) < 1e-5).all()  # the seed is in its patch, at the origin


def test_patches_drawn_on_the_device_are_like_those_drawn_on_the_host(data: Path) -> None:
    torch.manual_seed(0)
    source = PatchSource.read(data)
    ours = DevicePatchSource(source, torch.device("cpu")).draw(16)
    host = source.draw(np.random.default_rng(0), 16)
    assert ours.noisy.shape == host.noisy.shape
    assert (ours.at(ours.time).norm(dim=2).amin(dim=1) < 1e-5).all()
    std = (ours.noisy - ours.clean).std(dim=(1, 2))
    assert ((std > 0.015) & (std < 0.025)).all()
    radii = [batch.clean.norm(dim=2).amax(dim=1).mean() for batch in (ours, host)]
    assert 0.8 < radii[0] / radii[1] < 1.25


@pytest.mark.parametrize("on_device", [False, True])
def test_the_rim_of_a_patch_does_not_tell_the_time(*, on_device: bool) -> None:
    # A patch of a plane cut at x_t is a disc: 0.81 of its points lie within 0.9 of its radius, however late t is.
    plane = np.random.default_rng(0).uniform(-1, 1, (20_000, 3)).astype(np.float32) * [1, 1, 0]
    source = PatchSource([[plane]])
    batch = drawn(source, 64, on_device=on_device)
    reach = batch.at(batch.time).norm(dim=2)
    within = (reach < 0.9 * reach.amax(dim=1, keepdim=True)).float().mean(dim=1)
    late = batch.time.flatten() > 0.7
    assert within[late].mean() == pytest.approx(0.81, abs=0.02)


@pytest.mark.parametrize("on_device", [False, True])
def test_paths_are_taken_up_before_their_start_too(*, on_device: bool) -> None:
    source = PatchSource([[sphere(20_000).astype(np.float32)]])
    batch = drawn(source, 64, on_device=on_device)
    assert EARLIEST <= batch.time.min() < 0.7 * EARLIEST
    assert 0.9 < batch.time.max() < 1
    noise = (batch.at(batch.time) - batch.clean).std(dim=(1, 2)) / (1 - batch.time.flatten())
    assert ((noise > 0.015) & (noise < 0.025)).all()


@pytest.mark.parametrize("on_device", [False, True])
def test_a_third_of_the_patches_has_noise_of_other_shapes_and_the_same_size(*, on_device: bool) -> None:
    # Points of a plane are nearest to their feet, so across it y - x_t is the noise itself.
    plane = np.random.default_rng(0).uniform(-1, 1, (20_000, 3)).astype(np.float32) * [1, 1, 0]
    batch = drawn(PatchSource([[plane]]), 256, on_device=on_device)
    noise = (batch.at(batch.time) - batch.clean) / (NOISE_STD * (1 - batch.time))
    assert noise.square().mean() == pytest.approx(1, abs=0.05)
    stds = noise.std(dim=1)
    unequal = stds.amax(dim=1) / stds.amin(dim=1) > 1.25
    assert 0.03 < unequal.float().mean() < 0.25
    one_way = torch.linalg.svdvals(noise)[:, 1] < 1e-2 * noise.shape[1] ** 0.5
    assert OTHER_NOISE * ONE_WAY / 3 < one_way.float().mean() < OTHER_NOISE * ONE_WAY * 2
    length = (noise / stds[:, None]).square().sum(dim=2)  # of mean 3, and for Gaussian noise of variance 6
    heavy = length.var(dim=1) > 9
    assert 0.08 < heavy.float().mean() < 0.3
    tailless = length.var(dim=1) < 4.5  # in a ball 1.7, with unequal axes somewhat more
    assert OTHER_NOISE * TAILLESS / 3 < tailless.float().mean() < OTHER_NOISE * TAILLESS * 2


@pytest.mark.parametrize("on_device", [False, True])
def test_half_of_the_patches_are_in_the_sizes_of_a_first_pass(*, on_device: bool) -> None:
    # Of this plane 1000 points lie within 0.18 radii of it; a first pass shows that up to 2.5 times larger.
    plane = np.random.default_rng(0).uniform(-1, 1, (20_000, 3)).astype(np.float32) * [1, 1, 0]
    batch = drawn(PatchSource([[plane]]), 64, on_device=on_device)
    here, time = batch.at(batch.time), batch.time.flatten()
    noise = (here - batch.clean).std(dim=(1, 2))
    assert ((noise - NOISE_STD * (1 - time)).abs() < 0.2 * noise).all()  # whatever the size
    larger = here.norm(dim=2).quantile(0.9, dim=1) / 0.18
    assert 0.1 < (larger > 1.4).float().mean() < 0.5
    assert 0.15 < (time < 0).float().mean() < 0.5  # first passes alone have more than NOISE_STD


@pytest.mark.parametrize("on_device", [False, True])
def test_patches_of_few_points_are_shown_no_larger_than_the_filter_shows_them(*, on_device: bool) -> None:
    # 1000 of these 1500 points reach around most of the sphere, up to 1.63 radii from the seed.
    few, many = sphere(1500).astype(np.float32), sphere(20_000).astype(np.float32)
    batch = drawn(PatchSource([[few]]), 64, on_device=on_device)
    reach = batch.clean.norm(dim=2).amax(dim=1)
    assert (reach < 1.1 * LARGEST_RADIUS * SCALES[1]).all()
    assert (reach > 0.9 * LARGEST_RADIUS * SCALES[0]).all()
    beside = drawn(PatchSource([[few], [many]]), 64, on_device=on_device)
    assert torch.isfinite(beside.at(beside.time)).all()


def test_one_pass_is_asked_to_go_no_farther_than_it_can() -> None:
    network = StraightPCF(couplings=2).eval()
    clean = 0.1 * torch.randn(2, 100, 3)
    batch = batch_of(clean + NOISE_STD * torch.randn_like(clean), clean, torch.tensor([-0.5, -0.2]).view(2, 1, 1))

    class Straight(torch.nn.Module):
        def forward(self, x: torch.Tensor, rows: int | None = None) -> torch.Tensor:
            return (batch.clean - batch.noisy)[: len(x), :rows]

    class AllTheWay(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return torch.ones(len(x), 1)

    network.velocity_modules = torch.nn.ModuleList([Straight(), Straight()])
    network.distance_module = AllTheWay()  # type: ignore[assignment]
    assert distance_loss(network, batch, 50).item() == pytest.approx(0, abs=1e-6)


def test_noisy_points_are_led_to_the_surface_and_not_beneath_it() -> None:
    noise, rng = 0.02, np.random.default_rng(0)
    ball = sphere(20_000, 0)
    clean = ball[np.linalg.norm(ball - ball[0], axis=1).argsort()[:PATCH_SIZE]]
    here = clean + noise * rng.standard_normal(clean.shape)
    source = PatchSource([[ball.astype(np.float32)]])
    out = here / np.linalg.norm(here, axis=1, keepdims=True)
    chosen = source.surfaces[0].touching(here, clean)
    assert (((chosen - clean) ** 2).sum(axis=1) > 0).any()
    beneath = 1 - (clean * out).sum(axis=1)
    assert beneath.mean() == pytest.approx(noise**2, rel=0.1)  # H s^2
    assert abs((1 - (chosen * out).sum(axis=1)).mean()) < 0.1 * noise**2
    wide = [torch.from_numpy(part).float()[None] for part in (clean, here, *source.surfaces[0].around(ball[0], 0.3))]
    batch = Batch(wide[1], wide[0], torch.zeros(1, 1, 1), wide[0], wide[2], wide[3], torch.zeros(1, 1, 1))
    assert np.abs(batch.touching(wide[1])[0].numpy() - chosen).max() < 1e-5


@pytest.mark.parametrize("on_device", [False, True])
def test_the_surface_in_a_batch_is_that_of_its_points(*, on_device: bool) -> None:
    # Clouds of different size, whose finest have fewer points than a batch holds and more.
    shapes = [[sphere(3000, 0).astype(np.float32)], [sphere(n, n).astype(np.float32) for n in (5000, 9000)]]
    batch = drawn(PatchSource(shapes), 8, on_device=on_device)
    assert all(torch.isfinite(tensor).all() for tensor in (batch.noisy, batch.clean, batch.surface, batch.normals))
    torch.testing.assert_close(batch.normals.norm(dim=2), torch.ones(8, batch.normals.shape[1]), atol=1e-4, rtol=0)
    apart = torch.cdist(batch.drawn, batch.surface).amin(dim=2)
    spacing = 2 * batch.surface.norm(dim=2).amax(dim=1) / 1000**0.5
    assert (apart.amax(dim=1) < 2 * spacing).all()
    early = batch.time.flatten() < 0.5
    heights = (batch.clean - batch.touching(batch.at(batch.time))).norm(dim=2)[early]
    assert heights.quantile(0.9) < 1e-4  # the same planes, but at the patch's rim


def test_points_between_two_walls_are_led_to_the_one_that_they_are_brought_near() -> None:
    side = torch.linspace(-0.2, 0.2, 33)
    lower, upper = (torch.cartesian_prod(side, side, torch.tensor([z]))[None] for z in (-0.03, 0.03))
    walls, up = torch.cat([lower, upper], dim=1), torch.tensor([0.0, 0.0, 1.0])
    drawn = upper[:, ::2]  # all are of the upper wall, and lie above it
    batch = Batch(
        drawn + 0.01 * up, drawn, torch.zeros(1, 1, 1), drawn, walls, up.expand_as(walls), torch.zeros(1, 1, 1)
    )

    class Along(torch.nn.Module):
        """Brings every point to the same height."""

        def __init__(self, height: float) -> None:
            super().__init__()
            self.height = torch.nn.Parameter(torch.tensor(height))

        def forward(self, x: torch.Tensor, rows: int | None = None) -> torch.Tensor:
            return ((self.height - 0.04) * up).expand(1, x.shape[1], 3)[:, :rows] @ turns(1)

    def slope(height: float) -> float:
        network = StraightPCF(couplings=1)
        network.velocity_modules = torch.nn.ModuleList([module := Along(height)])
        coupled_loss(network, batch, drawn.shape[1]).backward()  # type: ignore[no-untyped-call]
        assert module.height.grad is not None
        return module.height.grad.item()

    assert slope(0.01) < 0 < slope(-0.01)  # up from there to the upper wall, down from here to the lower one
    assert max(abs(slope(0.03)), abs(slope(-0.03))) < 1e-3 * slope(-0.01)


@pytest.mark.parametrize("on_device", [False, True])
def test_most_points_of_the_loss_are_near_the_seed(data: Path, *, on_device: bool) -> None:
    source = PatchSource.read(data)
    batch = drawn(source, 16, on_device=on_device)
    rank = batch.at(batch.time).norm(dim=2).argsort(dim=1).argsort(dim=1)
    assert (rank[:, :256] < PATCH_SIZE // 2).float().mean() == pytest.approx(0.88, abs=0.03)
    assert (rank[:, :256] >= PATCH_SIZE // 2).any()


@pytest.mark.parametrize(("time", "along"), [(0.0, 1 / 2), (0.5, 1 / 2), (0.95, 1.0)])
def test_errors_along_a_surface_count_only_where_the_noise_leaves_them_knowable(time: float, along: float) -> None:
    # A plane of points 0.0125 apart: noise of 0.02 and 0.01 blurs them, of 0.001 does not.
    side = torch.linspace(-0.2, 0.2, 33)
    plane = torch.cartesian_prod(side, side, torch.zeros(1))[None]
    torch.manual_seed(0)
    noisy = plane + NOISE_STD * torch.randn_like(plane)
    inner = (plane.abs() < 0.12).all(dim=2)[0]
    weight = precision(batch_of(noisy, plane, torch.full((1, 1, 1), time)), plane.shape[1])[0, inner]
    torch.testing.assert_close(weight, weight.mT)
    across, others = weight[:, 2, 2], weight[:, :2, :2].diagonal(dim1=1, dim2=2)
    assert across.mean() == pytest.approx(1, abs=0.02)
    assert others.mean() == pytest.approx(along, rel=0.15)


def test_random_rotations_are_rotations() -> None:
    turn = random_rotations(50, torch.device("cpu"))
    torch.testing.assert_close(turn @ turn.mT, torch.eye(3).expand(50, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(50))


ARCHIVES: dict[str, tuple[dict[str, Any], type[InvalidCloud], str]] = {
    "no slash": ({"a": sphere(PATCH_SIZE)}, MalformedFile, "'a'; it must be <shape>/<resolution>"),
    "two slashes": ({"a/b/c": sphere(PATCH_SIZE)}, MalformedFile, "'a/b/c'; it must be"),
    "few points": ({"a/1": sphere(PATCH_SIZE - 1)}, TooFewPoints, "a/1 has 999 points; a training patch has 1000"),
    "two columns": ({"a/1": sphere(PATCH_SIZE)[:, :2]}, MalformedFile, r"a/1 is float64 \(1000, 2\)"),
    "whole numbers": ({"a/1": np.ones((PATCH_SIZE, 3), int)}, MalformedFile, "a/1 is int64"),
    "NaN": ({"a/1": np.full((PATCH_SIZE, 3), np.nan)}, MalformedFile, "a/1 holds NaN or infinity"),
    "one place": ({"a/1": np.ones((PATCH_SIZE, 3))}, MalformedFile, "a/1 is 0 wide"),
    "no float32": ({"a/1": 1e200 * sphere(PATCH_SIZE)}, MalformedFile, r"a/1 is .*e\+200 wide"),
    "objects": ({"a/1": np.array([None] * 3)}, MalformedFile, "cannot be read as NPZ"),
    "a surface of a point": (
        {"a/1": sphere(PATCH_SIZE), "a/surface": sphere(1)},
        TooFewPoints,
        "a/surface has 1 points",
    ),
    "a surface in one place": (
        {"a/1": sphere(PATCH_SIZE), "a/surface": np.ones((PATCH_SIZE, 3))},
        MalformedFile,
        "a/surface is 0 wide",
    ),
    "long normals": (
        {"a/1": sphere(PATCH_SIZE), "a/normals": 2 * sphere(PATCH_SIZE)},
        MalformedFile,
        "a/normals has 1000 of a length like 2; it must be 1",
    ),
    "a place of beams": ({"a/eye": np.zeros((2, 3))}, MalformedFile, r"a/eye is float64 \(2, 3\); it must be \(3,\)"),
    "normals of others": (
        {"a/1": sphere(PATCH_SIZE), "a/normals": sphere(7)},
        MalformedFile,
        "a/normals has 7 rows for 1000 points",
    ),
}


@pytest.mark.parametrize("case", ARCHIVES)
def test_an_archive_that_cannot_be_trained_on_is_refused_by_file_and_name(case: str, tmp_path: Path) -> None:
    arrays, error, message = ARCHIVES[case]
    np.savez(path := tmp_path / "shapes.npz", **arrays)
    with pytest.raises(error, match=f"shapes.npz.*{message}"):
        PatchSource.read(path)


def test_a_point_where_the_beams_came_from_has_no_noise_along_them() -> None:
    # Scanners write "nothing was met" so, and a draw that was not finite ended a run after hours.
    clean = np.concatenate([sphere(9), np.zeros((1, 3))])
    rng = np.random.default_rng(0)
    noises = [drawn_noise(rng, clean, np.zeros(3)) for _ in range(20)]
    assert np.isfinite(noises).all()
    along = [noise for noise in noises if not noise[-1].any()]
    assert len(along) == pytest.approx(20 * ALONG_BEAMS, abs=5)
    np.testing.assert_allclose(np.cross(along[0], clean), 0, atol=1e-12)


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", sphere(PATCH_SIZE))
    (tmp_path / "a.npz").write_text("1 2 3")
    np.savez(tmp_path / "cut.npz", **{"a/1": sphere(PATCH_SIZE)})
    whole = bytearray((tmp_path / "cut.npz").read_bytes())
    whole[1000] ^= 1
    (tmp_path / "cut.npz").write_bytes(whole)
    for name in ("a.npy", "a.npz", "cut.npz"):
        with pytest.raises(MalformedFile, match=f"{name}.*NPZ"):
            PatchSource.read(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        PatchSource.read(tmp_path / "none.npz")
