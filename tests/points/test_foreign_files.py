"""LAS, LAZ and PCD as other programs write them: fields kept, laspy reads what we write, broken ones are named."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from straightpcf.points.errors import MalformedFile, StraightPCFError, TooManyPoints, UnsupportedCloud
from straightpcf.points.formats import format_named, lzf, read_cloud, write_cloud
from tests.points.foreign_samples import OTHER_SAMPLES, N, pcd

laspy = pytest.importorskip("laspy", reason="the extra straightpcf[las] is not installed")
SHIFT = np.array([0.5, -0.25, 1.0])
LAS_SAMPLES = [name for name in OTHER_SAMPLES if name.startswith("la")]


@pytest.fixture(params=OTHER_SAMPLES)
def sample(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return OTHER_SAMPLES[request.param](tmp_path)


def test_a_file_of_another_program_comes_back_byte_for_byte(sample: Path) -> None:
    cloud, format = read_cloud(sample)
    assert len(cloud) == N
    write_cloud(cloud.with_xyz(cloud.xyz.copy()), out := sample.with_name(f"out{sample.suffix}"), format)
    assert out.read_bytes() == sample.read_bytes()


def test_moved_points_leave_every_other_field_and_point_as_it_was(sample: Path) -> None:
    cloud, format = read_cloud(sample)
    moved = cloud.xyz.copy()
    moved[::2] += 0.25
    write_cloud(cloud.with_xyz(moved), out := sample.with_name(f"out{sample.suffix}"), format)
    again, same = read_cloud(out)
    assert same is format
    np.testing.assert_array_equal(again.xyz[1::2], cloud.xyz[1::2])
    np.testing.assert_allclose(again.xyz, moved, atol=0.006)
    for name, values in cloud.attributes.items():
        np.testing.assert_array_equal(again.attributes[name], values)
    write_cloud(again.with_xyz(cloud.xyz), back := sample.with_name(f"back{sample.suffix}"), format)
    restored, _ = read_cloud(back)
    np.testing.assert_array_equal(restored.xyz, cloud.xyz)


@pytest.mark.parametrize("name", LAS_SAMPLES)
@pytest.mark.parametrize("target", ["las", "laz"])
def test_laspy_finds_every_dimension_and_record_in_what_we_write(name: str, target: str, tmp_path: Path) -> None:
    path = OTHER_SAMPLES[name](tmp_path)
    cloud, _ = read_cloud(path)
    write_cloud(cloud.with_xyz(cloud.xyz + SHIFT), out := tmp_path / f"out.{target}", format_named(target))
    before, after = laspy.read(path), laspy.read(out)
    np.testing.assert_allclose(after.xyz, before.xyz + SHIFT, atol=0.006)
    assert str(after.header.version) == str(before.header.version)
    assert after.point_format.id == before.point_format.id
    for dimension in before.point_format.dimension_names:
        if dimension not in ("X", "Y", "Z"):
            np.testing.assert_array_equal(np.asarray(after[dimension]), np.asarray(before[dimension]))
    kept = [v.record_data_bytes() for v in before.vlrs]
    assert [v.record_data_bytes() for v in after.vlrs] == kept
    assert [v.record_data_bytes() for v in after.evlrs or []] == [v.record_data_bytes() for v in before.evlrs or []]
    np.testing.assert_allclose(after.header.mins, after.xyz.min(axis=0), atol=1e-9)
    np.testing.assert_allclose(after.header.maxs, after.xyz.max(axis=0), atol=1e-9)


@pytest.mark.parametrize("name", LAS_SAMPLES)
def test_our_dimensions_are_those_that_laspy_reads(name: str, tmp_path: Path) -> None:
    path = OTHER_SAMPLES[name](tmp_path)
    cloud, theirs = read_cloud(path)[0], laspy.read(path)
    np.testing.assert_array_equal(cloud.xyz, theirs.xyz)
    for field in (
        "intensity",
        "return_number",
        "number_of_returns",
        "classification",
        "point_source_id",
        "reflectance",
    ):
        np.testing.assert_array_equal(cloud.attributes[field], np.asarray(theirs[field]), err_msg=field)
    for field in {"gps_time", "red", "nir", "scan_angle", "scan_angle_rank"} & set(theirs.point_format.dimension_names):
        np.testing.assert_array_equal(cloud.attributes[field], np.asarray(theirs[field]), err_msg=field)


def test_laspy_reads_a_new_file_with_its_attributes(tmp_path: Path) -> None:
    cloud, _ = read_cloud(OTHER_SAMPLES["pcd binary"](tmp_path))
    xyz = np.nan_to_num(cloud.xyz) * 50 + np.array([500_000, 4_000_000, 100])
    write_cloud(cloud.with_xyz(xyz), out := tmp_path / "new.laz", format_named("laz"))
    theirs = laspy.read(out)
    np.testing.assert_allclose(theirs.xyz, xyz, atol=1e-4)
    np.testing.assert_array_equal(theirs["label"], cloud.attributes["label"])
    for name, shift in {"red": 16, "green": 8, "blue": 0}.items():
        np.testing.assert_array_equal(theirs[name], (cloud.attributes["rgba"] >> shift & 255) * 257)


def test_a_point_that_has_no_place_in_32_bits_is_named(tmp_path: Path) -> None:
    cloud, format = read_cloud(OTHER_SAMPLES["las 1.2 format 3"](tmp_path))
    for value in (1e12, np.nan, np.inf, -1e300):
        xyz = cloud.xyz.copy()
        xyz[7, 1] = value
        with pytest.raises(UnsupportedCloud, match=r"new y of point 7.*32 bits.*scale 0\.001"):
            write_cloud(cloud.with_xyz(xyz), tmp_path / "out.las", format)


@pytest.mark.parametrize(
    ("at", "kind", "value", "message"),
    [
        (107, "<I", 4_000_000_000, "4000000000 points|at least|4000000000"),
        (105, "<H", 3, "point length is 3"),
        (96, "<I", 10**9, "point data offset"),
        (94, "<H", 10, "declares 10 bytes"),
        (100, "<I", 10**9, "1000000000 LAS variable length records"),
        (131, "<d", float("nan"), "scales"),
        (131, "<d", 0.0, "scales"),
        (24, "<B", 7, r"version 7\.2"),
        (104, "<B", 60, "point format 60"),
    ],
)
def test_a_broken_las_header_is_named(at: int, kind: str, value: float, message: str, tmp_path: Path) -> None:
    broken = bytearray((path := OTHER_SAMPLES["las 1.2 format 3"](tmp_path)).read_bytes())
    struct.pack_into(kind, broken, at, value)
    path.write_bytes(broken)
    with pytest.raises(StraightPCFError, match=message):
        read_cloud(path, max_points=2**40)


@pytest.mark.parametrize("chunks", [0, 1000, 2**32 - 1])
def test_a_laz_chunk_table_that_declares_too_much_is_refused_before_memory_is_taken(
    chunks: int, tmp_path: Path
) -> None:
    broken = bytearray((path := OTHER_SAMPLES["laz 1.4 format 8"](tmp_path)).read_bytes())
    table = struct.unpack_from("<q", broken, struct.unpack_from("<I", broken, 96)[0])[0]
    struct.pack_into("<I", broken, table + 4, chunks)
    path.write_bytes(broken)
    with pytest.raises(MalformedFile, match=f"{chunks} (LAZ )?chunks"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"POINTS 60", b"POINTS 4000000000", "4000000000, but WIDTH"),
        (b"WIDTH 30", b"WIDTH -30", "'-30'"),
        (b"FIELDS label x", b"FIELDS label q", "there is no x"),
        (b"TYPE U F", b"TYPE U I", "field x is 1 x int32"),
        (b"SIZE 4 4", b"SIZE 4 3", "'3'"),
        (b"COUNT 1 1 3", b"COUNT 1 1 9999999999", "9999999999"),
        (b"DATA", b"DATE", "DATE"),
        (b"VERSION .7", b"VERSION \xff", "ASCII"),
    ],
)
def test_a_broken_pcd_header_is_named(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    (path := tmp_path / "a.pcd").write_bytes(pcd("binary").replace(old, new, 1))
    with pytest.raises(StraightPCFError, match=message):
        read_cloud(path)


def test_a_truncated_pcd_is_named_in_every_encoding(tmp_path: Path) -> None:
    for data in ("ascii", "binary", "binary_compressed"):
        (path := tmp_path / "a.pcd").write_bytes(pcd(data)[:-200])
        with pytest.raises(MalformedFile, match=r"truncated|values"):
            read_cloud(path)


def test_a_pcd_of_a_billion_points_is_refused_unread(tmp_path: Path) -> None:
    for data in ("ascii", "binary", "binary_compressed"):
        huge = pcd(data).replace(b"WIDTH 30", b"WIDTH 500000000").replace(b"POINTS 60", b"POINTS 1000000000")
        (path := tmp_path / "a.pcd").write_bytes(huge)
        with pytest.raises(TooManyPoints, match="1000000000"):
            read_cloud(path)
        with pytest.raises(MalformedFile):
            read_cloud(path, max_points=2**40)


@pytest.mark.parametrize("period", [1, 4, 7, 300, 9000])
def test_lzf_unpacks_what_it_packed(period: int) -> None:
    rng = np.random.default_rng(period)
    data = (rng.integers(0, 256, period, np.uint8).tobytes() * 20_011)[:20_011]
    for length in (0, 1, 2, 3, 4, 5, 6, 7, 8, 33, 268, 269, 270, 271, 272, 536, 20_011):
        assert lzf.decompress(lzf.compress(data[:length]), length) == data[:length]


@pytest.mark.parametrize(
    ("packed", "size"),
    [(b"\x05ab", 6), (b"\x20\x05", 3), (b"\xe0", 9), (b"\x00a\x20\x00", 3), (b"\x00a", 10**9), (b"\x01ab", 1)],
)
def test_a_broken_lzf_stream_is_malformed(packed: bytes, size: int) -> None:
    with pytest.raises(MalformedFile, match="LZF"):
        lzf.decompress(packed, size)
