"""What holds for every format: one set of facts over every entry of FORMATS and every sample file."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, MissingDependency, TooManyPoints, UnknownFormat, UnsupportedCloud
from straightpcf.points.formats import FORMATS, Format, format_for, format_named, read_cloud, write_cloud
from tests.points.samples import SAMPLES, N, plain_cloud

SCANS = Path(__file__).parents[2].parent / "shared" / "data" / "scans"
TOLERANCE = {"las": 1e-3, "laz": 1e-3, "kitti": 1e-6, "pcd": 1e-6}
every_format = pytest.mark.parametrize("format", FORMATS, ids=lambda format: format.name)


@pytest.fixture(params=SAMPLES)
def sample(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    try:
        return SAMPLES[request.param](tmp_path)
    except MissingDependency as missing:
        pytest.skip(missing.message)


def rewritten(cloud: PointCloud, format: Format, sample: Path) -> Path:
    target = sample.with_name(f"out{sample.suffix}")
    write_cloud(cloud, target, format)
    return target


def assert_same_attributes(after: PointCloud, before: PointCloud) -> None:
    assert list(after.attributes) == list(before.attributes)
    for name, values in before.attributes.items():
        assert after.attributes[name].dtype == values.dtype
        np.testing.assert_array_equal(after.attributes[name], values)


def test_a_cloud_that_did_not_move_comes_back_byte_for_byte(sample: Path) -> None:
    cloud, format = read_cloud(sample)
    assert len(cloud) == N
    assert rewritten(cloud.with_xyz(cloud.xyz.copy()), format, sample).read_bytes() == sample.read_bytes()


def test_a_format_checks_its_own_clouds_and_takes_them(sample: Path) -> None:
    cloud, format = read_cloud(sample)
    format.check(cloud)


def test_moved_points_come_back_where_they_were_put_with_everything_else_kept(sample: Path) -> None:
    cloud, format = read_cloud(sample)
    moved = cloud.xyz + np.random.default_rng(0).normal(0, 0.1, cloud.xyz.shape)
    again, same_format = read_cloud(rewritten(cloud.with_xyz(moved), format, sample))
    assert same_format is format
    is_half = "npy" in format.name and cloud.source.header.dtype.itemsize == 2
    np.testing.assert_allclose(again.xyz, moved, atol=1e-3 if is_half else TOLERANCE.get(format.name, 1e-6))
    assert_same_attributes(again, cloud)


def test_points_that_did_not_move_keep_their_bits_beside_some_that_did(sample: Path) -> None:
    cloud, format = read_cloud(sample)
    moved = cloud.xyz.copy()
    moved[::2] += 0.125
    again, _ = read_cloud(rewritten(cloud.with_xyz(moved), format, sample))
    np.testing.assert_array_equal(again.xyz[1::2], cloud.xyz[1::2])
    assert np.abs(again.xyz[::2] - cloud.xyz[::2]).min() > 0.1
    back = rewritten(again.with_xyz(np.where(np.arange(N)[:, None] % 2, again.xyz, cloud.xyz)), format, sample)
    np.testing.assert_array_equal(read_cloud(back)[0].xyz, cloud.xyz)


def test_a_result_can_be_written_twice_and_its_cloud_is_not_changed(sample: Path) -> None:
    cloud, format = read_cloud(sample)
    before = cloud.xyz.copy()
    first = rewritten(cloud.with_xyz(cloud.xyz + 0.5), format, sample).read_bytes()
    assert rewritten(cloud.with_xyz(cloud.xyz + 0.5), format, sample).read_bytes() == first
    np.testing.assert_array_equal(cloud.xyz, before)


def test_more_points_than_the_limit_are_refused_naming_both(sample: Path) -> None:
    read_cloud(sample, max_points=N)
    with pytest.raises(TooManyPoints, match=rf"\b{N - 1}\b"):
        read_cloud(sample, max_points=N - 1)


def test_a_file_is_known_by_its_content_or_by_the_name_it_was_given(sample: Path) -> None:
    nameless = sample.rename(sample.with_name("body"))
    assert len(read_cloud(nameless, name=sample.name)[0]) == N


@every_format
def test_a_cloud_of_another_format_is_written_whole(format: Format, tmp_path: Path) -> None:
    cloud = plain_cloud()
    path = tmp_path / f"new{format.suffixes[0]}"
    try:
        write_cloud(cloud, path, format)
    except MissingDependency as missing:
        pytest.skip(missing.message)
    again, found = read_cloud(path)
    assert found is format
    np.testing.assert_allclose(again.xyz, cloud.xyz, atol=TOLERANCE.get(format.name, 0))
    if format.name in ("ply", "pcd", "npz", "xyz", "csv", "tsv", "pts", "ptx", "e57"):
        lost = format.left_behind(cloud)
        assert lost == (["label"] if format.name in ("pts", "ptx") else [])
        for name, values in cloud.attributes.items():
            if name in lost:
                continue
            np.testing.assert_array_equal(again.attributes[name].astype(values.dtype), values)


@every_format
def test_a_cloud_without_points_is_written_and_read_or_refused_by_name(format: Format, tmp_path: Path) -> None:
    path = tmp_path / f"none{format.suffixes[0]}"
    with suppress(MalformedFile, UnsupportedCloud, MissingDependency):
        write_cloud(PointCloud(np.empty((0, 3))), path, format)
        assert len(read_cloud(path)[0]) == 0


@every_format
def test_nan_comes_back_as_nan_or_is_refused_by_name(format: Format, tmp_path: Path) -> None:
    cloud = plain_cloud()
    xyz = cloud.xyz.copy()
    xyz[2], xyz[5, 1] = np.nan, np.inf
    path = tmp_path / f"nan{format.suffixes[0]}"
    with suppress(UnsupportedCloud, MissingDependency):
        write_cloud(cloud.with_xyz(xyz), path, format)
        np.testing.assert_array_equal(read_cloud(path)[0].xyz, xyz)


@every_format
def test_a_format_is_found_by_its_name_and_each_suffix(format: Format) -> None:
    assert format_named(format.name) is format
    for suffix in format.suffixes:
        assert format_for(f"Some.Scan{suffix.upper()}") is format
    assert not format.sniff(b"")


def test_names_and_suffixes_are_unique() -> None:
    names = [format.name for format in FORMATS]
    suffixes = [suffix for format in FORMATS for suffix in format.suffixes]
    assert len(set(names)) == len(names)
    assert len(set(suffixes)) == len(suffixes)


def test_an_empty_file_is_malformed_and_says_so(tmp_path: Path) -> None:
    (path := tmp_path / "a.ply").touch()
    with pytest.raises(MalformedFile, match="0 bytes"):
        read_cloud(path)


def test_what_no_format_knows_is_refused_with_the_list(tmp_path: Path) -> None:
    (path := tmp_path / "picture.gif").write_bytes(b"GIF89a")
    with pytest.raises(UnknownFormat, match=r"GIF89a.*ply \(\.ply\)"):
        read_cloud(path)
    with pytest.raises(UnknownFormat, match=r"gif.*xyz"):
        format_for("picture.gif")
    with pytest.raises(UnknownFormat, match=r"gif.*npz"):
        format_named("gif")


def test_a_suffix_that_the_bytes_belie_is_told_so(tmp_path: Path) -> None:
    (path := tmp_path / "scan.ply").write_bytes(b"<html>")
    with pytest.raises(UnknownFormat, match=r"scan\.ply begins with b'<html>'.* no ply file"):
        read_cloud(path)


@pytest.mark.parametrize("name", ["a.ply.gz", "a.ply", "a.xyz", "a.bin", "a"])
def test_a_packed_file_is_said_to_be_one_whatever_it_is_called(name: str, tmp_path: Path) -> None:
    table = b"1 2 3\n" * 100
    for packed, by in ((gzip.compress(table), "gzip"), (bz2.compress(table), "bzip2"), (lzma.compress(table), "xz")):
        (path := tmp_path / name).write_bytes(packed)
        with pytest.raises(UnknownFormat, match=f"packed with {by}: unpack it first"):
            read_cloud(path)


def test_a_bin_file_of_cloudcompares_is_called_so(tmp_path: Path) -> None:
    """Its rows can be four float32, too, of which the fourth are no intensities."""
    (path := tmp_path / "scan.bin").write_bytes(b"CCB2" + bytes(60))
    with pytest.raises(UnknownFormat, match=r"scan\.bin is a BIN file of CloudCompare's own: save it as PLY"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("name", "begins", "message"),
    [
        ("dem.asc", b"ncols         4\nnrows         6\n", "is an ESRI grid of heights: turn it into x y z"),
    ],
)
def test_a_file_of_another_program_is_called_so_with_what_to_do(
    name: str, begins: bytes, message: str, tmp_path: Path
) -> None:
    (path := tmp_path / name).write_bytes(begins + bytes(60))
    with pytest.raises(UnknownFormat, match=re.escape(f"{name} {message}")):
        read_cloud(path)


def test_a_name_of_any_length_keeps_its_suffix(tmp_path: Path) -> None:
    (path := tmp_path / "input").write_bytes(b"0 0 0\n")
    assert read_cloud(path, name="long " * 40 + ".xyz")[1].name == "xyz"
    with pytest.raises(UnknownFormat, match="needs a name with a suffix"):
        read_cloud(path)


def test_a_file_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_cloud(tmp_path / "none.ply")


@pytest.mark.skipif(not SCANS.is_dir(), reason=f"no real scans in {SCANS}")
@pytest.mark.parametrize("path", sorted(SCANS.glob("*")), ids=lambda path: path.name)
def test_a_real_scan_comes_back_byte_for_byte(path: Path, tmp_path: Path) -> None:
    try:
        cloud, format = read_cloud(path)
    except MissingDependency as missing:
        pytest.skip(missing.message)
    except UnknownFormat:
        pytest.skip(f"{path.suffix} has no reader yet")
    assert len(cloud) > 1000
    write_cloud(cloud, tmp_path / path.name, format)
    assert (tmp_path / path.name).read_bytes() == path.read_bytes()
