"""Open sheets made in code lie on their surfaces, evenly, within their edges, with normals across them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.model.train import solids
from straightpcf.model.train.data import PatchSource
from straightpcf.model.train.open_sheets import OPEN_SHEETS, OpenSheet
from straightpcf.model.train.solids import KINDS, write_solids

Floats = npt.NDArray[np.float64]


def _all(at: Floats) -> npt.NDArray[np.bool_]:
    return np.ones(len(at), bool)


def _ball(at: Floats) -> Floats:
    angle, latitude = np.pi * at[:, 0], np.pi / 2 * at[:, 1]
    reach = np.cos(latitude)
    return np.column_stack([reach * np.cos(angle), reach * np.sin(angle), np.sin(latitude)])


@pytest.mark.parametrize("family", OPEN_SHEETS)
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_points_lie_on_a_sheet_and_normals_across_it(family: object, seed: int) -> None:
    assert callable(family)
    sheet = family(np.random.default_rng(seed))
    xyz, normals = sheet.sample(np.random.default_rng(seed), 4000)
    assert xyz.shape == normals.shape == (4000, 3)
    assert np.isfinite(xyz).all()
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    # Of their own nearest, tightly sampled, the direction with least spread.
    many, _ = sheet.sample(np.random.default_rng(seed + 10), 100_000)
    some = xyz[:200]
    nearest = np.array([many[np.argsort(np.square(many - point).sum(axis=1))[:12]] for point in some])
    local = nearest - nearest.mean(axis=1, keepdims=True)
    across = np.linalg.svd(local)[2][:, 2]
    # All but points at a sharp fold.
    assert np.quantile(np.abs((across * normals[:200]).sum(axis=1)), 0.1) > 0.97


def test_points_are_spread_by_area_and_normals_are_exact() -> None:
    xyz, normals = OpenSheet(_ball, _all).sample(np.random.default_rng(0), 40_000)
    assert np.linalg.norm(xyz, axis=1) == pytest.approx(1)
    assert np.abs((xyz * normals).sum(axis=1)) == pytest.approx(1, abs=1e-8)
    # Of a sphere every slice of one height has the same area.
    shares = np.histogram(xyz[:, 2], bins=8, range=(-1, 1))[0] / len(xyz)
    assert shares == pytest.approx(np.full(8, 1 / 8), abs=0.01)


def test_no_point_lies_beyond_the_edge() -> None:
    half = OpenSheet(_ball, lambda at: at[:, 1] > 0)
    assert (half.sample(np.random.default_rng(0), 5000)[0][:, 2] > 0).all()


def test_an_archive_of_open_sheets_is_training_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solids, "RESOLUTIONS", (1500, 3000))
    write_solids(tmp_path / "open.npz", 2, kind="open")
    assert [len(cloud) for cloud in PatchSource.read(tmp_path / "open.npz").clouds] == [1500, 3000] * 2
    assert not set(KINDS["open"]) & {*KINDS["solid"], *KINDS["casing"], *KINDS["unseen"]}
