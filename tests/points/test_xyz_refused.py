"""Text tables that are refused, and what the error names."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, TooManyPoints, UnsupportedCloud
from straightpcf.points.formats import read_cloud
from tests.effort import at_most_lines


def read(folder: Path, raw: bytes, filename: str = "a.xyz", **options: Any) -> PointCloud:
    (path := folder / filename).write_bytes(raw)
    return read_cloud(path, **options)[0]


@pytest.mark.parametrize("token", [b"nan(", b"1.#", b"1.#INF5", b"nan(0)5", b"d", b"s(1)"])
def test_what_only_looks_like_it_is_refused(token: bytes, tmp_path: Path) -> None:
    with pytest.raises(MalformedFile, match="no number"):
        read(tmp_path, b"1 2 3\n4 5 " + token + b"\n")


@pytest.mark.parametrize("separator", [" ", ",", "\t"])
@pytest.mark.parametrize("start", [0, 1, 5000])
def test_a_first_column_that_counts_the_points_is_never_taken_for_x(separator: str, start: int, tmp_path: Path) -> None:
    rows = [separator.join([str(start + n), f"{n % 7}.5", "2", "3.25", "tree"]) for n in range(50)]
    raw = "\n".join(rows).encode()
    with pytest.raises(UnsupportedCloud, match=rf"counts the points from {start} on.*line of names"):
        read(tmp_path, raw, "a.tsv" if separator == "\t" else "a.xyz")
    named = read(tmp_path, separator.join(["id", "x", "y", "z", "code"]).encode() + b"\n" + raw, "b.txt")
    np.testing.assert_array_equal(named.xyz[0], [0.5, 2, 3.25])


@pytest.mark.parametrize(
    "rows",
    [
        [f"{n} 0 1" for n in range(50)],  # a line of points
        [f"{n % 10} {n // 10} 1 7" for n in range(50)],  # a grid
        [f"{n + 0.5} 0 1 7" for n in range(50)],
        [f"{n} 0 1 7" for n in range(9)],
        [f"{2 * n} 0 1 7" for n in range(50)],
    ],
)
def test_an_x_that_only_looks_like_it_is_one(rows: list[str], tmp_path: Path) -> None:
    cloud = read(tmp_path, "\n".join(rows).encode())
    np.testing.assert_array_equal(cloud.xyz[:, 0], [float(row.split()[0]) for row in rows])


def scanned(separator: str = " ", more: str = "") -> list[str]:
    """Return rows as FARO SCENE exports them: row and column of the scanner, x, y, z, and what follows."""
    numbers = [(row, column) for column in range(30, 40) for row in range(7) if (row + column) % 5]
    cells = [[str(r), str(c), f"{-0.31 * r - 0.01:.4f}", f"{0.17 * c:.4f}", f"1.{r}05"] for r, c in numbers]
    return [separator.join([*row, *more.split()]) for row in cells]


@pytest.mark.parametrize("separator", [" ", ",", "\t"])
@pytest.mark.parametrize("more", ["", "0.5", "10 20 oak"])
def test_a_scanners_rows_and_columns_are_never_taken_for_x_and_y(separator: str, more: str, tmp_path: Path) -> None:
    rows, suffix = scanned(separator, more), "tsv" if separator == "\t" else "xyz"
    for raw in (rows, sorted(rows, key=lambda row: int(row.split(separator)[0])), rows[::-1]):
        with pytest.raises(UnsupportedCloud, match=r"scanner's rows and columns.*line of names"):
            read(tmp_path, "\n".join(raw).encode(), f"a.{suffix}")
    names = separator.join(["row", "column", "x", "y", "z", *"rgb"[: len(more.split())]])
    named = read(tmp_path, "\n".join([names, *rows]).encode(), f"b.{suffix}")
    np.testing.assert_array_equal(named.xyz[0], [float(cell) for cell in rows[0].split(separator)[2:5]])


GRIDS = {
    "a height map": [f"{n % 10} {n // 10} 1.5" for n in range(50)],
    "with a colour": [f"{n % 10} {n // 10} 1.5 10 20 30" for n in range(50)],
    "with an intensity and a class": [f"{n % 10} {n // 10} 1.5 0.25 2" for n in range(50)],
    "written with decimals": [f"{n % 10}.0 {n // 10}.0 1.5 0.6 0.8" for n in range(50)],
    "below zero": [f"{n % 10 - 5} {n // 10} 1.5 0.6 0.8" for n in range(50)],
    "in no order": [f"{7 * n % 50} {3 * n % 11} 1.5 0.6 0.8" for n in range(50)],
    "of few points": scanned()[:9],
}


@pytest.mark.parametrize("case", GRIDS)
def test_a_grid_of_whole_numbers_is_read_as_it_stands(case: str, tmp_path: Path) -> None:
    cloud = read(tmp_path, "\n".join(GRIDS[case]).encode())
    np.testing.assert_array_equal(cloud.xyz, [[float(cell) for cell in row.split()[:3]] for row in GRIDS[case]])


MALFORMED = {
    "bad token": (b"1 2 3\n4 5 6\n\n7 8,9 0\n", r"line 4, column 2.*8,9"),
    "a name among numbers": (b"x y z\n1 2 3\n1 z 3\n", r"line 3, column 2.*z"),
    "underscores": (b"1 2 1_000\n", r"line 1, column 3.*1_000"),
    "a very long token": (b"1 2 3\n1 2 " + b"1" * 5000 + b"\n", r"line 2, column 3"),
    "no number between spaces": (b"1 2 3\n1 NA 3\n", r"line 2, column 2.*NA"),
    "more columns": (b"1 2 3\n\n1 2 3 4\n", r"line 3 has 4 columns.* 3"),
    "fewer columns": (b"# a\n1 2 3\n1 2\n", r"line 3 has 2 columns.* 3"),
    "two columns": (b"1 2\n3 4\n", r"line 1 has 2 columns"),
    "prose": (b"hello world\n", r"line 1 has 2 columns"),
    "count too high": (b"3\n1 2 3\n4 5 6\n", r"declares 3 .* holds 2"),
    "count too low": (b"1\n1 2 3\n4 5 6\n", r"declares 1 .* holds 2"),
    "further count too high": (b"1\n1 2 3\n3\n4 5 6\n4 5 6\n", r"declares 4 .* holds 3"),
    "no further count": (b"1\n1 2 3\n\n-3\n4 5 6\n", r"line 4 has 1 column.*-3"),
    "no further count either": (b"1\n1 2 3\n3\nscan\n4 5 6\n", r"line 4 has 1 column.*scan"),
    "a count below no count": (b"1 2 3\n1\n4 5 6\n", r"line 2 has 1 columns"),
    "names that name no position": (
        b"id,lon,lat,h\n1,2,3,4\n",
        r"names above line 2 .*id,lon,lat,h.*easting, northing",
    ),
    "degrees": (b"Lat,Lon,Alt (m)\n1,2,3\n", r"names above line 2 are of degrees.*Lat,Lon,Alt.*project"),
    "degrees in a comment": (b"# longitude latitude height\n1 2 3\n", r"names above line 2 are of degrees"),
    "degrees with their unit": (b"gps_lat,gps_lon,alt_m\n1,2,3\n", r"names .*of degrees.*gps_lat,gps_lon"),
    "degrees in numbered names": (b"1_lat,2_lon,3_alt\n1,2,3\n", r"names .*of degrees"),
    "degrees in numbered remarks": (b"# 1:lat 2:lon 3:alt\n1 2 3\n", r"names .*of degrees"),
    "angles": (b"range, azimuth, elevation\n1,2,3\n", r"names above line 2 are of angles: 'range, azimuth.*into x, y"),
    "angles in a comment": (b"# Range [m] Azimuth_deg Elev. I\n1 2 3 4\n", r"names .*of angles: 'Range \[m\] Azi"),
    "cylinders": (b"r\tphi\tz\n1 2 3\n", r"names .*of angles"),
    "fewer names than columns": (
        b"x y z\n1 2 3 4\n",
        r"line 1 names 3 columns.*'x y z'.*line 2 has 4",
    ),  # R's row numbers
    "more names than columns": (b"a b id x y z\n1 2 3 4\n", r"line 1 names 6 or more columns.*line 2 has 4"),
    "a cell less than names": (b"id\tcode\tx\ty\tz\n1\t\t2\t3\t4\n", r"line 1 names 5 .*line 2 has 4"),
    "binary": (b"1 2 3\n\x00\x01\x02", r"0x00"),
    "UTF-16": ("1 2 3\n".encode("utf-16"), r"UTF-16.*UTF-8"),
    "decimal commas": (b"1 2 3\n0,5 -1,5 2,5\n", r"line 2"),
    "decimal commas only": (b"0,5 -1,5 2,5\n" * 2, r"line 1, column 2: '5 -1' is no number; decimals have a point"),
    "decimal commas and whole numbers": (b"0,5 1 2,5\n", r"column 2: '5 1 2' is no number; decimals have a point"),
    "decimal commas between tabs": (b"0,5\t1,5\t2,5\n", r"decimals have a point"),
    "decimal commas below names": (b"x\ty\tz\n0,5\t1,5\t2,5\n", r"line 2 has decimal commas: '0,5.*have a point"),
    "one decimal comma": (b"0,5\t1\t2\n", r"line 1 has decimal commas: '0,5.*decimals have a point"),
    "decimal commas in quotes": (b'x,y,z\n"0,5","1,5","2,5"\n', r"line 2, column 1: '0,5'.*decimals have a point"),
    "decimal commas behind commas": (b"# a\n0,5, -1,5, 2,5\n", r"line 2 looks like .*'0,5, -1,5, 2,5'.* have a point"),
    "decimal commas between commas": (b"0,500,1,050,-2,500\n" * 1000, r"line 1 looks like .*decimals have a point"),
    "decimal commas between semicolons": (b"x;y;z\n0,5;1,5;2\n", r"line 2, column 1: '0,5'.*decimals have a point"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_table_is_refused_naming_the_place(case: str, tmp_path: Path) -> None:
    raw, pattern = MALFORMED[case]
    with pytest.raises(MalformedFile, match=pattern):
        read(tmp_path, raw)


def test_a_count_line_beyond_the_limit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TooManyPoints, match=r"line 1 .*4000000000"):
        read(tmp_path, b"4000000000\n1 2 3\n", "a.pts")


def test_errors_far_down_a_long_file_are_found(tmp_path: Path) -> None:
    """Past the first block of the reader, so that line numbers add up across blocks."""
    raw = b"1.0 2.0 3.0\n" * 800_000
    with at_most_lines(800_000), pytest.raises(MalformedFile, match=r"line 800001, column 3.*oops"):
        read(tmp_path, raw + b"1 2 oops\n")


@pytest.mark.parametrize("above", [b"", b"1 2 3\n"])
def test_one_endless_line_is_refused_before_it_takes_memory(above: bytes, tmp_path: Path) -> None:
    (path := tmp_path / "a.xyz").write_bytes(above + b"1 " * 5_000_000)
    tracemalloc.start()
    with pytest.raises(UnsupportedCloud, match=r"limit"):
        read_cloud(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * path.stat().st_size


@pytest.mark.parametrize("line", [b"#\n", b"\r"])
def test_endless_lines_above_the_table_are_refused_before_they_take_time(line: bytes, tmp_path: Path) -> None:
    assert len(read(tmp_path, line * 99_999 + b"1 2 3\n")) == 1
    with at_most_lines(5_000_000), pytest.raises(UnsupportedCloud, match="first 100000 lines, the limit"):
        read(tmp_path, line * 20_000_000 + b"1 2 3\n")
