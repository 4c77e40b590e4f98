"""KITTI frames: rows that did not move keep their bits, a length that is no whole row is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, TooManyPoints, UnknownFormat, UnsupportedCloud
from straightpcf.points.formats import format_named, read_cloud, write_cloud
from tests.clouds import torus

N = 40


@pytest.fixture
def frame(tmp_path: Path) -> Path:
    rows = np.empty((N, 4), "<f4")
    rows[:, :3], rows[:, 3] = torus(N), np.linspace(0, 1, N)
    bits = rows.view("<u4")
    bits[3, 0], bits[4, 1], bits[5, 2] = 0x7F800001, 0xFFC12345, 0x7FA00000  # NaN of three kinds
    rows[6, 2] = -0.0
    (path := tmp_path / "000000.bin").write_bytes(rows.tobytes())
    return path


def test_rows_that_did_not_move_keep_their_bits(frame: Path) -> None:
    cloud, format = read_cloud(frame)
    assert format.name == "kitti"
    write_cloud(cloud.with_xyz(cloud.xyz.copy()), out := frame.with_name("out.bin"), format)
    assert out.read_bytes() == frame.read_bytes()
    xyz = cloud.xyz.copy()
    xyz[::10] += 0.5
    write_cloud(cloud.with_xyz(xyz), out, format)
    before, after = (np.fromfile(path, "<u4").reshape(-1, 4) for path in (frame, out))
    still = np.arange(N) % 10 != 0
    np.testing.assert_array_equal(after[still], before[still])
    np.testing.assert_array_equal(after[:, 3], before[:, 3])
    np.testing.assert_array_equal(after.view("<f4")[::10, :3], xyz[::10].astype("<f4"))


@pytest.mark.parametrize("name", ["Intensity", "scalar_Intensity"])
def test_intensity_as_other_programs_call_it_is_there(name: str, tmp_path: Path) -> None:
    """CloudCompare's, PDAL's."""
    values = np.arange(float(N))
    cloud = PointCloud(torus(N), {"ring": values, name: values})
    for called in ("kitti", "pts"):
        format = format_named(called)
        assert format.left_behind(cloud) == ["ring"]
        write_cloud(cloud, out := tmp_path / f"out{format.suffixes[0]}", format)
        np.testing.assert_array_equal(read_cloud(out)[0].attributes["intensity"], values)
        refused = replace(cloud, attributes={name: -values})
        assert format.left_behind(refused) == ([name] if called == "kitti" else [])


@pytest.mark.parametrize("over", [1, 4, 15])
def test_a_length_that_is_no_whole_row_is_refused_naming_what_is_over(over: int, frame: Path) -> None:
    frame.write_bytes(frame.read_bytes() + bytes(over))
    with pytest.raises(MalformedFile, match=rf"of {16 * N + over} bytes the last {over} are none"):
        read_cloud(frame)


def test_more_points_than_the_limit_are_refused_unread(frame: Path) -> None:
    with frame.open("r+b") as file:
        file.truncate(16_000_000_000)  # sparse
    with pytest.raises(TooManyPoints, match="1000000000 points; the limit is 1000"):
        read_cloud(frame, max_points=1000)


def test_only_the_suffix_says_that_a_file_is_a_frame(frame: Path) -> None:
    with pytest.raises(UnknownFormat):
        read_cloud(frame.rename(frame.with_name("frame")))


def test_a_sweep_of_five_numbers_a_point_is_no_frame(frame: Path) -> None:
    with pytest.raises(UnsupportedCloud, match=r"nuScenes sweep has five float32 a point"):
        read_cloud(frame.rename(frame.with_name("sweep.pcd.bin")))


def test_a_position_that_float32_cannot_hold_is_named(frame: Path) -> None:
    cloud, format = read_cloud(frame)
    with pytest.raises(UnsupportedCloud, match=r"1e\+39 does not fit into float32"):
        write_cloud(cloud.with_xyz(np.full_like(cloud.xyz, 1e39)), frame, format)
    assert frame.stat().st_size == 16 * N


def test_what_float32_would_blur_is_refused_as_a_frame(frame: Path) -> None:
    cloud, format = read_cloud(frame)
    foreign = replace(cloud, source=None)
    write_cloud(foreign, out := frame.with_name("out.bin"), format)
    assert out.stat().st_size == 16 * N
    town = foreign.with_xyz(foreign.xyz * 100 + [691_000.0, 5_334_000.0, 520.0])
    with pytest.raises(UnsupportedCloud, match=r"rounded to float32.* up to 0\.25 off.*: take another format"):
        write_cloud(town, out, format)
    town.xyz[0] = 0  # a row of no data, beside which a quarter of a metre is little
    with pytest.raises(UnsupportedCloud, match=r"rounded to float32.* up to 0\.25 off"):
        write_cloud(town, out, format)


@pytest.mark.parametrize("columns", [3, 5, 6])
def test_rows_of_other_than_four_numbers_are_refused_saying_what_is_expected(columns: int, tmp_path: Path) -> None:
    rows = np.zeros((N, columns), "<f4")
    rows[:, :3] = torus(N)
    (path := tmp_path / "cloud.bin").write_bytes(rows.tobytes())
    with pytest.raises(UnsupportedCloud, match=r"four float32 a point.* the fourth of point \d+ is -.*\.npy"):
        read_cloud(path)


def test_text_is_no_frame(tmp_path: Path) -> None:
    (path := tmp_path / "cloud.bin").write_bytes(b"1.0 2.0 3.0 4.0\n" * N)
    with pytest.raises(UnsupportedCloud, match=r"this is text: call it \.xyz"):
        read_cloud(path)


@pytest.mark.parametrize(("value", "is_one"), [(0.5, True), (255, True), (-0.5, False), (np.nan, False)])
def test_an_intensity_that_no_frame_has_is_left_behind(value: float, is_one: bool, frame: Path) -> None:
    cloud, format = read_cloud(frame)
    values = np.full(N, 0.25)
    values[7] = value
    foreign = replace(cloud, source=None, attributes={"intensity": values})
    assert format.left_behind(foreign) == ([] if is_one else ["intensity"])
    write_cloud(foreign, out := frame.with_name("out.bin"), format)
    np.testing.assert_array_equal(read_cloud(out)[0].attributes["intensity"], values if is_one else np.zeros(N))
