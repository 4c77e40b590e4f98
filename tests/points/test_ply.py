"""PLY as other programs write and break it."""

from __future__ import annotations

import io
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import InvalidCloud, MalformedFile, TooManyPoints, UnsupportedCloud
from straightpcf.points.formats import format_named, read_cloud, text, write_cloud
from tests.clouds import torus
from tests.effort import at_most_lines
from tests.points.samples import SAMPLES

AXES = ["property float x", "property float y", "property float z"]
BINARY, ASCII = "format binary_little_endian 1.0", "format ascii 1.0"


def header(*lines: str) -> bytes:
    return "\n".join(["ply", *lines, "end_header", ""]).encode()


def read(folder: Path, raw: bytes, **options: Any) -> PointCloud:
    (path := folder / "a.ply").write_bytes(raw)
    return read_cloud(path, **options)[0]


def written(folder: Path, cloud: PointCloud) -> bytes:
    write_cloud(cloud, folder / "out.ply", format_named("ply"))
    return (folder / "out.ply").read_bytes()


@pytest.mark.parametrize("sample", [name for name in SAMPLES if name.startswith("ply")])
def test_plyfile_reads_the_same_positions_before_and_after(sample: str, tmp_path: Path) -> None:
    path = SAMPLES[sample](tmp_path)
    cloud = read_cloud(path)[0]
    for raw, xyz in (
        (path.read_bytes(), cloud.xyz),
        (written(tmp_path, cloud.with_xyz(cloud.xyz + 0.5)), cloud.xyz + 0.5),
    ):
        head, body = raw.split(b"end_header", 1)
        ascii_head = bytes(byte if byte < 128 else ord(".") for byte in head)  # plyfile takes ASCII comments only
        vertex = plyfile.PlyData.read(io.BytesIO(ascii_head + b"end_header" + body))["vertex"]
        np.testing.assert_allclose(np.stack([vertex[axis] for axis in "xyz"], axis=1), xyz, atol=1e-6)


def test_only_the_moved_bytes_of_a_binary_file_differ(tmp_path: Path) -> None:
    raw = header(BINARY, "element vertex 50", *AXES, "property uchar red") + np.random.default_rng(0).bytes(50 * 13)
    cloud = read(tmp_path, raw)
    xyz = cloud.xyz.copy()
    xyz[7, 1] = 3.0
    at = len(raw) - 50 * 13 + 7 * 13 + 4
    assert written(tmp_path, cloud.with_xyz(xyz)) == raw[:at] + np.float32(3).tobytes() + raw[at + 4 :]


def test_only_the_moved_tokens_of_a_text_file_differ(tmp_path: Path) -> None:
    raw = header(ASCII, "comment  kept ", "element vertex 2", *AXES) + b"1.000 2e0\t+3\r\n 4 5.50 NaN\r\n"
    cloud = read(tmp_path, raw)
    xyz = cloud.xyz.copy()
    xyz[0, 1] = 0.1
    assert written(tmp_path, cloud.with_xyz(xyz)) == raw.replace(b"2e0", b"0.1")


def test_nan_bits_negative_zero_and_trailing_bytes_are_kept(tmp_path: Path) -> None:
    body = np.array([0x7FC12345, 0x80000000, 0x7F800000, 0, 0, 0], "<u4").tobytes() + b"tail"
    raw = header(BINARY, "element vertex 2", *AXES) + body
    cloud = read(tmp_path, raw)
    xyz = cloud.xyz.copy()
    xyz[1] = 1.0
    assert written(tmp_path, cloud.with_xyz(xyz))[: -4 - 12] == raw[: -4 - 12]
    assert written(tmp_path, cloud.with_xyz(xyz)).endswith(np.ones(3, "<f4").tobytes() + b"tail")


def test_elements_before_the_vertices_are_kept(tmp_path: Path) -> None:
    lists = b"".join(bytes([n]) + np.arange(n, dtype=">i4").tobytes() for n in (0, 3, 1))
    xyz = torus(5).astype(">f8")
    raw = header(
        "format binary_big_endian 1.0",
        "element strip 3",
        "property list uchar int row",
        "element vertex 5",
        *(line.replace("float", "double") for line in AXES),
    )
    cloud = read(tmp_path, raw + lists + xyz.tobytes())
    np.testing.assert_array_equal(cloud.xyz, xyz)
    assert written(tmp_path, cloud.with_xyz(cloud.xyz + 1)) == raw + lists + (xyz + 1).astype(">f8").tobytes()


