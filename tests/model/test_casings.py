"""Thin walls that bend are sampled on their surface, evenly, with the normals of that surface."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from straightpcf.model.train import solids
from straightpcf.model.train.casings import CASINGS, UNSEEN, Casing
from straightpcf.model.train.data import PatchSource
from straightpcf.model.train.fields import (
    Field,
    ball,
    block,
    intersection,
    less,
    moved,
    plane,
    post,
    shell,
    torus,
    union,
    widened,
)
from straightpcf.model.train.solids import KINDS, write_solids
from tests.model.numeric import numeric_gradient

UP = np.array([0.0, 0.0, 1.0])
TURN = np.asarray(Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix())
FIELDS: dict[str, Field] = {
    "plane": plane(UP, 0.1),
    "block": block(np.array([0.8, 0.5, 0.3]), 0.1),
    "post": post(0.5, 0.7, 0.1),
    "torus": torus(0.7, 0.2),
    "moved": moved(block(np.array([0.8, 0.5, 0.3]), 0.1), np.array([0.1, 0.2, -0.3]), TURN),
    "shell": shell(post(0.5, 0.7, 0.1), 0.1),
    "union": union(0.05, torus(0.7, 0.2), post(0.5, 0.7, 0.1)),
    "less": less(0.05, block(np.array([0.8, 0.5, 0.3]), 0.1), post(0.2, 1.0, 0.0)),
    "intersection": intersection(0.05, widened(torus(0.7, 0.2), 0.05), plane(UP, 0.1)),
}


@pytest.mark.parametrize("name", FIELDS)
def test_a_fields_gradient_is_that_of_its_value_and_no_steeper_than_1(name: str) -> None:
    field = FIELDS[name]
    xyz = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    gradient = field(xyz)[1]
    numeric = numeric_gradient(lambda points: field(points)[0], xyz)
    assert (np.linalg.norm(gradient - numeric, axis=1) < 1e-4).mean() > 0.98  # all but a few at creases
    assert np.linalg.norm(gradient, axis=1).max() < 1 + 1e-9


def test_a_shell_is_as_thick_as_it_says() -> None:
    xyz, normals = Casing(shell(ball(0.7), 0.1), np.full(3, 1.0)).sample(np.random.default_rng(0), 20_000)
    reach = np.linalg.norm(xyz, axis=1)
    outer = reach > 0.7
    assert reach[outer] == pytest.approx(0.75, abs=1e-6)
    assert reach[~outer] == pytest.approx(0.65, abs=1e-6)
    assert np.abs(normals[outer] - xyz[outer] / 0.75).max() < 1e-5
    assert outer.mean() == pytest.approx(0.75**2 / (0.75**2 + 0.65**2), abs=0.02)
    # Archimedes: every slab of the same height has the same area.
    counts = np.histogram(xyz[outer, 2], bins=10, range=(-0.75, 0.75))[0]
    assert counts == pytest.approx(outer.sum() / 10, abs=5 * np.sqrt(outer.sum() / 10))


@pytest.mark.parametrize("family", [*CASINGS, *UNSEEN])
def test_a_step_along_the_normal_leaves_the_body_and_one_against_it_enters(
    family: Callable[[np.random.Generator], Casing],
) -> None:
    rng = np.random.default_rng(1)
    body = family(rng)
    xyz, normals = body.sample(rng, 1000)
    assert np.abs(body.value(xyz)[0]).max() < 1e-8
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    assert (~body.contains(xyz + 1e-4 * normals)).mean() > 0.995
    assert body.contains(xyz - 1e-4 * normals).mean() > 0.995
    low, high = body.box()
    assert (xyz > low).all()
    assert (xyz < high).all()


def test_an_archive_has_the_kind_that_was_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solids, "RESOLUTIONS", (500, 1500))
    write_solids(tmp_path / "scrolls.npz", 2, kind="unseen")
    with np.load(tmp_path / "scrolls.npz") as archive:
        assert set(archive.files) == {f"unseen{n:03d}/{what}" for n in (0, 1) for what in (500, 1500, "normals")}
    write_solids(tmp_path / "casings.npz", 1, kind="casing", resolutions=[1500])
    assert [len(cloud) for cloud in PatchSource.read(tmp_path / "casings.npz").clouds] == [1500]


def test_what_weights_are_judged_by_is_not_trained_on() -> None:
    assert not set(KINDS["unseen"]) & {*KINDS["solid"], *KINDS["casing"]}
