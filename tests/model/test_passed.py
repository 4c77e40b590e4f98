"""Training patches of clouds as later passes see them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from straightpcf.model.filter import Filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.normals import recompute_normals
from straightpcf.model.patches import PATCH_SIZE
from straightpcf.model.train import data as train_data
from straightpcf.model.train import record, train
from straightpcf.model.train.data import PASSED, PatchSource, held_out_shapes
from straightpcf.model.train.device_data import DevicePatchSource
from straightpcf.model.train.losses import across, precision
from straightpcf.model.train.passed import PassedClouds, training_patches
from straightpcf.model.train.record import write_passed
from straightpcf.points.errors import InvalidOptions
from tests.clouds import distance_to_torus


@pytest.fixture(scope="module")
def network() -> StraightPCF:
    torch.manual_seed(0)
    return StraightPCF(width=128, distance_width=128).eval()


@pytest.fixture(scope="module")
def passed(data: Path, network: StraightPCF, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("passed") / "passed.npz"
    write_passed(path, Filter(network, threads=2, coverage=2), [data], 4, seed=3)
    return path


def test_recorded_clouds_lie_about_their_shapes_and_none_is_held_out(passed: Path, data: Path) -> None:
    with np.load(passed) as file, np.load(data) as clean:
        names = [name.rpartition("/")[0] for name in file.files if name.endswith("/xyz")]
        assert len(names) >= 4
        held_out = held_out_shapes(clean.files)
        for name in names:
            archive, shape, _ = name.split("/")
            assert archive == data.stem
            assert shape not in held_out
            *centre, radius = file[f"{name}/frame"]
            places = file[f"{name}/xyz"] * radius + centre
            assert places.shape == (2000, 3)
            off = distance_to_torus(places) if int(shape[-2:]) % 2 else np.linalg.norm(places, axis=1) - 1
            assert np.abs(np.median(off)) < 0.1


def test_a_recording_that_was_interrupted_goes_on_to_the_same_clouds(
    passed: Path, data: Path, network: StraightPCF, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, begun = tmp_path / "passed.npz", record._recorded
    left = iter([1, 2])

    def interrupted(*arguments: object) -> dict[str, np.ndarray]:
        if next(left) == 2:
            raise KeyboardInterrupt
        return begun(*arguments)  # type: ignore[arg-type]

    denoiser = Filter(network, threads=2, coverage=2)
    monkeypatch.setattr(record, "_recorded", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_passed(path, denoiser, [data], 4, seed=3)
    assert not path.exists()
    kept = path.with_suffix(".part.npz")
    assert len(np.load(kept).files) > 1
    monkeypatch.setattr(record, "_recorded", begun)
    write_passed(path, denoiser, [data], 4, seed=3)
    with np.load(path) as ours, np.load(passed) as once:
        assert ours.files == once.files
        assert all(np.array_equal(ours[name], once[name]) for name in once.files)
    assert not kept.exists()


@pytest.mark.parametrize("on_device", [False, True])
def test_their_points_are_led_across_the_surface_only(
    passed: Path, data: Path, network: StraightPCF, *, on_device: bool
) -> None:
    source = training_patches([data], [passed], network.distance_module)
    torch.manual_seed(0)
    device = torch.device("cpu")
    rng = np.random.default_rng(0)
    draw = DevicePatchSource(source, device).draw if on_device else partial(source.draw, rng)
    assert draw(64).passed.mean().item() == pytest.approx(PASSED, abs=0.15)
    batch = draw(32)
    is_passed = batch.passed.flatten() > 0
    here = batch.at(batch.time)
    assert here.shape == (32, PATCH_SIZE, 3)
    assert (here.norm(dim=2).amin(dim=1) < 1e-4).all()  # the seed is in its patch, at the origin
    np.testing.assert_allclose(here[is_passed], batch.drawn[is_passed], atol=1e-4)
    to_go = batch.clean - here
    near = torch.cdist(here, batch.surface).argmin(dim=2)
    normal = batch.normals.gather(1, near[:, :, None].expand(-1, -1, 3))
    along = to_go - (to_go * normal).sum(dim=2, keepdim=True) * normal
    share = along.norm(dim=2).mean(dim=1) / to_go.norm(dim=2).mean(dim=1)
    assert (share[is_passed] < 1e-3).all()
    assert (share[~is_passed] > 0.1).all()


def test_the_time_of_their_patches_is_what_the_distance_module_says(passed: Path, data: Path) -> None:
    clouds = PassedClouds([passed], [data], lambda x: torch.full((len(x), 1), 0.3))  # type: ignore[arg-type]
    assert len(clouds) >= 4
    noisy, clean, time, here, *_ = clouds.patch(np.random.default_rng(0))
    assert time.item() == pytest.approx(0.7)
    np.testing.assert_allclose((1 - time) * noisy + time * clean, here, atol=1e-12)


def test_those_drawn_on_the_device_are_the_same_clouds_in_the_same_size(passed: Path, data: Path) -> None:
    source = training_patches([data], [passed], lambda x: torch.full((len(x), 1), 0.3))  # type: ignore[arg-type]
    torch.manual_seed(0)
    ours = DevicePatchSource(source, torch.device("cpu")).draw(64)
    is_passed = ours.passed.flatten() > 0
    assert is_passed.sum() == PASSED * 64
    torch.testing.assert_close(ours.time[is_passed], torch.full((16, 1, 1), 0.7))
    rng = np.random.default_rng(0)
    assert source.passed is not None
    host = [source.passed.patch(rng) for _ in range(64)]
    for part, measured in (("noisy", 0), ("clean", 1), ("drawn", 3), ("surface", 4)):
        of_ours = getattr(ours, part)[is_passed].norm(dim=2).mean()
        assert of_ours == pytest.approx(np.mean([np.linalg.norm(p[measured], axis=1).mean() for p in host]), rel=0.1)
    ways = [np.linalg.norm(patch[1] - patch[3], axis=1).mean() for patch in host]
    found = (ours.clean - ours.drawn)[is_passed].norm(dim=2).mean()
    assert found == pytest.approx(np.mean(ways), rel=0.15)


def test_errors_along_the_surface_hardly_count_there(data: Path) -> None:
    batch = PatchSource.read(data).draw(np.random.default_rng(1), 2)
    weight = precision(batch, PATCH_SIZE)
    batch = replace(batch, passed=torch.tensor([0.0, 1.0]).view(2, 1, 1))
    found = across(batch, batch.clean, weight.clone())
    assert torch.equal(found[0], weight[0])
    near = torch.cdist(batch.clean[1], batch.surface[1]).argmin(dim=1)
    normal = batch.normals[1][near]
    np.testing.assert_allclose(torch.einsum("pi,pij,pj->p", normal, found[1], normal), 1, atol=1e-4)
    np.testing.assert_allclose(torch.linalg.eigvalsh(found[1]), np.tile([0.02, 0.02, 1], (PATCH_SIZE, 1)), atol=1e-4)


@pytest.mark.usefixtures("few_to_validate_with")
def test_a_run_takes_them_and_its_team_too(passed: Path, data: Path, tmp_path: Path) -> None:
    first = train("vm", data=data, run_dir=tmp_path / "vm", iterations=1, batch_size=2, threads=1)
    wanted = {"data": data, "iterations": 2, "batch_size": 2, "threads": 1, "init": first}
    state = train("cvm", run_dir=tmp_path / "cvm", passed=[passed], processes=2, **wanted)  # type: ignore[arg-type]
    assert state.is_file()
    with pytest.raises(InvalidOptions, match="are for stage 'cvm'"):
        train("dm", run_dir=tmp_path / "dm", passed=[passed], **wanted)  # type: ignore[arg-type]


def test_the_normals_of_a_shape_are_computed_once(
    passed: Path, data: Path, network: StraightPCF, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def recompute(xyz: np.ndarray, old: np.ndarray) -> np.ndarray:
        asked.append(len(xyz))
        return recompute_normals(xyz, old)

    monkeypatch.setattr(train_data, "recompute_normals", recompute)
    source = training_patches([data], [passed], network.distance_module)
    assert len(asked) == len(source.clouds) == 10
    again = PassedClouds([passed], [data], network.distance_module)
    assert isinstance(source.passed, PassedClouds)
    for ours, theirs in zip(source.passed.clouds, again.clouds, strict=True):
        assert np.array_equal(ours.surface.xyz, theirs.surface.xyz)
        assert np.array_equal(ours.surface.normals, theirs.surface.normals)


def test_clouds_of_shapes_that_are_not_there_are_refused_by_name(passed: Path, data: Path, tmp_path: Path) -> None:
    (other := tmp_path / "other.npz").write_bytes(data.read_bytes())
    with pytest.raises(InvalidOptions, match=r"clouds of shapes\.npz"):
        PassedClouds([passed], [other], torch.nn.Identity())
    np.savez(other, **{"shape00/2000": np.zeros((2000, 3), np.float32)})
    (same := tmp_path / "shapes.npz").write_bytes(other.read_bytes())
    with pytest.raises(InvalidOptions, match="has no shape"):
        PassedClouds([passed], [same], torch.nn.Identity())
    np.savez(none := tmp_path / "none.npz")
    with pytest.raises(InvalidOptions, match="no cloud after a pass"):
        PassedClouds([none], [data], torch.nn.Identity())