def test_a_new_file_has_double_positions_and_its_attributes_typed(tmp_path: Path) -> None:
    xyz = np.add(torus(9), [500_000.123456, 5_400_000.0, 0.0])
    cloud = PointCloud(
        xyz, {"feature": np.ones((9, 3), np.float32), "my label": np.arange(9), "text": np.array(["a"] * 9)}
    )
    vertex = plyfile.PlyData.read(io.BytesIO(written(tmp_path, cloud)))["vertex"]
    np.testing.assert_array_equal(np.stack([vertex[axis] for axis in "xyz"], axis=1), xyz)
    assert vertex["feature_2"].dtype == np.float32
    np.testing.assert_array_equal(vertex["my_label"], np.arange(9))


def test_blank_lines_between_rows_are_passed_over_and_kept(tmp_path: Path) -> None:
    head = header(ASCII, "element mark 2", "element vertex 2", *AXES, "element face 1", "property list uchar int i")
    raw = head + b"\n\n\n1 2 3\n \t\n\r\n4 5 6\n\n3 0 1 1\n\n"  # the first two are the rows of `mark`
    cloud = read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3], [4, 5, 6]])
    assert written(tmp_path, cloud) == raw
    xyz = cloud.xyz.copy()
    xyz[1, 1] = 5.5
    assert written(tmp_path, cloud.with_xyz(xyz)) == raw.replace(b"4 5 6", b"4 5.5 6")
    with pytest.raises(MalformedFile, match=r"line 19: .* ends after 3 values, within property i"):
        read(tmp_path, raw.replace(b"3 0 1 1", b"3 0 1"))


def test_a_header_of_very_many_elements_is_refused_at_once(tmp_path: Path) -> None:
    many = header(ASCII, *VERTICES, *(f"element e{number} 0" for number in range(40_000)))
    with at_most_lines(2_000_000), pytest.raises(UnsupportedCloud, match=r"more than 1024 elements"):
        read(tmp_path, many)
    properties = [f"property char {number}" for number in range(4000)]
    elements = [line for number in range(12) for line in (f"element {number} 0", *properties)]
    many = header(ASCII, *elements, VERTICES[0])
    with at_most_lines(8_000_000), pytest.raises(MalformedFile, match=r"no property x"):
        read(tmp_path, many)


@pytest.mark.parametrize("encoding", [ASCII, BINARY])
@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_a_byte_order_mark_and_blank_lines_in_the_header_are_kept(encoding: str, end: bytes, tmp_path: Path) -> None:
    xyz = np.array([[10.0, 13.0, 0.0]])
    body = b"10 13 0\n" if encoding == ASCII else xyz.astype("<f4").tobytes()
    raw = b"\xef\xbb\xbf" + header("", encoding, " ", "element vertex 1", *AXES, "").replace(b"\n", end) + body
    cloud = read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz, xyz)
    assert written(tmp_path, cloud) == raw
    again = read(tmp_path, written(tmp_path, cloud.with_xyz(xyz + 1)))
    assert again.source.raw.startswith(raw[: -len(body)])
    np.testing.assert_array_equal(again.xyz, xyz + 1)


@pytest.mark.parametrize("encoding", [ASCII, BINARY])
def test_axes_may_be_capitals(encoding: str, tmp_path: Path) -> None:
    capitals = [line[:-1] + line[-1].upper() for line in AXES]
    body = b"1 2 3 4\n" if encoding == ASCII else np.array([1, 2, 3, 4], "<f4").tobytes()
    raw = header(encoding, "element vertex 1", *capitals, "property float q") + body
    cloud = read(tmp_path, raw)
    assert list(cloud.attributes) == ["q"]
    again = read(tmp_path, written(tmp_path, cloud.with_xyz(cloud.xyz + 1)))
    assert again.xyz.tolist() == [[2, 3, 4]]
    assert again.source.raw.startswith(raw[: -len(body)])
    with_both = read(tmp_path, header(ASCII, "element vertex 1", *AXES, *capitals) + b"1 2 3 4 5 6\n")
    assert with_both.xyz.tolist() == [[1, 2, 3]]
    assert list(with_both.attributes) == ["X", "Y", "Z"]


@pytest.mark.parametrize("encoding", [ASCII, BINARY])
@pytest.mark.parametrize("kind", ["short", "int"])
def test_positions_of_whole_numbers_are_read_to_be_converted_and_never_rounded(
    kind: str, encoding: str, tmp_path: Path
) -> None:
    """Millimetres, for one: the result of the filter is none of them."""
    xyz = np.array([[1, -2, 3], [40, 50, -60]], {"short": "<i2", "int": "<i4"}[kind])
    body = b"1 -2 3\n40 50 -60\n" if encoding == ASCII else xyz.tobytes()
    raw = header(encoding, "element vertex 2", *(line.replace("float", kind) for line in AXES)) + body
    cloud = read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz, xyz)
    assert written(tmp_path, cloud) == raw
    moved = cloud.with_xyz(cloud.xyz + 0.25)
    for refused in (lambda: format_named("ply").check(cloud), lambda: written(tmp_path, moved)):
        with pytest.raises(UnsupportedCloud, match=r"property x .* int(16|32), .* another format"):
            refused()
    write_cloud(moved, out := tmp_path / "a.pcd", format_named("pcd"))
    np.testing.assert_array_equal(read_cloud(out)[0].xyz, xyz + 0.25)


