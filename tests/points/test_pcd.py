"""PCD of every encoding: what moves is rewritten in place, blank lines and comments stay, sizes are checked first."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, TooManyBytes, UnsupportedCloud
from straightpcf.points.formats import format_named, lzf, read_cloud, write_cloud
from tests.clouds import torus
from tests.effort import at_most_lines
from tests.points.foreign_samples import pcd

HEADER = (
    b"# made by hand\nVERSION .7\n# two\nFIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    b"WIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n"
)


def _read(folder: Path, raw: bytes) -> PointCloud:
    (path := folder / "a.pcd").write_bytes(raw)
    return read_cloud(path)[0]


def _written(folder: Path, cloud: PointCloud) -> bytes:
    write_cloud(cloud, out := folder / "out.pcd", format_named("pcd"))
    return out.read_bytes()


@pytest.mark.parametrize(("offset", "size"), [(0.0, 4), (500_000.0, 8)])
def test_a_new_file_has_float_positions_where_they_hold_the_cloud(offset: float, size: int, tmp_path: Path) -> None:
    xyz = torus(100) + offset
    write_cloud(PointCloud(xyz), out := tmp_path / "new.pcd", format_named("pcd"))
    assert f"SIZE {size} {size} {size}\n".encode() in out.read_bytes()
    np.testing.assert_allclose(read_cloud(out)[0].xyz, xyz, rtol=0, atol=1e-6)


@pytest.mark.parametrize("far", [0.0, 1e30, 1e39])
def test_a_far_point_does_not_make_float_positions_of_a_town(far: float, tmp_path: Path) -> None:
    xyz = torus(100) * 10 + [691_000.0, 5_334_000.0, 520.0]
    xyz[0] = far
    write_cloud(PointCloud(xyz), out := tmp_path / "new.pcd", format_named("pcd"))
    np.testing.assert_array_equal(read_cloud(out)[0].xyz, xyz)


def test_blank_lines_between_points_are_skipped_and_kept(tmp_path: Path) -> None:
    raw = HEADER + b"\n1 2 3 7\n\n \t\n4 5 6 8\r\n\r\nnan nan nan 9\n\nrest"
    cloud = _read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz[:2], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.attributes["label"], [7, 8, 9])
    assert _written(tmp_path, cloud) == raw
    xyz = cloud.xyz.copy()
    xyz[1, 2] = 6.5
    assert _written(tmp_path, cloud.with_xyz(xyz)) == raw.replace(b"4 5 6 8", b"4 5 6.5 8")


@pytest.mark.parametrize("first", [b"# .PCD v0.7\n", b"# made by hand\n", b""])
@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_a_byte_order_mark_is_kept(encoding: str, first: bytes, tmp_path: Path) -> None:
    plain = _read(tmp_path, pcd(encoding))
    raw = b"\xef\xbb\xbf" + first + pcd(encoding)[pcd(encoding).index(b"VERSION") :]
    cloud = _read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz, plain.xyz)
    assert _written(tmp_path, cloud) == raw
    again = _read(tmp_path, _written(tmp_path, cloud.with_xyz(plain.xyz + 1)))
    assert again.source.raw.startswith(raw[: raw.index(b"DATA")])
    np.testing.assert_allclose(again.xyz, plain.xyz + 1, rtol=1e-6)
    assert [*again.attributes] == [*plain.attributes]


def test_more_rows_than_points_are_refused(tmp_path: Path) -> None:
    """They would come back as they were, among points that were denoised."""
    with pytest.raises(MalformedFile, match=r"PCD POINTS is 3, and line 18 is one more"):
        _read(tmp_path, HEADER + b"1 2 3 7\n4 5 6 8\n\n7 8 9 9\n\n1 1 1 1\n")


def test_keywords_may_stand_before_tabs(tmp_path: Path) -> None:
    raw = HEADER.replace(b"# made by hand\n", b"").replace(b" ", b"\t") + b"1 2 3 7\n4 5 6 8\n7 8 9 9\n"
    assert _read(tmp_path, raw).xyz[2].tolist() == [7, 8, 9]


def test_old_files_have_columns_of_float32_and_a_number_of_points(tmp_path: Path) -> None:
    raw = b"COLUMNS x y z w\nPOINTS 3\nDATA ascii\n1 2 3 7\n4 5 6 8\n7 8 9 9\n"
    (path := tmp_path / "old").write_bytes(raw)
    cloud, format = read_cloud(path)
    assert format.name == "pcd"
    assert cloud.xyz[2].tolist() == [7, 8, 9]
    assert cloud.attributes["w"].tolist() == [7, 8, 9]
    assert _written(tmp_path, cloud) == raw
    for wrong, message in ((b"FIELDS x y z w", "there twice"), (b"SIZE 4 4 4 4", "no TYPE"), (b"HEIGHT 1", "no WIDTH")):
        with pytest.raises(MalformedFile, match=message):
            _read(tmp_path, raw.replace(b"POINTS", wrong + b"\nPOINTS"))


ROWS = b"1 2 3 7\n4 5 6 8\n7 8 9 9\n"


@pytest.mark.parametrize(
    ("old", "new", "beside"),
    [
        (b"", b"", ()),
        (b"WIDTH 3\nHEIGHT 1", b"WIDTH 1\nHEIGHT 3", ("organised shape 1 x 3",)),
        (b"0 0 0 1 0 0 0", b"0.0 -0 0 1.000 0 0 0e0", ()),
        (b"0 0 0 1 0 0 0", b"1 2.5 3 1 0 0 0", ("viewpoint 1 2.5 3 1 0 0 0",)),
        (b"0 0 0 1 0 0 0", b"0 0 0 0.5 0.5 0.5 0.5", ("viewpoint 0 0 0 0.5 0.5 0.5 0.5",)),
        (b"HEIGHT 1", b"HEIGHT 1\nCOORDINATE left handed", ("header line COORDINATE",)),
    ],
)
@pytest.mark.parametrize("encoding", [b"ascii", b"binary"])
def test_what_the_header_says_beside_its_fields_is_named_where_it_is_left_behind(
    old: bytes, new: bytes, beside: tuple[str, ...], encoding: bytes, tmp_path: Path
) -> None:
    body = ROWS if encoding == b"ascii" else b"".join(struct.pack("<3fI", *row) for row in np.arange(12).reshape(3, 4))
    raw = HEADER.replace(old, new).replace(b"DATA ascii", b"DATA " + encoding) + body
    cloud = _read(tmp_path, raw)
    assert format_named("ply").left_behind(cloud) == list(beside)
    moved = _written(tmp_path, cloud.with_xyz(cloud.xyz + 1))
    assert moved.startswith(raw[: -len(body)])
    assert _written(tmp_path, _read(tmp_path, moved).with_xyz(cloud.xyz + 1)) == moved


@pytest.mark.parametrize("keyword", [b"COUNTS", b"count", b"Size"])
def test_a_keyword_that_is_nearly_known_is_not_passed_over(keyword: bytes, tmp_path: Path) -> None:
    known = keyword.upper().rstrip(b"S")
    with pytest.raises(MalformedFile, match=rf"is unknown.*{keyword.decode()}"):
        _read(tmp_path, HEADER.replace(b"\n" + known, b"\n" + keyword) + ROWS)


def test_letters_of_types_may_be_small(tmp_path: Path) -> None:
    raw = HEADER.replace(b"TYPE F F F U", b"TYPE f f f u") + ROWS
    cloud = _read(tmp_path, raw)
    assert cloud.attributes["label"].dtype == np.uint32
    assert _written(tmp_path, cloud) == raw


@pytest.mark.parametrize("encoding", [b"ascii", b"binary"])
def test_truth_values_as_pcl_writes_them_are_read(encoding: bytes, tmp_path: Path) -> None:
    rows = [(1, 2, 3, 1), (4, 5, 6, 0), (7, 8, 9, 1)]
    text = b"".join(b"%d %d %d %d\n" % row for row in rows)
    body = text if encoding == b"ascii" else b"".join(struct.pack("<3f?", *row) for row in rows)
    raw = HEADER.replace(b"SIZE 4 4 4 4\nTYPE F F F U", b"SIZE 4 4 4 1\nTYPE F F F B")
    raw = raw.replace(b"ascii", encoding) + body
    cloud = _read(tmp_path, raw)
    assert cloud.attributes["label"].tolist() == [1, 0, 1]
    assert _written(tmp_path, cloud.with_xyz(cloud.xyz + 1)).startswith(raw[: -len(body)])


@pytest.mark.parametrize("encoding", [b"ascii", b"binary"])
def test_axes_may_be_capitals(encoding: bytes, tmp_path: Path) -> None:
    body = ROWS if encoding == b"ascii" else np.arange(12, dtype="<f4").tobytes()
    raw = HEADER.replace(b"x y z label", b"X Y Z w").replace(b"F F F U", b"F F F F")
    raw = raw.replace(b"DATA ascii", b"DATA " + encoding) + body
    cloud = _read(tmp_path, raw)
    assert list(cloud.attributes) == ["w"]
    again = _read(tmp_path, _written(tmp_path, cloud.with_xyz(cloud.xyz + 1)))
    np.testing.assert_array_equal(again.xyz, cloud.xyz + 1)
    assert _written(tmp_path, again.with_xyz(cloud.xyz)).startswith(raw[: -len(body)])
    with pytest.raises(MalformedFile, match="there is no y"):
        _read(tmp_path, raw.replace(b"X Y Z", b"x Y Z"))


GREEN_AS_FLOAT = repr(float(np.array([0xFF00], "<u4").view("<f4")[0])).encode()


@pytest.mark.parametrize(
    ("kind", "texts", "expected"),
    [
        (b"I", (b"4278255360", b"16711680", b"255"), [[0, 255, 0], [255, 0, 0], [0, 0, 255]]),
        (b"F", (GREEN_AS_FLOAT, b"nan", b"-nan"), [[0, 255, 0], [0, 0, 0], [0, 0, 0]]),
    ],
)
def test_packed_colours_of_text_survive_a_conversion(
    kind: bytes, texts: tuple[bytes, ...], expected: list[list[int]], tmp_path: Path
) -> None:
    rows = b"".join(b"%d 0 0 %s\n" % (row, text) for row, text in enumerate(texts))
    raw = HEADER.replace(b"label", b"rgb").replace(b"TYPE F F F U", b"TYPE F F F " + kind) + rows
    cloud = _read(tmp_path, raw)
    assert cloud.attributes["rgb"].dtype.itemsize == 4
    assert _written(tmp_path, cloud) == raw
    write_cloud(cloud, out := tmp_path / "a.ply", format_named("ply"))
    found = read_cloud(out)[0].attributes
    colours = np.stack([found[name] for name in ("red", "green", "blue")], axis=1).tolist()
    assert colours == expected
    assert ("alpha" in found) is (kind == b"I")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"1 2 3 7\n\n4 5 6\n7 8 9 1\n", r"line 15 has 3 values, the PCD fields have 4"),
        (b"1 2 3 7\n\n4 5 six 8\n7 8 9 1\n", r"line 15: z is 'six'"),
        (b"1 2 3 7\n\n\n4 5 6 -8\n7 8 9 1\n", r"line 16: label is '-8', no uint32"),
        (b"1 2 3 7\n\n4 5 6 8\n\n\n\n\n\n\n\n\n\n", r"POINTS is 3, the file ends after 2: it is truncated"),
        (b"1 2 3 7\n4 5 6 8\n", r"needs at least 23 bytes, the file has 16: it is truncated"),
        (b"1 2 3 7\n4 5 6 8\n\0 2 3 4567890\n", r"0x00"),
    ],
)
def test_a_broken_line_is_named_by_its_number_in_the_file(body: bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(MalformedFile, match=message):
        _read(tmp_path, HEADER + body)


def test_a_moved_binary_file_differs_in_nothing_but_the_moved_floats(tmp_path: Path) -> None:
    raw = pcd("binary")
    cloud = _read(tmp_path, raw)
    xyz = cloud.xyz.copy()
    xyz[20] += 1
    out = _written(tmp_path, cloud.with_xyz(xyz))
    differs = np.flatnonzero(np.frombuffer(out, np.uint8) != np.frombuffer(raw, np.uint8))
    row = 4 + 4 + 3 + 4 + 8 + 4 + 4
    begin = raw.index(b"DATA binary\n") + 12 + 20 * row
    assert len(out) == len(raw)
    assert differs.min() >= begin + 4
    assert differs.max() < begin + 23
    assert not set(range(8, 11)) & set((differs - begin).tolist())  # the padding


@pytest.mark.parametrize(("packed", "size"), [(0, 2**32 - 1), (4, -4), (0, 0)])
def test_sizes_of_compressed_data_that_cannot_be_are_refused(packed: int, size: int, tmp_path: Path) -> None:
    raw = bytearray(pcd("binary_compressed"))
    at = raw.index(b"binary_compressed\n") + 18
    struct.pack_into("<I", raw, at + packed, size % 2**32)
    with pytest.raises(MalformedFile, match=r"truncated|unpacked|LZF"):
        _read(tmp_path, bytes(raw))


def test_a_compressed_bomb_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    """1000 points of 300 kB each, nearly all zeros, in some 3.4 MB."""
    head = "VERSION 0.7\nFIELDS x y z pad\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 75000\nWIDTH 1000\nHEIGHT 1\n"
    head += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1000\nDATA binary_compressed\n"
    size = 1000 * 300_012
    packed = bytes(size // 89 + 1)
    raw = head.encode() + struct.pack("<II", len(packed), size) + packed
    tracemalloc.start()
    try:
        with pytest.raises(TooManyBytes, match=rf"PCD data declares {size} bytes unpacked; the limit for {len(raw)}"):
            _read(tmp_path, raw)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("padding", [4093, 500_000])
def test_a_megabyte_of_padding_fields_is_read_or_refused_at_once(padding: int, tmp_path: Path) -> None:
    """Each is called `_`; told apart one by one, with ever longer labels, half a million never ended."""
    head = f"FIELDS x y z{' _' * padding}\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA binary\n".encode()
    with at_most_lines(400_000):
        if padding < 4096:
            assert not _read(tmp_path, head + bytes(3 * 4 * (3 + padding))).attributes
        else:
            with pytest.raises(UnsupportedCloud, match="500003 FIELDS; the limit is 4096"):
                _read(tmp_path, head)


def test_a_moved_value_that_float32_cannot_hold_is_named(tmp_path: Path) -> None:
    cloud = _read(tmp_path, pcd("binary"))
    with pytest.raises(UnsupportedCloud, match=r"1e\+300 does not fit into float32"):
        _written(tmp_path, cloud.with_xyz(np.full_like(cloud.xyz, 1e300)))


def test_lzf_takes_a_few_steps_a_byte_at_worst() -> None:
    raw = torus(41_600).astype("<f4").tobytes()
    with at_most_lines(len(raw)):
        packed = lzf.compress(raw)
        assert lzf.decompress(packed, len(raw)) == raw
    assert len(packed) < 1.04 * len(raw)
    short_matches = b"\x00a" + b"\x20\x00" * 80_000
    with at_most_lines(10 * len(short_matches)):
        assert lzf.decompress(short_matches, 240_001) == b"a" * 240_001


@pytest.mark.parametrize(
    ("values", "is_float"),
    [
        (np.arange(50, dtype=np.uint16) * 1300, True),  # LAS
        (np.arange(50) / 10, True),  # a text's
        (np.where(np.arange(50) % 5, 0.25, np.nan), True),
        (np.arange(50) / 3, False),
        (np.arange(50) + 2**60, False),
        (np.full(50, 1e300), False),
    ],
)
def test_a_new_file_has_an_intensity_that_pcl_reads_where_that_loses_nothing(
    values: npt.NDArray[Any], is_float: bool, tmp_path: Path
) -> None:
    """PointXYZI takes a float alone: of any other type there was 0."""
    cloud = PointCloud(torus(50), {"Intensity": values, "ring": values})
    write_cloud(cloud, out := tmp_path / "out.pcd", format_named("pcd"))
    found = read_cloud(out)[0].attributes
    assert [*found] == ["intensity", "ring"]
    assert found["intensity"].dtype == (np.float32 if is_float else values.dtype)
    np.testing.assert_allclose(found["intensity"], values, rtol=1e-7 * is_float)
    np.testing.assert_array_equal(found["ring"], values)


def test_a_new_file_has_normals_that_pcl_reads(tmp_path: Path) -> None:
    normals = torus(50) / 3
    cloud = PointCloud(torus(50), dict(zip(("Nx", "Ny", "Nz"), normals.T, strict=True)))
    write_cloud(cloud, out := tmp_path / "out.pcd", format_named("pcd"))
    found = read_cloud(out)[0]
    assert {found.attributes[name].dtype for name in ("normal_x", "normal_y", "normal_z")} == {np.dtype(np.float32)}
    np.testing.assert_allclose(found.old_normals(), normals, atol=1e-7)
