"""Text tables as people write them."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import UnknownFormat
from straightpcf.points.formats import format_for, format_named, read_cloud, text, write_cloud
from straightpcf.points.formats.colours import RGB
from tests.clouds import torus


def read(folder: Path, raw: bytes, filename: str = "a.xyz", **options: Any) -> PointCloud:
    (path := folder / filename).write_bytes(raw)
    return read_cloud(path, **options)[0]


def written(folder: Path, cloud: PointCloud, name: str = "out.xyz") -> bytes:
    write_cloud(cloud, folder / name, format_for(name))
    return (folder / name).read_bytes()


TABLES = {
    "spaces": b" 1.0  2.00 3e0\n4 5 6\n",
    "tabs, CRLF, no last end": b"1\t2\t3\r\n4\t5\t6",
    "old Mac": b"1 2 3\r4 5 6\r",
    "commas": b"1, 2,3\n4,5 ,6\n",
    "semicolons": b"1;2;3;red\n4;5;6;\n",
    "comments, blanks": b"# a, b\n\n// 1\n1 2 3\n\n#9 9 9\n 4 5 6\n// end\n\n",
    "names": b"X Y Z\n1 2 3\n4 5 6\n",
    "names in another order": b"id,z,y,x\n7,3,2,1\n8,6,5,4\n",
    "ParaView's names": b'"I","Points:0","Points:1","Points:2"\n7,1,2,3\n8,4,5,6\n',
    "newer ParaView's names": b"Point ID,I,Points_0,Points_1,Points_2,Points_Magnitude\n0,7,1,2,3,4\n1,8,4,5,6,9\n",
    "surveyors' names": b"id;Northing;Easting;Height\nA;2;1;3\nB;5;4;6\n",
    "names with units": b"t [s],X [m],Y (m),Z [m]\n7,1,2,3\n8,4,5,6\n",
    "names with gaps and twins": b"id,x,y,z,w,w,\n7,1,2,3,8,9,\n7,4,5,6,8,9,\n",
    "names in a comment above another": b"# id x y z\n# written by me\n7 1 2 3\n8 4 5 6\n",
    "names in a comment above an empty one": b"# id x y z\n#\n7 1 2 3\n8 4 5 6\n",
    "names in a comment above a count": b"// id x y z\n2\n7 1 2 3\n8 4 5 6\n",
    "names behind a word": b"# columns: id x y z\n7 1 2 3\n8 4 5 6\n",
    "names between tabs": b"Point Id\tX\tY\tZ\n7\t1\t2\t3\n8\t4\t5\t6\n",
    "names with units between spaces": b"id x [m] y [m] z [m]\n7 1 2 3\n8 4 5 6\n",
    "x beside X": b"X,x,Y,y,Z,z\n7,1,8,2,9,3\n7,4,8,5,9,6\n",
    "X beside an x": b"x,X,Y,Z\n7,1,2,3\n7,4,5,6\n",
    "E, N, Z": b"N,E,Z,I\n2,1,3,7\n5,4,6,7\n",
    "East, North, Elev": b"id,EAST,NORTH,ELEV\n7,1,2,3\n7,4,5,6\n",
    "Easting, Northing, Elevation": b"id,Easting,Northing,ELEVATION\n7,1,2,3\n7,4,5,6\n",
    "coordinates": b"id,X Coordinate,Y Coordinate,Z Coordinate\n7,1,2,3\n7,4,5,6\n",
    "names with a unit behind": b"t_s,x_m,y_m,z_m\n7,1,2,3\n7,4,5,6\n",
    "ArcGIS's names": b"OBJECTID,POINT_X,POINT_Y,POINT_Z\n7,1,2,3\n7,4,5,6\n",
    "VeloView's names": b'"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","laser_id"\n1,2,3,7\n4,5,6,7\n',
    "newer VeloView's names": b"Points_m_XYZ_0,Points_m_XYZ_1,Points_m_XYZ_2,azimuth\n1,2,3,7\n4,5,6,7\n",
    "degrees beside metres": b"lat,lon,x,y,z\n7,8,1,2,3\n7,8,4,5,6\n",
    "Ouster's names": b"RANGE (mm),X1 (mm),Y1 (mm),Z1 (mm)\n7,1,2,3\n7,4,5,6\n",
    "pandas' numbers": b"0,1,2\n1.0,2.0,3.0\n4.0,5,6.0\n",
    "pandas' numbers and index": b",0,1,2,3\r\n0,1.0,2.0,3.0,7\r\n1,4.0,5,6.0,7\r\n",
    "names of wavelengths": b"id,X,Y,Z,450,550.5,inf\n7,1,2,3,8,9,10\n7,4,5,6,8,9,10\n",
    "names of wavelengths between spaces": b"x [m] y [m] z [m] 450 550\n1 2 3 8 9\n4 5 6 8 9\n",
    "MATLAB's comment": b"%id x y z\n7 1 2 3\n8 4 5 6\n",
    "names that begin with digits": b"1st,x,y,z\n7,1,2,3\n8,4,5,6\n",
    "a delimiter behind the cells": b"id,x,y,z\n7,1,2,3,\n8,4,5,6,\n",
    "a name twice in a comment": b"# x x y z\n1 2 3 7\n4 5 6 8\n",
    "names that are no ASCII": "# n\u00e0me id x y z\n7 8 1 2 3\n7 8 4 5 6\n".encode(),
    "three names of any kind": b"a,b,c\n1,2,3\n4,5,6\n",
    "a remark of as many words": b"# made by a program\n1 2 3 7\n4 5 6 8\n",
    "where a scanner stood": b"# lat: 48.1 long: -9.2\n1 2 3 7\n4 5 6 8\n",
    "where it stood, with signs of degrees": "# lat 48.1\u00b0N long 9.2\u00b0\n1 2 3 7\n4 5 6 8\n".encode(),
    "what a scanner looked at": b"# az 0..360 range 120\n1 2 3 7\n4 5 6 8\n",
    "byte order mark": b"\xef\xbb\xbf1 2 3\n4 5 6\n",
    "count": b"2\n1 2 3 -100 255 255 255\n4 5 6 -100 0 0 0\n",
    "count under a comment": b"# pts\n 2 \n1 2 3\n4 5 6\n",
    "scans one below another": b"1\r\n1 2 3 -100 255 255 255\r\n# two\r\n 1\r\n4 5 6 -100 0 0 0\r\n0\r\n",
    "Excel's first line": b"sep=;\r\nX;Y;Z\r\n1;2;3\r\n4;5;6\r\n",
    "Ctrl-Z": b"1 2 3\r\n4 5 6\r\n\x1a",
    "Ctrl-Z between commas": b"1,2,3\r\n4,5,6\r\n\x1a\r\n",
    "a quoted comma": b'x,y,z,kind\n1,2,3,"an oak, old"\n4,5,6,"elm; young"\n',
    "a quoted comma in the first row": b'1,2,3,"an oak, old; tall"\n4,5,6,\n',
    "a quoted name with a comma": b'"id, n",x,y,z\r\n7,1,2,3\r\n8,4,5,6\r\n',
    "quoted numbers": b'"x","y","z"\n"1","2","3"\n"4","5","6"\n',
    "quoted numbers without names": b'"1";"2";"3"\n"4";"5";"6"\n',
    "one quote in a line": b'1,2,3,5" thick\n4,5,6,7" thick\n',
    "quotes in quotes": b'1,2,3,"an ""oak"", old"\n4,5,6,\n',
    "a quoted number sign": b'k,x,y,z\n"#1",1,2,3\n"//",4,5,6\n',
    "a quoted number sign behind a space": b'k,x,y,z\n" #1",1,2,3\n"\t//",4,5,6\n',
    "words": b"1 2 3 tree 7\n4 5 6 house 8\n",
    "text that is no UTF-8": b"# \xe9\n1 2 3 \xff\n4 5 6 \xfe\n",
}


@pytest.mark.parametrize("case", TABLES)
def test_a_table_is_read_and_everything_but_moved_tokens_is_kept(case: str, tmp_path: Path) -> None:
    raw = TABLES[case]
    cloud = read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3], [4, 5, 6]])
    assert written(tmp_path, cloud) == raw
    xyz = cloud.xyz.copy()
    xyz[1, 1] = -0.123456789012345
    changed = written(tmp_path, cloud.with_xyz(xyz))
    assert changed.count(b"-0.123456789012345") == 1
    assert changed.replace(b"-0.123456789012345", b"5") == raw


def test_columns_of_numbers_become_attributes_under_their_names(tmp_path: Path) -> None:
    cloud = read(tmp_path, b"x,y,z,'Scan Id',word,w\n1,2,3,7,a,nan\n4,5,6,8,b,9\n")
    assert list(cloud.attributes) == ["Scan Id", "w"]
    np.testing.assert_array_equal(cloud.attributes["Scan Id"], [7, 8])
    assert list(read(tmp_path, b"1 2 3 4\n5 6 7 8\n").attributes) == ["column_4"]


@pytest.mark.parametrize(
    ("raw", "names"),
    [
        (b"id,x,y,z\n7,1,2,3,\n", ["id"]),  # a delimiter at the end
        (b"id,x,y,z,\n7,1,2,3\n", ["id"]),
        (b",x,y,z\n7,1,2,3\n", ["column_1"]),  # pandas
        (b"Point Id\tX\tY\tZ\n7\t1\t2\t3\n", ["Point Id"]),
        (b"id x [m] y [m] z [m]\n7 1 2 3\n", ["id"]),
        (b"% id x y z\n7 1 2 3\n", ["id"]),  # MATLAB
        (b"# columns: id x y z\n7 1 2 3\n", ["id"]),
        (b"# id x y z\n# exported 2024\n7 1 2 3\n", ["id"]),  # numpy.savetxt
    ],
)
def test_titles_as_programs_write_them_say_where_positions_are(raw: bytes, names: list[str], tmp_path: Path) -> None:
    cloud = read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3]])
    assert list(cloud.attributes) == names
    assert written(tmp_path, cloud) == raw


@pytest.mark.parametrize(
    "raw",
    [b"0 1 2\n4 5 6\n", b"0,1,2\n4.5,5,6.5\n", b"0,1,2.0\n4.5,5.5,6.5\n", b"0,2,1\n.5,.5,.5\n", b"0 1 2\n"],
)
def test_a_first_point_of_small_whole_numbers_is_a_point(raw: bytes, tmp_path: Path) -> None:
    first = [float(word) for word in raw.replace(b",", b" ").split()[:3]]
    assert read(tmp_path, raw).xyz[0].tolist() == first


def test_a_table_with_two_cases_of_x_that_we_wrote_is_read_again(tmp_path: Path) -> None:
    cloud = PointCloud(torus(3), {"X": np.arange(3), "id": np.arange(3)})
    for name in ("out.csv", "out.xyz"):
        again = read(tmp_path, written(tmp_path, cloud, name), name)
        np.testing.assert_array_equal(again.xyz, cloud.xyz)
        assert list(again.attributes) == ["X", "id"]


@pytest.mark.parametrize("remark", [b"// X Y Z", b"# Coordinates x y z in UTM 32", b"# id x y z of a scan in May"])
def test_a_remark_that_is_no_title_of_the_table_changes_nothing(remark: bytes, tmp_path: Path) -> None:
    np.testing.assert_array_equal(read(tmp_path, remark + b"\n1 2 3 4 5 6\n").xyz, [[1, 2, 3]])


@pytest.mark.parametrize(
    "token",
    [
        b"nan(ind)",
        b"-nan(ind)",
        b"-nan(snan)",
        b"-1.#IND",
        b"-1.#IND00",
        b"1.#QNAN0",
        b"1.#SNAN",
        b"1.#INF",
        b"-1.#INF00",
    ],
)
def test_what_microsofts_runtimes_print_is_no_number_but_no_name_either(token: bytes, tmp_path: Path) -> None:
    """The first row of three such words is none of names, and every token stays as it stands."""
    rows = b"%b %b %b\r\n1 2 3\r\n4 5 %b\r\n" % (token, token, token, token)
    expected = float(token[: token.index(b"1")] + b"inf") if b"INF" in token else np.nan
    cloud = read(tmp_path, rows)
    np.testing.assert_array_equal(cloud.xyz, [[expected] * 3, [1, 2, 3], [4, 5, expected]])
    moved = cloud.xyz + np.array([0.0, 0.5, 0.0])
    assert written(tmp_path, cloud.with_xyz(moved)) == rows.replace(b"1 2 3", b"1 2.5 3").replace(b"4 5 ", b"4 5.5 ")
    ascii_ply = b"ply\nformat ascii 1.0\nelement vertex 3\n"
    ascii_ply += b"".join(b"property float %c\n" % axis for axis in b"xyz") + b"end_header\n" + rows
    np.testing.assert_array_equal(read(tmp_path, ascii_ply, "a.ply").xyz, cloud.xyz)


@pytest.mark.parametrize("nothing", [b"", b"NA", b"null", b"NULL", b"nan", b"NaN", b" "])
@pytest.mark.parametrize("above", [b"", b"x,y,z,w,kind\n"])
def test_a_cell_with_nothing_in_it_is_nan_and_stays_as_it_is(above: bytes, nothing: bytes, tmp_path: Path) -> None:
    raw = above + b"1,2,3,%b,oak\n%b,2,3,5,%b\n7,8,9,6,elm\n" % (nothing, nothing, nothing)
    cloud = read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3], [np.nan, 2, 3], [7, 8, 9]])
    np.testing.assert_array_equal(next(iter(cloud.attributes.values())), [np.nan, 5, 6])
    assert (*cloud.attributes, *cloud.beside) == (("w", "kind") if above else ("column_4", "column_5"))
    assert written(tmp_path, cloud) == raw
    moved = cloud.xyz + np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])
    assert written(tmp_path, cloud.with_xyz(moved)) == raw.replace(b"7,8,", b"7,8.5,")


@pytest.mark.parametrize("above", [b"", b"x,y,z\n"])
@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_a_line_of_delimiters_alone_is_a_point_that_is_missing(above: bytes, end: bytes, tmp_path: Path) -> None:
    for rows in (b"1,2,3\n,,\n\n4,5,6\n", b",,\n1,2,3\n4,5,6\n", b"1,2,3\n4,5,6\n , ,", b"NA,NA,NA\n1,2,3\n4,5,6"):
        raw = (above + rows).replace(b"\n", end)
        cloud = read(tmp_path, raw)
        assert len(cloud) == 3
        np.testing.assert_array_equal(cloud.xyz[np.isfinite(cloud.xyz).all(axis=1)], [[1, 2, 3], [4, 5, 6]])
        assert written(tmp_path, cloud) == raw


@pytest.mark.parametrize("above", [b"", b"x;y;z\n", b"x;y;z;\n"])
def test_a_delimiter_behind_every_row_makes_no_column(above: bytes, tmp_path: Path) -> None:
    cloud = read(tmp_path, above + b"1;2;3;\n2;3;4;\n")
    assert (dict(cloud.attributes), cloud.beside) == ({}, ())
    assert read(tmp_path, b"x;y;z;w\n1;2;3;\n").attributes.keys() == {"w"}
    assert read(tmp_path, above + b"1;2;3;\n2;3;4;oak\n").beside == ("column_4",)


def test_nan_and_infinite_positions_are_read_and_kept(tmp_path: Path) -> None:
    raw = b"nan NaN -nan\ninf -Inf 1e5\n1 2 3\n"
    cloud = read(tmp_path, raw)
    assert np.isnan(cloud.xyz[0]).all()
    assert cloud.xyz[1].tolist() == [np.inf, -np.inf, 1e5]
    assert written(tmp_path, cloud) == raw


def test_a_moved_position_loses_nothing(tmp_path: Path) -> None:
    cloud = read(tmp_path, b"500000.12 5400000.34 1\n" * 50)
    moved = cloud.xyz + torus(50) / 3
    np.testing.assert_array_equal(read(tmp_path, written(tmp_path, cloud.with_xyz(moved))).xyz, moved)


def test_a_new_table_names_its_columns(tmp_path: Path) -> None:
    cloud = PointCloud(torus(3), {"scan id": np.arange(3), "w": np.full(3, 0.1, np.float32)})
    assert written(tmp_path, cloud).startswith(b"# x y z scan_id w\n")
    assert b" 2 0.1\n" in written(tmp_path, cloud)
    assert written(tmp_path, cloud, "out.csv").startswith(b"x,y,z,scan_id,w\n")
    for name in ("out.xyz", "out.csv"):
        again = read_cloud(tmp_path / name)[0]
        np.testing.assert_array_equal(again.xyz, cloud.xyz)
        assert list(again.attributes) == ["scan_id", "w"]


@pytest.mark.parametrize(
    ("source", "raw", "target", "expected"),
    [
        ("a.xyz", b"1 2 3 7\n4 5.50 6 0.5\n", "csv", b"x,y,z,column_4\n1,2,3,7\n4,5.5,6,0.5\n"),
        ("a.xyz", b"# made\n1 2 3\n4 5 6\n", "pts", b"2\n1 2 3\n4 5 6\n"),
        ("a.csv", b"z,y,x,id\n3,2,1,tree\n6,5,4,house\n", "xyz", b"1 2 3\n4 5 6\n"),
        ("a.pts", b"1\n1 2 3 9\n", "xyz", b"# x y z intensity\n1 2 3 9\n"),
        ("a.txt", b"X,Y,Z\n1.00, 2,3\n", "csv", b"X,Y,Z\n1.00, 2,3\n"),  # it has the layout
        ("a.csv", b"1;2.0;3\n", "csv", b"1;2.0;3\n"),  # nothing else was asked for
        ("a.asc", b"2\n1 2 3.0 x\n4 5 6 y\n", "pts", b"2\n1 2 3.0 x\n4 5 6 y\n"),
    ],
)
def test_a_table_is_written_anew_only_where_another_layout_is_wanted(
    source: str, raw: bytes, target: str, expected: bytes, tmp_path: Path
) -> None:
    write_cloud(read(tmp_path, raw, source), tmp_path / "result-1", format_named(target))
    assert (tmp_path / "result-1").read_bytes() == expected


TABBED = {
    "names": b"id\tcolour\tx\ty\tz\n7\tred car\t1\t2\t3\n8\t\t4\t5\t6\n",
    "a first column that is empty": b"\tx\ty\tz\n\t1\t2\t3\n\t4\t5\t6\n",
    "a last column that is empty": b"x\ty\tz\tnote\n1\t2\t3\t\n4\t5\t6\t\r\n",
    "commas in a cell": b"note\tx\ty\tz\na, b\t1\t2\t3\n\t4\t5\t6\n",
    "a blank line": b"x\ty\tz\n\n1\t2\t3\n \n4\t5\t6\n",
    "spaces around": b"# x\ty\tz\n 1 \t 2\t3 \n4\t5\t 6\n",
}


@pytest.mark.parametrize("case", TABBED)
def test_a_cell_between_tabs_may_be_empty_or_hold_spaces(case: str, tmp_path: Path) -> None:
    cloud = read(tmp_path, TABBED[case], "a.tsv")
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3], [4, 5, 6]])
    cloud.xyz[0, 0] = 9
    write_cloud(cloud, tmp_path / "b.tsv", format_named("tsv"))
    assert (tmp_path / "b.tsv").read_bytes() == TABBED[case].replace(b"1", b"9.0", 1)


def test_text_is_never_guessed_from_its_content(tmp_path: Path) -> None:
    with pytest.raises(UnknownFormat):
        read(tmp_path, b"1 2 3\n4 5 6\n", "body")
    assert len(read(tmp_path, b"1 2 3\n4 5 6\n", "body", name="Scan.TXT")) == 2


@pytest.mark.parametrize(
    ("vectors", "are_normals"),
    [
        ("-1 0 0\n0 0.6 0.8\n0 0 0", True),
        ("-0.577 0.577 0.577\n0 0 1\n0.6 0.8 0", True),
        ("1 0 0\n0 1 0\n0 0 1", False),  # pure colours
        ("-1 0 0\n0 0.5 0.8\n0 0 1", False),
        ("-1 0 0\n0 nan 1\n0 0 1", False),
        ("255 0 0\n0 0 255\n0 0 0", False),
        ("0 0 0\n0 0 0\n0 0 0", False),
        ("-1 0 a\n0 0 b\n0 0 c", False),
        ("-1 0 0 1\n0 1 0 1\n0 0 1 1", False),
    ],
)
def test_unit_vectors_behind_positions_are_normals(vectors: str, are_normals: bool, tmp_path: Path) -> None:
    """MeshLab, CGAL and Open3D (.xyzn) write them so, without names."""
    rows = [f"{row}.5 {row} 2 {vector}" for row, vector in enumerate(vectors.split("\n"))]
    raw = "\n".join(rows).encode()
    cloud = read(tmp_path, raw)
    assert cloud.normal_names == (("nx", "ny", "nz") if are_normals else ())
    assert written(tmp_path, cloud) == raw
    if are_normals:
        write_cloud(cloud, out := tmp_path / "out.ply", format_for("out.ply"))
        np.testing.assert_array_equal(read_cloud(out)[0].old_normals(), cloud.old_normals())


@pytest.mark.parametrize(
    ("colours", "are_some"),
    [
        ("1 0 0.5019607843\n0 0.2 0.0039215686", True),  # 10 decimals, as Open3D writes them
        ("1 0 0.501961\n0 0.2 0.003922", True),
        ("1 0 0.2\n0 0.4 0.6", False),  # fifths may be anything
        ("1 0 0\n0 1 1", False),
        ("1 0 0.5\n0 0.2 0.0039215686", False),
        ("1 0 0.5019607843\n0 0.2 nan", False),
        ("1 0 0.5019607843\n0 0.2 red", False),
    ],
)
def test_shares_of_255_behind_positions_are_colours(colours: str, are_some: bool, tmp_path: Path) -> None:
    raw = "\n".join(f"{row}.5 {row} 2 {colour}" for row, colour in enumerate(colours.split("\n"))).encode()
    cloud = read(tmp_path, raw, "a.xyzrgb")
    assert (list(cloud.attributes) == ["red", "green", "blue"]) == are_some
    assert written(tmp_path, cloud, "a.xyzrgb") == raw
    if are_some:
        write_cloud(cloud, out := tmp_path / "out.ply", format_for("out.ply"))
        again = read_cloud(out)[0].attributes
        np.testing.assert_array_equal(np.column_stack([again[name] for name in RGB]), [[255, 0, 128], [0, 51, 1]])
        assert again["red"].dtype == np.uint8


@pytest.mark.parametrize("name", ["a.xyzn", "a.xyzrgb", "a.TSV"])
def test_tables_of_other_names_are_read_as_tables(name: str, tmp_path: Path) -> None:
    raw = b"1\t2\t3\t7\n4\t5\t6\t8\n"
    cloud = read(tmp_path, raw, name)
    np.testing.assert_array_equal(cloud.attributes["column_4"], [7, 8])
    assert written(tmp_path, cloud, name) == raw


def test_every_kind_of_line_end_falls_anywhere_in_a_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for end in (b"\n", b"\r\n", b"\r"):
        raw = end.join(b"%d 2 3" % 10**row for row in range(12)) + end
        for size in range(2, 40):
            monkeypatch.setattr(text, "BLOCK_BYTES", size)
            assert read(tmp_path, raw).xyz[:, 0].tolist() == [10**row for row in range(12)]


@pytest.mark.parametrize("size", [20, 1 << 20])
def test_hashes_of_64_bits_are_read_to_the_last_digit(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those above 2**63 became the nearest float64, and arrived so in every other format, without a word."""
    monkeypatch.setattr(text, "BLOCK_BYTES", size)
    hashes = [2**64 - 1, 7, 2**53 + 1, 2**63 + 1]
    rows = [f"1,2,3,{number},{-number},{number % 8}.5" for number in hashes]
    cloud = read(tmp_path, "\n".join(["x,y,z,hash,below,half", *rows]).encode())
    assert [cloud.attributes[name].dtype for name in ("hash", "below", "half")] == [np.uint64, np.float64, np.float64]
    assert cloud.attributes["hash"].tolist() == hashes
    signed = read(tmp_path, b"x,y,z,a\n1,2,3,18446744073709551615\n1,2,3,-1\n")
    assert signed.attributes["a"].tolist() == [2.0**64, -1]