def test_a_header_of_very_many_lines_is_refused_at_once(tmp_path: Path) -> None:
    raw = b"ply\n" + b"\n" * ((1 << 20) - 100) + b"x" * 70_000
    began = time.process_time()
    with pytest.raises(MalformedFile):
        read(tmp_path, raw)
    assert time.process_time() - began < 1.5  # 0.3 s; 3 s when each line was looked for in a copy of 64 KiB


def test_small_elements_of_text_are_taken_apart_without_the_vertices_behind_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each had up to eight megabytes taken apart into tokens, for its one row."""
    small = [line for number in range(100) for line in (f"element e{number} 1", "property float a")]
    raw = header(ASCII, *small, "element vertex 100000", *AXES) + b"\n7\n" * 100 + b"1 2 3\n" * 100_000
    split, taken_apart = text._split, []

    def counted(raw: bytes, begin: int, end: int, delimiter: bytes | None) -> text.Lines:
        taken_apart.append(end - begin)
        return split(raw, begin, end, delimiter)

    monkeypatch.setattr(text, "_split", counted)
    cloud = read(tmp_path, raw)
    assert sum(taken_apart) < 2 * len(raw)
    xyz = cloud.xyz.copy()
    xyz[-1] = 4, 5, 6
    assert written(tmp_path, cloud.with_xyz(xyz)) == raw[: -len(b"1 2 3\n")] + b"4.0 5.0 6.0\n"


@pytest.mark.parametrize("counter", ["uchar", "int"])
def test_a_mesh_of_triangles_and_quads_is_read_in_no_time(counter: str, tmp_path: Path) -> None:
    kind = {"uchar": "<u1", "int": "<i4"}[counter]
    faces = b"".join(np.array(n, kind).tobytes() + np.arange(n, dtype="<i4").tobytes() for n in (3, 4)) * 200_000
    raw = header(BINARY, "element vertex 1", *AXES, "element face 400000", f"property list {counter} int i") + bytes(12)
    began = time.process_time()
    cloud = read(tmp_path, raw + faces)
    assert time.process_time() - began < 2  # 0.1 s; 3 s when rows were compared in runs
    assert written(tmp_path, cloud) == raw + faces
    with pytest.raises(MalformedFile, match=r"row 399999 of element face at byte .*, property i,.* truncated"):
        read(tmp_path, raw + faces[:-1])


def test_uneven_vertices_take_memory_as_their_bytes_do(tmp_path: Path) -> None:
    properties = [f"property char a{number}" for number in range(2000)]
    raw = header(BINARY, "element vertex 500", *AXES, *properties, "property list uchar uchar l")
    raw += b"".join(bytes(2012) + (b"\1\7" if row % 2 else b"\0") for row in range(500))
    tracemalloc.start()
    try:
        read(tmp_path, raw)
        assert tracemalloc.get_traced_memory()[1] < 5 * len(raw)
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("counter", ["char", "uchar", "short", "ushort", "int", "uint", "int64", "uint64"])
def test_vertices_between_lists_of_any_length_are_found_and_moved(counter: str, order: str, tmp_path: Path) -> None:
    sign = "<" if order == "little" else ">"
    names = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
    kind = sign + names.get(counter, counter.replace("uint64", "u8").replace("int64", "i8"))
    raw = header(
        f"format binary_{order}_endian 1.0", "element vertex 9", AXES[0], f"property list {counter} short l", AXES[1],
        f"property list {counter} uchar m", AXES[2], "property ushort id",
    )  # fmt: skip
    for row, xyz in enumerate(torus(9)):
        x, y, z = (np.array(value, sign + "f4") for value in xyz)
        lists = [np.array(n, kind).tobytes() + bytes(n * width) for n, width in ((row % 3, 2), (row % 2 * 5, 1))]
        raw += x.tobytes() + lists[0] + y.tobytes() + lists[1] + z.tobytes() + np.array(row, sign + "u2").tobytes()
    cloud = read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz, torus(9).astype(np.float32))
    assert cloud.attributes["id"].tolist() == list(range(9))
    again = read(tmp_path, out := written(tmp_path, cloud.with_xyz(cloud.xyz + 1)))
    np.testing.assert_allclose(again.xyz, cloud.xyz + 1, atol=1e-6)
    assert len(out) == len(raw)
    assert written(tmp_path, again.with_xyz(cloud.xyz)) == raw


VERTICES = ("element vertex 4", *AXES)
MALFORMED: dict[str, tuple[bytes, type[InvalidCloud], str]] = {
    "no end of header": (b"ply\nformat ascii 1.0\n", MalformedFile, "end_header"),
    "an endless line": (b"ply\ncomment " + b"a" * 5_000_000, MalformedFile, "line 2 .* 65536"),
    "an endless header": (b"ply\n" + b"comment a\n" * 200_000, MalformedFile, "1048576"),
    "no format": (header(*VERTICES), MalformedFile, "line 2"),
    "unknown format": (header("format ascii 2.0", *VERTICES), MalformedFile, "line 2"),
    "no vertex": (header(ASCII, "element face 0"), MalformedFile, "no element vertex"),
    "no z": (header(ASCII, "element vertex 0", *AXES[:2]), MalformedFile, "no property z"),
    "list z": (header(ASCII, "element vertex 0", *AXES[:2], "property list int float z"), UnsupportedCloud, "a list"),
    "long z": (header(ASCII, "element vertex 0", *AXES[:2], "property int64 z"), UnsupportedCloud, "int64.*float"),
    "unknown type": (header(ASCII, "element vertex 0", "property half x"), MalformedFile, "line 4.*half"),
    "property twice": (header(ASCII, "element vertex 0", AXES[0], AXES[0]), MalformedFile, "line 5.*x.*twice"),
    "element twice": (header(ASCII, "element vertex 0", "element vertex 0"), MalformedFile, "line 4.*twice"),
    "negative count": (header(ASCII, "element vertex -4", *AXES), MalformedFile, "line 3.*-4"),
    "no number": (header(ASCII, "element vertex many", *AXES), MalformedFile, "line 3.*many"),
    "huge number": (header(ASCII, f"element vertex {10**30}", *AXES), MalformedFile, "line 3"),
    "truncated": (header(BINARY, *VERTICES) + bytes(47), MalformedFile, "48 bytes.* 47"),
    "one vertex more": (
        header(ASCII, *VERTICES) + b"0 0 0\n" * 4 + b"\n0 0 0\n",
        MalformedFile,
        "4 rows, and line 13 is",
    ),
    "truncated text": (header(ASCII, *VERTICES) + b"0 0 0\n" * 3, MalformedFile, "4 rows"),
    "short row": (header(ASCII, *VERTICES) + b"0 0 0\n0 0\n0 0 0\n0 0 0\n0\n", MalformedFile, "line 9.* 2 values"),
    "long row": (header(ASCII, *VERTICES) + b"0 0 0 0\n" * 4, MalformedFile, "line 8.* 4 values"),
    "bad token": (header(ASCII, *VERTICES) + b"0 0 0\n0 0 1,5\n0 0 0\n0 0 0\n", MalformedFile, "line 9.*1,5"),
    "list bomb": (
        header(BINARY, "element vertex 1", *AXES, "property list uint int w") + bytes(12) + b"\xff" * 4,
        MalformedFile,
        "property w",
    ),
    "negative list": (
        header(BINARY, "element vertex 1", *AXES, "property list int int w") + bytes(12) + b"\xff" * 4,
        MalformedFile,
        "length -1",
    ),
    "a list of 2**64 - 1": (
        header(BINARY, "element vertex 1", *AXES, "property list uint64 int w", "property char q")
        + bytes(12)
        + b"\xff" * 9,
        MalformedFile,
        "property w",
    ),
    "a list that turns back": (
        header(BINARY, *VERTICES, "element e 2", "property list char int i") + bytes(48) + b"\xff" * 2 + bytes(20),
        MalformedFile,
        "row 0 of element e .* length -1",
    ),
    "truncated faces": (
        header(BINARY, *VERTICES, "element face 1", "property list uchar int i") + bytes(48) + b"\x03" + bytes(11),
        MalformedFile,
        "element face",
    ),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_file_is_refused_naming_the_place(case: str, tmp_path: Path) -> None:
    raw, error, pattern = MALFORMED[case]
    with pytest.raises(error, match=pattern):
        read(tmp_path, raw)


@pytest.mark.parametrize("encoding", [ASCII, BINARY])
@pytest.mark.parametrize("count", [10**9, 4 * 10**9])
def test_a_count_beyond_the_limit_is_refused_before_memory_is_taken(encoding: str, count: int, tmp_path: Path) -> None:
    raw = header(encoding, f"element vertex {count}", *AXES) + b"0 0 0\n"
    with pytest.raises(TooManyPoints, match=f"{count}.*100000000"):
        read(tmp_path, raw)
    with pytest.raises(MalformedFile, match=str(count)):
        read(tmp_path, raw, max_points=10**10)


def test_a_position_that_float32_cannot_hold_is_refused(tmp_path: Path) -> None:
    cloud = read(tmp_path, header(BINARY, *VERTICES) + bytes(48))
    with pytest.raises(UnsupportedCloud, match=r"1e\+300"):
        written(tmp_path, cloud.with_xyz(np.full((4, 3), 1e300)))
