"""PTX files: scans with poses of their own, directions from which nothing came back, and what is wrong with a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, StraightPCFError, TooManyPoints, UnsupportedCloud
from straightpcf.points.formats import format_named, read_cloud, write_cloud
from tests.clouds import sphere

PTX = format_named("ptx")
COS, SIN = np.cos(0.6), np.sin(0.6)
TURN = np.array([[COS, SIN, 0.0], [-SIN, COS, 0.0], [0.0, 0.0, 1.0]])  # of rows: p' = p TURN
PLACE = np.array([448000.25, 5411000.5, 310.0])


Array = npt.NDArray[np.float64]


def scan(rows: Sequence[str], turn: Array = TURN, place: Array = PLACE) -> list[str]:
    """Write a scan of one column with a pose, as Leica's programs do: the scanner, its axes, the matrix."""
    axes = [" ".join(map(repr, axis)) for axis in turn.tolist()]
    place_text = " ".join(map(repr, place.tolist()))
    return ["1", str(len(rows)), place_text, *axes, *(f"{axis} 0" for axis in axes), f"{place_text} 1", *rows]


def row(xyz: Array, *more: object) -> str:
    return " ".join([*(f"{value:.6f}" for value in xyz), *map(str, more)])


def stored(path: Path, *scans: list[str], end: str = "\n") -> Path:
    path.write_bytes(end.join([line for lines in scans for line in lines] + [""]).encode())
    return path


ROWS = [row(point, 0.5) for point in sphere(40)]


@pytest.fixture
def two_scans(tmp_path: Path) -> Path:
    """Two scans, every fifth direction of the first without a point; only the first has a colour."""
    first = [
        row(point, 0.25, 10, 20, index % 256) if index % 5 else "0 0 0 0.500000 0 0 0"
        for index, point in enumerate(sphere(500))
    ]
    second = [row(point, index / 1000) for index, point in enumerate(sphere(300, seed=1))]
    return stored(tmp_path / "two.ptx", scan(first), scan(second, np.eye(3), PLACE + 2), end="\r\n")


def test_scans_lie_where_their_matrices_put_them_without_what_did_not_come_back(two_scans: Path) -> None:
    cloud, format = read_cloud(two_scans)
    assert format.name == "ptx"
    first = np.round(sphere(500)[np.arange(500) % 5 > 0], 6) @ TURN + PLACE
    second = np.round(sphere(300, seed=1), 6) + PLACE + 2
    np.testing.assert_allclose(cloud.xyz, np.concatenate([first, second]), rtol=0, atol=1e-9)
    assert np.bincount(cloud.attributes["scan"]).tolist() == [400, 300]
    assert list(cloud.attributes) == ["intensity", "scan"]
    assert cloud.attributes["intensity"][:401].tolist() == [0.25] * 400 + [0.0]
    assert cloud.beside == ("red", "green", "blue")


def test_colours_of_one_scan_are_bytes(tmp_path: Path) -> None:
    rows = [row(point, 0.5, index, 0, 255) for index, point in enumerate(sphere(50))]
    cloud, _ = read_cloud(stored(tmp_path / "a.ptx", scan(rows)))
    assert list(cloud.attributes) == ["intensity", "red", "green", "blue"]
    assert cloud.attributes["red"].dtype == np.uint8
    assert cloud.attributes["red"].tolist() == list(range(50))


def test_only_what_moved_is_other_text_and_lies_where_it_was_put(two_scans: Path, tmp_path: Path) -> None:
    cloud, format = read_cloud(two_scans)
    xyz = cloud.xyz.copy()
    picked = [7, 399, 450]
    xyz[picked] += [[0.01, -0.02, 0.03]]
    format.write(cloud.with_xyz(xyz), tmp_path / "b.ptx")
    before, after = (path.read_bytes().split(b"\r\n") for path in (two_scans, tmp_path / "b.ptx"))
    changed = [index for index, pair in enumerate(zip(before, after, strict=True)) if pair[0] != pair[1]]
    assert len(changed) == 3
    assert all(before[index].split()[3:] == after[index].split()[3:] for index in changed)
    again, _ = read_cloud(tmp_path / "b.ptx")
    np.testing.assert_allclose(again.xyz, xyz, rtol=0, atol=1e-9)
    stayed = np.delete(np.arange(len(xyz)), picked)
    np.testing.assert_array_equal(again.xyz[stayed], cloud.xyz[stayed])


def test_what_is_no_number_or_infinite_stays_as_it_is_written(tmp_path: Path) -> None:
    rows = ["nan nan nan 0.5", "inf 1e308 -1e308 0.5", *ROWS]
    cloud, format = read_cloud(path := stored(tmp_path / "a.ptx", scan(rows)))
    assert len(cloud) == 42
    assert not np.isfinite(cloud.xyz[:2]).all(axis=1).any()
    format.write(cloud.with_xyz(np.vstack([cloud.xyz[:2], cloud.xyz[2:] + 0.25])), tmp_path / "b.ptx")
    assert (tmp_path / "b.ptx").read_bytes().split(b"\n")[10:12] == path.read_bytes().split(b"\n")[10:12]


