"""Training clouds made in code lie on the surfaces of solids, evenly, with normals that point outwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from straightpcf.model.train import solids
from straightpcf.model.train.data import PatchSource
from straightpcf.model.train.primitives import Box, Cylinder, Ellipsoid, Solid
from straightpcf.model.train.solids import FAMILIES, write_solids


@pytest.mark.parametrize("family", range(len(FAMILIES)))
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_step_along_the_normal_leaves_the_solid_and_one_against_it_enters(family: int, seed: int) -> None:
    rng = np.random.default_rng([family, seed])
    solid = FAMILIES[family](rng)
    xyz, normals = solid.sample(rng, 5000)
    assert len(xyz) == pytest.approx(5000, rel=0.1)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    # All but points at an edge, where a step of any size may meet the next face.
    assert (~solid.contains(xyz + 1e-5 * normals)).mean() > 0.998
    assert solid.contains(xyz - 1e-5 * normals).mean() > 0.998


def test_points_are_spread_by_area() -> None:
    rng = np.random.default_rng(0)
    xyz, normals = Solid([Box(half=np.array([1.0, 0.5, 0.25]))], [Cylinder(radius=0.2, half=1.0)]).sample(rng, 40_000)
    areas = {
        "top": 2 * (2 * 1 - np.pi * 0.04),
        "long": 2 * 2 * 0.5,
        "short": 2 * 1 * 0.5,
        "bore": 2 * np.pi * 0.2 * 0.5,
    }
    bore = np.hypot(xyz[:, 0], xyz[:, 1]) < 0.2 + 1e-9
    found = {
        "top": (np.abs(normals[:, 2]) > 0.5).mean(),
        "long": ((np.abs(normals[:, 1]) > 0.5) & ~bore).mean(),
        "short": ((np.abs(normals[:, 0]) > 0.5) & ~bore).mean(),
        "bore": bore.mean(),
    }
    total = sum(areas.values())
    assert found == pytest.approx({face: area / total for face, area in areas.items()}, abs=0.01)
    flat, _ = Solid([Ellipsoid(half=np.array([1.0, 1.0, 0.1]))]).sample(rng, 40_000)
    # Of a flat spheroid's area, what lies within half its radius is nearly that of two discs.
    inner = np.hypot(flat[:, 0], flat[:, 1]) < 0.5
    area = 2 * np.pi + np.pi * 0.01 / np.sqrt(0.99) * np.log((1 + np.sqrt(0.99)) / (1 - np.sqrt(0.99)))
    assert inner.mean() == pytest.approx(2 * np.pi * 0.25 * 1.001 / area, rel=0.02)


def test_an_archive_of_solids_is_training_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solids, "RESOLUTIONS", (2000, 5000))
    write_solids(tmp_path / "a.npz", 2)
    write_solids(tmp_path / "b.npz", 1, seed=1)
    source = PatchSource.read(tmp_path / "a.npz", tmp_path / "b.npz")
    assert [len(cloud) for cloud in source.clouds] == [2000, 5000] * 3
    for cloud, surface in zip(source.clouds, source.surfaces, strict=True):
        assert np.linalg.norm(cloud, axis=1).max() == pytest.approx(1)
        assert len(surface.normals) == 5000
        # The archive's normals, and not planes through neighbours: across an edge those are neither face's.
        spacing = cKDTree(cloud).query(cloud, k=2)[0][:, 1]
        assert spacing.std() < 0.2 * spacing.mean()
    twice = PatchSource.read(tmp_path / "a.npz", tmp_path / "a.npz", tmp_path / "b.npz")
    assert len(twice.clouds) == 10  # a file given twice weighs twice
    with np.load(tmp_path / "a.npz") as archive:
        assert np.array_equal(source.surfaces[0].normals, archive["solid000/normals"].astype(np.float64))


def test_coarse_solids_are_drawn_from_and_the_finest_is_their_surface(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solids, "RESOLUTIONS", (2000, 5000))
    write_solids(tmp_path / "all.npz", 1)
    write_solids(tmp_path / "coarse.npz", 1, resolutions=[2000])
    whole, coarse = (PatchSource.read(tmp_path / name) for name in ("all.npz", "coarse.npz"))
    assert [len(cloud) for cloud in coarse.clouds] == [2000]
    np.testing.assert_array_equal(coarse.clouds[0], whole.clouds[0])
    np.testing.assert_array_equal(coarse.surfaces[0].normals, whole.surfaces[0].normals)
    np.testing.assert_array_equal(coarse.surfaces[0].xyz, whole.surfaces[0].xyz)
    with pytest.raises(ValueError, match="resolutions are 2000, 5000, not 3000"):
        write_solids(tmp_path / "none.npz", 1, resolutions=[3000])
    with pytest.raises(ValueError, match="kinds are solid, casing, open, unseen, not cube"):
        write_solids(tmp_path / "none.npz", 1, kind="cube")


def test_the_same_seed_gives_the_same_solids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solids, "RESOLUTIONS", (500,))
    for name in ("once", "again"):
        write_solids(tmp_path / f"{name}.npz", 1, seed=3)
    with np.load(tmp_path / "once.npz") as once, np.load(tmp_path / "again.npz") as again:
        assert once.files == again.files
        assert all(np.array_equal(once[name], again[name]) for name in once.files)
