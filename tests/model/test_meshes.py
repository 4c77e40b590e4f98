"""Training clouds of meshes in files lie on their triangles, evenly; what is no single closed body is left out."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from straightpcf.model.train import meshes, solids
from straightpcf.model.train.data import PatchSource
from straightpcf.model.train.meshes import SUFFIXES, write_meshes
from straightpcf.points.errors import InvalidOptions, MalformedFile, MissingDependency


@pytest.fixture(autouse=True)
def _few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solids, "RESOLUTIONS", (1000, 3000))


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".STL"])
def test_points_lie_evenly_on_the_triangles_of_a_file(tmp_path: Path, suffix: str) -> None:
    box = trimesh.creation.box((2.0, 1.0, 0.5))
    box.apply_translation((100.0, 0.0, 0.0))  # as a part lies in its machine
    box.export(file := tmp_path / f"box{suffix}", file_type=suffix[1:].lower())
    left_out = write_meshes(path := tmp_path / "meshes.npz", [file])
    assert not left_out
    source = PatchSource.read(path)
    assert [len(cloud) for cloud in source.clouds] == [1000, 3000]
    half, radius = np.array([1.0, 0.5, 0.25]), np.sqrt(1 + 0.25 + 0.0625)
    with np.load(path) as archive:
        xyz, normals = archive["box/3000"], archive["box/normals"]
    assert np.linalg.norm(xyz, axis=1).max() == pytest.approx(1, abs=0.01)
    off = np.abs(np.abs(xyz) * radius - half)
    face = np.abs(normals).argmax(axis=1)
    assert np.take_along_axis(off, face[:, None], axis=1).max() < 0.02  # the frame is that of the points
    assert (np.sign(xyz[np.arange(3000), face]) == np.sign(normals[np.arange(3000), face])).all()
    spacing = cKDTree(xyz).query(xyz, k=2)[0][:, 1]
    assert spacing.std() < 0.2 * spacing.mean()


def test_what_is_no_single_closed_body_is_left_out_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.export(tmp_path / "ball.stl")
    trimesh.Trimesh(ball.vertices, ball.faces[:-1]).export(tmp_path / "open.stl")
    far = trimesh.creation.box()
    far.apply_translation((3.0, 0.0, 0.0))
    trimesh.util.concatenate([ball, far]).export(tmp_path / "two.stl")
    files = [tmp_path / f"{name}.stl" for name in ("open", "ball", "two")]
    monkeypatch.setattr(sys, "argv", ["meshes", str(tmp_path / "meshes.npz"), *map(str, files)])
    meshes._main()
    assert capsys.readouterr().out.splitlines() == [
        f"left out {files[0]}: its surface is not closed",
        f"left out {files[2]}: it is 2 bodies",
    ]
    with np.load(tmp_path / "meshes.npz") as archive:
        assert sorted(archive.files) == ["ball/1000", "ball/3000", "ball/normals"]
    with pytest.raises(InvalidOptions, match=r"single closed body: .*open\.stl: its surface is not closed; .*two\.stl"):
        write_meshes(tmp_path / "none.npz", [files[0], files[2]])
    assert not (tmp_path / "none.npz").exists()


def test_files_that_cannot_be_taken_are_named(tmp_path: Path) -> None:
    def said(error: type[Exception], *names: str) -> str:
        with pytest.raises(error) as raised:
            write_meshes(tmp_path / "out.npz", [tmp_path / name for name in names])
        return str(raised.value)

    assert "part.step is no mesh that is read here: .obj, .off, .ply, .stl" in said(InvalidOptions, "part.step")
    same = said(InvalidOptions, "a/link.stl", "b/link.obj")
    assert same.endswith(f"{tmp_path / 'b/link.obj'} would both be the shape link")
    assert "none.stl" in said(FileNotFoundError, "none.stl")
    for suffix in SUFFIXES:
        (tmp_path / f"bad{suffix}").write_bytes(b"no mesh at all\n" * 20)
        assert f"bad{suffix}" in said(MalformedFile, f"bad{suffix}")
        (tmp_path / f"empty{suffix}").touch()
        assert f"empty{suffix}" in said(MalformedFile, f"empty{suffix}")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False).export(tmp_path / "line.ply")
    assert "holds no triangles with an area" in said(MalformedFile, "line.ply")


def test_without_trimesh_the_extra_that_has_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)  # what an import finds where there is none
    with pytest.raises(MissingDependency, match=r"straightpcf\[train\]"):
        write_meshes(tmp_path / "out.npz", [tmp_path / "ball.stl"])