@pytest.mark.parametrize("name", ["a.txt", "a.pts", "a.xyz", "a"])
def test_a_file_is_known_by_its_ten_lines_whatever_it_is_called(name: str, two_scans: Path) -> None:
    assert read_cloud(two_scans, name=name)[1].name == "ptx"


def test_a_scan_from_which_nothing_came_back_counts_and_holds_no_point(tmp_path: Path) -> None:
    nothing, some = ["0 0 0 0.5"] * 9, [row(point, 0.5) for point in sphere(40)]
    path = stored(tmp_path / "a.ptx", scan(nothing), scan([]), scan(some), scan(some[:1]))
    assert set(read_cloud(path)[0].attributes["scan"]) == {2, 3}
    with pytest.raises(UnsupportedCloud, match="nothing came back to the scanner"):
        read_cloud(stored(tmp_path / "b.ptx", scan(nothing)))


def test_a_cloud_becomes_a_file_with_its_intensity_and_colour(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (3, 60), np.uint8)
    attributes = {"Intensity": np.linspace(0, 1, 60), **dict(zip(("red", "green", "blue"), rgb, strict=True))}
    write_cloud(PointCloud(sphere(60) + PLACE, attributes | {"time": np.arange(60)}), tmp_path / "a.ptx", PTX)
    cloud, _ = read_cloud(tmp_path / "a.ptx")
    np.testing.assert_array_equal(cloud.xyz, sphere(60) + PLACE)
    np.testing.assert_array_equal(cloud.attributes["intensity"], np.linspace(0, 1, 60))
    np.testing.assert_array_equal(cloud.attributes["green"], rgb[1])
    assert PTX.left_behind(PointCloud(sphere(60), attributes | {"time": np.arange(60)})) == ["time"]
    write_cloud(PointCloud(sphere(60)), tmp_path / "b.ptx", PTX)
    assert set(read_cloud(tmp_path / "b.ptx")[0].attributes["intensity"]) == {0.5}


@pytest.mark.parametrize("point", [[0.0, 0.0, 0.0], [1.0, np.nan, 0.0]])
def test_what_would_be_no_point_of_a_new_file_is_refused(point: list[float]) -> None:
    with pytest.raises(UnsupportedCloud, match=r"point 4 is \[.*\], which is none in a PTX file"):
        PTX.check(PointCloud(np.insert(sphere(40), 4, point, axis=0)))


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (scan(ROWS)[:-3], "truncated: scan 1 lacks 3 of its lines"),
        ([*scan(ROWS), *scan(ROWS)[:6]], "truncated: 6 of the 10 lines above scan 2 are there"),
        ([*scan(ROWS), "1 2 3 0.5"], "line 51 of the PTX file is not a number of columns or rows, but '1 2 3 0.5'"),
        ([*scan(ROWS), "1", "1e3"], "line 52 of the PTX file is not a number of columns or rows"),
        ([*scan(ROWS), "1", "1_0"], "line 52 of the PTX file is not a number of columns or rows, but '1_0'"),
        ([*scan(ROWS), "1", "1", "0 0"], "line 53 of the PTX file is not 3 numbers of a pose"),
        ([*scan(ROWS[:5]), *scan(ROWS)[:9], "0 0 0 2", *ROWS], "matrix above line 26 of the PTX file is no pose"),
        (scan(ROWS, np.zeros((3, 3))), "matrix above line 11 of the PTX file is no pose"),
        (scan([*ROWS[:5], "1 2 3 0.5 1 2 3"]), "line 16 has 7 columns, the lines before have 4"),
        (scan(["1 2 3 4 5", *ROWS]), "line 11 has 5 columns; a point of a PTX file has 3, 4, 6 or 7"),
        (scan([*ROWS[:5], "1 2 a 0.5"]), "line 16, column 3: 'a' is no number"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_the_line(lines: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(MalformedFile, match=said):
        read_cloud(stored(tmp_path / "a.ptx", lines))


def test_more_points_than_the_limit_are_refused_by_what_is_declared(two_scans: Path) -> None:
    with pytest.raises(TooManyPoints, match="the PTX file declares 800 points; the limit is 799"):
        read_cloud(two_scans, max_points=799)
    assert len(read_cloud(two_scans, max_points=800)[0]) == 700


def test_scans_longer_than_a_block_are_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("straightpcf.points.formats.text.BLOCK_BYTES", 1000)
    rows = [row(point, index) for index, point in enumerate(sphere(700))]
    cloud, _ = read_cloud(stored(tmp_path / "a.ptx", scan(rows[:300]), scan(rows[300:])))
    np.testing.assert_array_equal(cloud.attributes["intensity"], np.arange(700))


def test_no_broken_byte_does_more_than_be_refused(two_scans: Path, tmp_path: Path) -> None:
    raw, rng = two_scans.read_bytes(), np.random.default_rng(0)
    for _ in range(200):
        broken = bytearray(raw)
        for at in rng.integers(0, rng.choice([200, len(raw)]), 3):
            broken[at] = rng.choice(list(b"0123456789 -.e\r\nx\t"))
        two_scans.write_bytes(broken)
        try:
            cloud, format = read_cloud(two_scans, max_points=20_000)
            format.check(cloud)
            format.write(cloud.with_xyz(cloud.xyz + 0.5), tmp_path / "b")
        except StraightPCFError:
            continue