def test_a_few_long_remarks_take_no_more_memory_than_many(tmp_path: Path) -> None:
    remarks = (b"9" * (390 if row % 1000 == 0 else 5) for row in range(65_536))
    raw = b"x,y,z,w\n" + b"".join(b"%d,1.25,2.5,%b\n" % row for row in enumerate(remarks))
    tracemalloc.start()
    cloud = read(tmp_path, raw)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 48 << 20
    np.testing.assert_array_equal(cloud.attributes["w"] > 1e9, np.arange(65_536) % 1000 == 0)


def test_to_write_a_table_takes_a_few_times_its_size(tmp_path: Path) -> None:
    np.savetxt(path := tmp_path / "a.xyz", torus(200_000), fmt="%.6f")
    cloud, xyz = read_cloud(path)
    tracemalloc.start()
    try:
        write_cloud(cloud.with_xyz(cloud.xyz + 1e-3), tmp_path / "b.xyz", xyz)
        assert tracemalloc.get_traced_memory()[1] < 12 * path.stat().st_size
    finally:
        tracemalloc.stop()
    np.testing.assert_allclose(np.loadtxt(tmp_path / "b.xyz"), cloud.xyz + 1e-3)


@pytest.mark.parametrize(
    "row", ["1,2,3,4,5,6", "1, 2, 3, 4, 5, 6", "10,20,30,255,255,255", "1,2,3,0,0,0", "0,5, 1,5,2,5"]
)
def test_six_columns_of_whole_numbers_are_no_decimal_commas(row: str, tmp_path: Path) -> None:
    cloud = read(tmp_path, f"{row}\n{row}\n".encode())
    assert cloud.xyz[1].tolist() == [float(cell) for cell in row.split(",")[:3]]
