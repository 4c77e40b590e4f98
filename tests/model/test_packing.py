"""Training clouds packed for where little may be carried."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from straightpcf.model.train.data import PatchSource
from straightpcf.model.train.packing import unpack_archives, write_packed
from straightpcf.points.errors import InvalidOptions, MalformedFile
from tests.clouds import sphere, torus

_STEP = 1 / 8190  # of the longest side


@pytest.fixture
def clean(tmp_path: Path) -> Path:
    arrays = {f"s{n}/{count}": 3 * torus(count) + n for n in range(6) for count in (1000, 3000)}
    arrays["s0/surface"] = sphere(5000)
    arrays["s0/normals"] = arrays["s0/surface"] / np.linalg.norm(arrays["s0/surface"], axis=1, keepdims=True)
    arrays["s1/eye"] = np.array([0.1, -7.0, 3.0])
    np.savez(path := tmp_path / "clean.npz", **{name: a.astype(np.float32) for name, a in arrays.items()})  # type: ignore[arg-type]
    return path


def test_clouds_come_back_within_half_a_step(clean: Path, tmp_path: Path) -> None:
    frame = np.array([0.25, 0.5, 0.75, 2.0])
    recorded = {"clean/s0/0/xyz": torus(2000).astype(np.float32), "clean/s0/0/frame": frame}
    np.savez(tmp_path / "passed.npz", **recorded)  # type: ignore[arg-type]
    write_packed(packed := tmp_path / "carried.npz", [clean, tmp_path / "passed.npz"])
    paths = unpack_archives(packed, tmp_path / "there")
    assert paths == [tmp_path / "there" / "clean.npz", tmp_path / "there" / "passed.npz"]
    for path in paths:
        with np.load(path) as found, np.load(tmp_path / path.name) as given:
            assert {*found.files} == {*given.files}
            for name in given.files:
                what = name.rpartition("/")[2]
                if what in ("eye", "frame"):
                    np.testing.assert_array_equal(found[name], given[name])
                elif what != "normals":
                    assert len(found[name]) == len(given[name])
                    off, nearest = cKDTree(given[name]).query(found[name])
                    assert off.max() < np.sqrt(3) / 2 * 1.01 * _STEP * np.ptp(given[name], axis=0).max(), name
                    assert len(np.unique(nearest)) > 0.99 * len(nearest)


def test_normals_stay_those_of_their_points(clean: Path, tmp_path: Path) -> None:
    write_packed(packed := tmp_path / "carried.npz", [clean])
    (path,) = unpack_archives(packed, tmp_path / "there")
    with np.load(path) as found:
        points, normals = found["s0/surface"], found["s0/normals"]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.degrees(np.arccos((outward * normals).sum(axis=1).clip(-1, 1))).max() < 1.0


def test_what_is_unpacked_is_trained_on(clean: Path, tmp_path: Path) -> None:
    write_packed(packed := tmp_path / "carried.npz", [clean], without=[1000])
    (path,) = unpack_archives(packed, tmp_path / "there")
    clouds = PatchSource.read(path).clouds
    assert [len(cloud) for cloud in clouds] == [3000] * 5  # one of six shapes is held out
    assert path.stat().st_size > 4 * packed.stat().st_size


def test_normals_of_a_cloud_that_is_left_out_are_left_out(tmp_path: Path) -> None:
    ball = sphere(3000)  # its own normals
    np.savez(path := tmp_path / "balls.npz", **{"s0/3000": ball, "s0/1000": sphere(1000, 1), "s0/normals": ball})  # type: ignore[arg-type]
    for without, kept in ([3000], {"s0/1000"}), ([1000], {"s0/3000", "s0/normals"}):
        write_packed(packed := tmp_path / "carried.npz", [path], without=without)
        (unpacked,) = unpack_archives(packed, tmp_path / "there")
        with np.load(unpacked) as found:
            assert {*found.files} == kept


def test_archives_of_one_name_are_refused(clean: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (other := tmp_path / "other" / "clean.npz").write_bytes(clean.read_bytes())
    with pytest.raises(InvalidOptions, match="have one name"):
        write_packed(tmp_path / "carried.npz", [clean, other])


def test_what_is_no_cloud_is_refused_with_its_name(tmp_path: Path) -> None:
    np.savez(path := tmp_path / "flat.npz", **{"s0/2000": np.zeros((2000, 3))})  # type: ignore[arg-type]
    with pytest.raises(MalformedFile, match=r"flat\.npz: s0/2000 is no cloud"):
        write_packed(tmp_path / "carried.npz", [path])


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"s0/9": np.ones((9, 4))}, r"s0/9 is float64 \(9, 4\); it must be \(N, 3\) numbers"),
        ({"s0/0": np.ones((0, 3))}, r"s0/0 is float64 \(0, 3\)"),
        ({"s0/9": np.full((9, 3), "a")}, r"s0/9 is <U1 \(9, 3\)"),
        ({"s0/9": sphere(9), "s0/normals": sphere(8)}, "s0/normals has 8 rows for 9 points"),
    ],
    ids=["four columns", "none", "text", "normals of others"],
)
def test_arrays_of_other_kinds_are_refused_with_their_names(
    tmp_path: Path, arrays: dict[str, np.ndarray], said: str
) -> None:
    np.savez(path := tmp_path / "odd.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(MalformedFile, match=rf"odd\.npz: {said}"):
        write_packed(tmp_path / "carried.npz", [path])


def test_a_member_that_is_no_array_is_refused_with_its_name(clean: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(clean, "a") as archive:
        archive.writestr("README.txt", "who made these")
    with pytest.raises(MalformedFile, match=r"clean\.npz: README\.txt is no array"):
        write_packed(tmp_path / "carried.npz", [clean])


def test_a_file_that_was_not_packed_or_is_broken_is_refused(clean: Path, tmp_path: Path) -> None:
    with pytest.raises(MalformedFile, match=r"clean\.npz is no packed archive"):
        unpack_archives(clean, tmp_path / "there")
    write_packed(packed := tmp_path / "carried.npz", [clean])
    with np.load(packed) as file:
        arrays = {name: file[name] for name in file.files} | {"codes0": np.arange(9, dtype=np.uint8)}
    np.savez(packed, **arrays)
    with pytest.raises(MalformedFile, match=r"carried\.npz cannot be unpacked"):
        unpack_archives(packed, tmp_path / "there")
