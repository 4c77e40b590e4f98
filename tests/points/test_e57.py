"""E57 files that another library wrote are read as it reads them, and broken ones are refused."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from straightpcf.points.errors import MalformedFile, StraightPCFError, TooManyBytes, TooManyPoints, UnsupportedCloud
from straightpcf.points.formats import estimate_points, format_named, read_cloud, write_cloud
from tests.clouds import sphere
from tests.points.e57_samples import Field, patched, pye57, resealed, scanned, write_fields, write_two_scans


@pytest.fixture
def two_scans(tmp_path: Path) -> Path:
    return write_two_scans(tmp_path / "two.e57")


def test_scans_are_read_as_another_library_reads_them(two_scans: Path) -> None:
    cloud, format = read_cloud(two_scans)
    assert format.name == "e57"
    with pye57.E57(str(two_scans)) as file:
        theirs = [file.read_scan(scan, intensity=True, colors=True, row_column=True) for scan in (0, 1)]
    together = {name: np.concatenate([scan[name] for scan in theirs]) for name in theirs[0]}
    xyz = np.stack([together[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose(cloud.xyz, xyz, rtol=0, atol=1e-9)
    for ours, name in {"red": "colorRed", "green": "colorGreen", "blue": "colorBlue", "intensity": "intensity"}.items():
        np.testing.assert_array_equal(cloud.attributes[ours], together[name])
        assert cloud.attributes[ours].dtype == together[name].dtype
    np.testing.assert_array_equal(cloud.attributes["rowIndex"], together["rowIndex"])
    assert np.bincount(cloud.attributes["scan"]).tolist() == [8100, 450]
    assert cloud.beside == ()
    assert len(cloud) <= estimate_points(two_scans)


@pytest.mark.parametrize("count", [1, 8, 9, 70_000])
@pytest.mark.parametrize(("least", "most"), [(-5, 2), (-(1 << 19), (1 << 19) - 2), (-(1 << 40), 1 << 40), (3, 3)])
def test_whole_numbers_of_any_width_come_back(least: int, most: int, count: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    whole = rng.integers(least, most, count, endpoint=True).astype(np.longlong)  # a `long` is 32 bits to pye57
    coded = {axis: rng.integers(-1000, 1000, count) / 1000 + 7 for axis in "XYZ"}
    scaled = {f"cartesian{axis}": Field("ScaledInteger", v, 0, -1000, 1000, 1e-3, 7.0) for axis, v in coded.items()}
    cloud, _ = read_cloud(
        write_fields(tmp_path / "a.e57", {**scaled, "id": Field("Integer", whole, least, least, most)})
    )
    np.testing.assert_array_equal(cloud.attributes["id"], whole)
    np.testing.assert_allclose(cloud.xyz, np.stack(list(coded.values()), axis=1), atol=1e-12)
    assert cloud.attributes["id"].dtype.itemsize == {-5: 1, -(1 << 19): 4, -(1 << 40): 8, 3: 1}[least]


def test_spherical_scans_are_placed_and_normals_turn_with_their_pose(tmp_path: Path) -> None:
    xyz = 3 * sphere(400)
    reach = np.linalg.norm(xyz, axis=1)
    fields = {
        "sphericalRange": Field("Float", reach),
        "sphericalAzimuth": Field("Float", np.arctan2(xyz[:, 1], xyz[:, 0])),
        "sphericalElevation": Field("Float", np.arcsin(xyz[:, 2] / reach)),
        **{f"nor:normal{axis}": Field("Float", column.copy()) for axis, column in zip("XYZ", (xyz / 3).T, strict=True)},
    }
    cloud, _ = read_cloud(write_fields(tmp_path / "a.e57", fields, pose=True))
    c, s = np.cos(0.6), np.sin(0.6)
    turned = xyz @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(cloud.xyz, turned, atol=1e-12)
    assert cloud.normal_names == ("nx", "ny", "nz")
    np.testing.assert_allclose(cloud.old_normals(), turned / 3, atol=1e-12)
    assert list(cloud.attributes) == ["nx", "ny", "nz"]


def bare_and_whole(path: Path) -> Path:
    """Write a scan of 60 positions alone, and one of 50 points with all that they have."""
    with pye57.E57(str(path), mode="w") as file:
        bare = {name: values for name, values in scanned(60, 1).items() if name.startswith("cartesian")}
        file.write_scan_raw(bare, name="bare")
        file.write_scan_raw(scanned(50, 2), name="whole")
    return path


def test_what_not_all_scans_have_is_left_behind_by_name(tmp_path: Path) -> None:
    cloud, _ = read_cloud(bare_and_whole(tmp_path / "a.e57"))
    assert list(cloud.attributes) == ["scan"]
    assert set(cloud.beside) == {"intensity", "colorRed", "colorGreen", "colorBlue", "rowIndex", "columnIndex"}


def test_a_scan_of_no_points_takes_no_field_from_the_others(tmp_path: Path) -> None:
    path = bare_and_whole(tmp_path / "a.e57")
    patched(path, b'recordCount="60"', b'recordCount="0"')
    cloud, _ = read_cloud(path)
    assert list(cloud.attributes) == ["intensity", "red", "green", "blue", "rowIndex", "columnIndex", "scan"]
    assert set(cloud.attributes["scan"]) == {1}
    assert cloud.beside == ()


def test_a_scan_becomes_a_file_of_another_format_with_its_colours(two_scans: Path, tmp_path: Path) -> None:
    cloud, _ = read_cloud(two_scans)
    write_cloud(cloud, tmp_path / "a.las", format_named("las"))
    again, _ = read_cloud(tmp_path / "a.las")
    np.testing.assert_allclose(again.xyz, cloud.xyz, atol=1e-3)
    np.testing.assert_array_equal(again.attributes["red"], cloud.attributes["red"].astype(np.uint16) * 257)


def test_more_points_than_the_limit_are_refused_before_they_are_unpacked(two_scans: Path) -> None:
    with pytest.raises(TooManyPoints, match="9500 points; the limit is 9499"):
        read_cloud(two_scans, max_points=9499)


def test_points_that_take_no_bits_are_no_bomb(tmp_path: Path) -> None:
    same = {f"cartesian{axis}": Field("ScaledInteger", np.ones(60), 1, 1, 1, 1.0, 0.0) for axis in "XYZ"}
    path = write_fields(tmp_path / "a.e57", same)
    assert len(read_cloud(path)[0]) == 60
    patched(path, b'recordCount="60"', b'recordCount="99999999"')
    with pytest.raises(TooManyBytes, match="the E57 file's points"):
        read_cloud(path)


def test_what_lies_behind_a_file_is_no_part_of_it(two_scans: Path) -> None:
    cloud, _ = read_cloud(two_scans)
    two_scans.write_bytes(two_scans.read_bytes() + bytes(3000))
    np.testing.assert_array_equal(read_cloud(two_scans)[0].xyz, cloud.xyz)


def test_a_damaged_page_is_named(two_scans: Path) -> None:
    raw = bytearray(two_scans.read_bytes())
    raw[5000] ^= 1
    two_scans.write_bytes(raw)
    with pytest.raises(MalformedFile, match="page 4 of the E57 file is damaged"):
        read_cloud(two_scans)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b'fileOffset="48"', b'fileOffset="99"', "begins no section of points"),
        (b'recordCount="9000"', b'recordCount="9999"', "needs at least"),
        (b'recordCount="9000"', b'recordCount="many"', "invalid literal"),
        (b'minimum="0" maximum="255"', b'minimum="9" maximum="0"', "holds 9 to 0"),
        (b"cartesianX", b"cartesianA", "no positions, cartesian or spherical, but cartesianA, intensity"),
        (b'<z type="Float">2', b'<z type="Float">a', "z of the E57 file is 'a"),
        (b"<?xml version", b"<!DOCTYPE a>  ", "document type"),
        (b"<e57Root", b"<e57Boot", "XML of the E57 file is broken"),
        (b"<prototype type", b"<prototope type", "XML of the E57 file is broken"),
        (b"<data3D", b"<data4D", "XML of the E57 file is broken"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(old: bytes, new: bytes, said: str, two_scans: Path) -> None:
    patched(two_scans, old, new)
    with pytest.raises(StraightPCFError, match=said):
        read_cloud(two_scans)


def test_a_file_without_scans_and_one_that_is_cut_short_are_refused(two_scans: Path, tmp_path: Path) -> None:
    with pye57.E57(str(tmp_path / "none.e57"), mode="w"):
        pass
    with pytest.raises(UnsupportedCloud, match="holds no scan"):
        read_cloud(tmp_path / "none.e57")
    raw = two_scans.read_bytes()
    for size in (20, 1000, len(raw) - 1024):
        two_scans.write_bytes(raw[:size])
        with pytest.raises(MalformedFile, match="truncated"):
            read_cloud(two_scans)


def test_no_broken_byte_does_more_than_be_refused(two_scans: Path) -> None:
    raw, rng = two_scans.read_bytes(), np.random.default_rng(0)
    for _ in range(150):
        broken = bytearray(raw)
        for at in rng.integers(0, len(raw), 3):
            broken[at] = rng.integers(256)
        resealed(broken)
        two_scans.write_bytes(broken)
        with suppress(StraightPCFError):
            cloud, format = read_cloud(two_scans, max_points=20_000)
            format.check(cloud)
            write_cloud(cloud.with_xyz(cloud.xyz + 0.5), two_scans, format)
