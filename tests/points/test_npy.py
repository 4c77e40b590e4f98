"""NPY and NPZ: types and memory order kept, nothing unpickled, no bomb unpacked."""

from __future__ import annotations

import errno
import io
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import (
    InvalidCloud,
    MalformedFile,
    StraightPCFError,
    TooManyBytes,
    TooManyPoints,
    UnsupportedCloud,
)
from straightpcf.points.formats import format_named, read_cloud, write_cloud
from tests.clouds import torus
from tests.points.samples import npy, npz, plain_cloud


def read(folder: Path, raw: bytes, **options: Any) -> PointCloud:
    (path := folder / "body").write_bytes(raw)
    return read_cloud(path, **options)[0]


def written(folder: Path, cloud: PointCloud, name: str) -> bytes:
    write_cloud(cloud, folder / "out", format_named(name))
    return (folder / "out").read_bytes()


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<f2", "<f4", "<f8", ">f2", ">f4", ">f8"])
@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (7, 3), (7, 6)])
def test_type_shape_and_memory_order_are_kept(shape: tuple[int, int], dtype: str, order: Any, tmp_path: Path) -> None:
    array = np.asarray(np.random.default_rng(0).random(shape).astype(dtype), order=order)
    cloud = read(tmp_path, npy(array))
    assert written(tmp_path, cloud, "npy") == npy(array)
    after = np.load(io.BytesIO(written(tmp_path, cloud.with_xyz(cloud.xyz + 1), "npy")))
    assert (after.dtype, after.flags.f_contiguous) == (array.dtype, array.flags.f_contiguous)
    np.testing.assert_array_equal(after[:, :3], (array[:, :3].astype(float) + 1).astype(dtype))
    np.testing.assert_array_equal(after[:, 3:], array[:, 3:])


@pytest.mark.parametrize("suffix", ["npy", "npz"])
@pytest.mark.parametrize("axes", ["xyz", "XYZ"])
def test_records_are_read_by_their_fields_and_only_positions_change(axes: str, suffix: str, tmp_path: Path) -> None:
    kinds = [
        ("X_ORIG", "u1"),
        (axes[2], "<f8"),
        (axes[0], ">f4"),
        ("rgb", "u1", (3,)),
        (axes[1], "<f4"),
        ("at", [("t", "f8")]),
    ]
    array = np.zeros(6, kinds)
    array["X_ORIG"], array["rgb"], array["at"]["t"] = np.arange(6), np.arange(18).reshape(6, 3), 7.5
    for name, column in zip(axes, torus(6).T, strict=True):
        array[name] = column
    raw = npy(array) if suffix == "npy" else npz(cloud=array, label=np.arange(6))
    cloud = read(tmp_path, raw)
    np.testing.assert_allclose(cloud.xyz, torus(6), atol=1e-6)
    np.testing.assert_array_equal(cloud.attributes["rgb"], array["rgb"])
    assert [*cloud.attributes][:2] == ["X_ORIG", "rgb"]
    assert cloud.beside == ("at",)
    assert written(tmp_path, cloud, suffix) == raw
    after = np.load(io.BytesIO(written(tmp_path, cloud.with_xyz(cloud.xyz + 1), suffix)))
    after = after if suffix == "npy" else after["cloud"]
    assert after.dtype == array.dtype
    for name in array.dtype.names or ():
        np.testing.assert_array_equal(after[name], array[name] + 1 if name in axes else array[name])


def test_a_shape_as_python_2_wrote_it_is_read(tmp_path: Path) -> None:
    raw = npy(torus(5)).replace(b"(5, 3)", b"(5L, 3L)").replace(b"}  ", b"}", 1)
    assert len(raw) == len(npy(torus(5)))
    np.testing.assert_array_equal(read(tmp_path, raw).xyz, torus(5))


def test_bytes_after_the_array_are_kept(tmp_path: Path) -> None:
    raw = npy(torus(5)) + npy(np.arange(3))
    assert written(tmp_path, read(tmp_path, raw), "npy") == raw


@pytest.mark.parametrize("key", ["points", "xyz", "pos", "coord", "coords", "vertices", "positions", "anything"])
def test_npz_positions_are_found_and_other_arrays_kept(key: str, tmp_path: Path) -> None:
    others = {"label": np.arange(6), "scale": np.array(2.5), "objects": np.array([{}, None], dtype=object)}
    if key != "anything":
        others["normals"] = np.ones((6, 3))
    raw = npz(**{**others, key: torus(6).astype(np.float32)})
    cloud = read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.attributes["label"], np.arange(6))
    assert "objects" not in cloud.attributes
    assert written(tmp_path, cloud, "npz") == raw
    after = np.load(io.BytesIO(written(tmp_path, cloud.with_xyz(cloud.xyz + 1), "npz")), allow_pickle=True)
    assert after.files == [*others, key]
    np.testing.assert_array_equal(after[key], (torus(6).astype(np.float32) + 1.0).astype(np.float32))
    for name, values in others.items():
        np.testing.assert_array_equal(after[name], values)


@pytest.mark.parametrize(
    "others",
    [
        {"points": np.float64(3)},
        {"points": np.arange(6), "xyz": np.zeros((6, 2))},
        {"rgb": np.ones((6, 3), np.float32), "RGB": np.ones((6, 4))},
        {"normals": np.ones((6, 3)), "Normal": np.ones((6, 3)), "colors": np.ones((6, 3)), "colour": np.ones((6, 4))},
    ],
)
def test_npz_arrays_that_are_no_positions_are_passed_over(others: dict[str, Any], tmp_path: Path) -> None:
    raw = npz(**others, cloud=torus(6))
    cloud = read(tmp_path, raw)
    np.testing.assert_array_equal(cloud.xyz, torus(6))
    assert written(tmp_path, cloud, "npz") == raw


@pytest.mark.parametrize("key", ["Points", "XYZ"])
def test_names_of_npz_positions_count_in_any_case_but_those_so_written_first(key: str, tmp_path: Path) -> None:
    others = {"feats": np.ones((6, 3)), "Normals": np.ones((6, 3))}
    np.testing.assert_array_equal(read(tmp_path, npz(**others, **{key: torus(6)})).xyz, torus(6))
    np.testing.assert_array_equal(read(tmp_path, npz(**{key: np.ones((6, 3))}, vertices=torus(6))).xyz, torus(6))
    with pytest.raises(UnsupportedCloud, match=rf"{key}\.npy has shape \(6, 3\) and type <i8"):  # not the features
        read(tmp_path, npz(**{key: np.ones((6, 3), int)}, feats=torus(6)))


def test_an_array_of_another_format_called_as_positions_are_is_an_attribute(tmp_path: Path) -> None:
    cloud = PointCloud(torus(6), {"xyz": np.ones((6, 3)), "coord": np.arange(6)})
    (tmp_path / "body").write_bytes(written(tmp_path, cloud, "npz"))
    again = read_cloud(tmp_path / "body")[0]
    assert format_named("npz").left_behind(cloud) == []
    np.testing.assert_array_equal(again.xyz, cloud.xyz)
    assert list(again.attributes) == ["xyz", "coord"]


def test_a_new_npz_is_the_same_every_time_and_has_every_attribute(tmp_path: Path) -> None:
    raw = written(tmp_path, plain_cloud(), "npz")
    assert written(tmp_path, plain_cloud(), "npz") == raw
    assert np.load(io.BytesIO(raw)).files == ["points", "intensity", "label"]


def _npy_header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def _declaring(shape: str, descr: str = "'<f8'", fortran: str = "False") -> bytes:
    return _npy_header(f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}}}\n")


def _zipped(name: str) -> bytes:
    with zipfile.ZipFile(buffer := io.BytesIO(), "w") as archive:
        archive.writestr(name, "ply")
    return buffer.getvalue()


def _altered(raw: bytes) -> bytes:
    """Damage the packed bytes of the first member."""
    at = raw.index(b"points.npy") + 60
    return raw[:at] + bytes(byte ^ 255 for byte in raw[at : at + 20]) + raw[at + 20 :]


BAD: dict[str, tuple[bytes, type[StraightPCFError], str]] = {
    "objects": (npy(np.array([{}, None], dtype=object)), UnsupportedCloud, "never unpickled"),
    "integers": (npy(np.zeros((5, 3), int)), UnsupportedCloud, "i8"),
    "complex": (npy(np.zeros((5, 3), complex)), UnsupportedCloud, "c16"),
    "long double": (npy(np.zeros((5, 3), np.longdouble)), UnsupportedCloud, "f16"),
    "records of objects": (
        npy(np.zeros(5, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("O", "O")])),
        UnsupportedCloud,
        "never unpickled",
    ),
    "records with whole numbers": (npy(np.zeros(5, [("x", "i4"), ("y", "i4"), ("z", "i4")])), UnsupportedCloud, "i4"),
    "records in rows": (npy(np.zeros((5, 3), [("x", "f4"), ("y", "f4"), ("z", "f4")])), UnsupportedCloud, r"\(5, 3\)"),
    "records without an x": (
        npy(np.zeros(5, [("X_ORIG", "f8"), ("y", "f4")])),
        UnsupportedCloud,
        "records with such x, y, z",
    ),
    "records of no type": (_declaring("(5,)", "[('x', 'f4'), ('y', 'hello'), 3]"), UnsupportedCloud, "hello"),
    "structured": (npy(np.zeros(5, [("x", "f4"), ("y", "f4")])), UnsupportedCloud, "x"),
    "two columns": (npy(np.zeros((5, 2))), UnsupportedCloud, r"\(5, 2\)"),
    "a point a column": (npy(torus(50).T), UnsupportedCloud, r"\(3, 50\).*transpose"),
    "very many points, each a column": (_declaring("(4, 5000)"), UnsupportedCloud, r"\(4, 5000\).*transpose"),
    "a point a column of an archive": (npz(points=np.zeros((6, 50))), UnsupportedCloud, r"points\.npy.*transpose"),
    "an image of points": (npy(np.zeros((4, 5, 3))), UnsupportedCloud, r"\(4, 5, 3\).*reshape\(-1, 3\)"),
    "three dimensions": (npy(np.zeros((5, 3, 3))), UnsupportedCloud, r"\(5, 3, 3\)"),
    "truncated version": (npy(np.zeros((5, 3)))[:7], MalformedFile, "header .* 8 bytes.* 7: it is truncated"),
    "truncated": (npy(np.zeros((5, 3)))[:-1], MalformedFile, "120 bytes.* 119"),
    "no header": (b"\x93NUMPY\x01\x00", MalformedFile, "header"),
    "version 9": (b"\x93NUMPY\x09\x00" + bytes(100), MalformedFile, "9"),
    "an endless header": (b"\x93NUMPY\x02\x00\xff\xff\xff\x7f" + bytes(100), MalformedFile, "2147483647"),
    "no literal": (_npy_header("{'descr': open('x')}"), MalformedFile, "header"),
    "deep brackets": (_npy_header("(" * 9000), MalformedFile, "header"),
    "negative shape": (_declaring("(-5, 3)"), MalformedFile, "shape"),
    "shape of words": (_declaring("('a', 3)"), MalformedFile, "shape"),
    "4e9 rows": (_declaring("(4000000000, 3)"), TooManyPoints, "4000000000.*100000000"),
    "promised rows": (_declaring("(90000000, 3)"), MalformedFile, "2160000000 bytes"),
    "endless columns": (_declaring("(0, 100000000000)"), UnsupportedCloud, "columns"),
    "wide columns": (_declaring("(9, 1000000000000000)") + bytes(100), UnsupportedCloud, "columns"),
    "no zip": (b"PK\x03\x04" + bytes(200), MalformedFile, "NPZ"),
    "truncated zip": (npz(points=torus(50))[:-30], MalformedFile, "NPZ"),
    "damaged zip": (_altered(npz(points=torus(50))), MalformedFile, "NPZ"),
    "no arrays": (npz(), UnsupportedCloud, "no arrays.*but nothing"),
    "a zip of another file": (_zipped("scan.ply"), UnsupportedCloud, r"no arrays.*but scan\.ply: unpack it"),
    "no positions": (npz(label=np.arange(5)), UnsupportedCloud, "label"),
    "normals alone": (npz(normals=np.ones((5, 3))), UnsupportedCloud, "0 arrays.*normals"),
    "two candidates": (npz(a=np.zeros((5, 3)), b=np.zeros((5, 3))), UnsupportedCloud, "2 arrays.*a, b"),
    "voxels and features": (
        npz(coords=np.zeros((5, 3), np.int32), feats=torus(5)),
        UnsupportedCloud,
        r"coords\.npy has shape \(5, 3\) and type <i4",
    ),
    "objects and vectors": (npz(points=torus(5).astype(object), flow=torus(5)), UnsupportedCloud, "never unpickled"),
    "object positions": (npz(points=np.array([{}, None], dtype=object)), UnsupportedCloud, "never unpickled"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_refused_by_name(case: str, tmp_path: Path) -> None:
    raw, error, pattern = BAD[case]
    with pytest.raises(error, match=pattern):
        read(tmp_path, raw)


def _bomb(declared_rows: int, member_bytes: int) -> bytes:
    with (
        zipfile.ZipFile(buffer := io.BytesIO(), "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("points.npy", "w", force_zip64=True) as file,
    ):
        file.write(_declaring(f"({declared_rows}, 3)"))
        for _ in range(member_bytes >> 20):
            file.write(bytes(1 << 20))
    return buffer.getvalue()


@pytest.mark.parametrize("rows", [3 << 20, 5])
def test_a_zip_bomb_is_refused_before_it_is_unpacked(rows: int, tmp_path: Path) -> None:
    raw = _bomb(rows, 72 << 20)
    tracemalloc.start()
    try:
        with pytest.raises((TooManyPoints, MalformedFile)):
            read(tmp_path, raw, max_points=1 << 20)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_what_a_small_archive_unpacks_to_is_limited(tmp_path: Path) -> None:
    wide = np.zeros((20_000, 2_000))  # 320 MB, of 0.4 MB packed
    wide[:, :3] = torus(20_000)
    raw = npz(points=wide)
    tracemalloc.start()
    try:
        with pytest.raises(TooManyBytes, match=rf"points.npy declares 320000000 bytes unpacked.* {len(raw)} bytes"):
            read(tmp_path, raw)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
    label = np.zeros((100_000, 100))  # 80 MB
    cloud = read(tmp_path, npz(points=torus(100_000), **{str(n): label for n in range(4)}))
    assert list(cloud.attributes) == ["0", "1", "2"]
    assert cloud.beside == ("3.npy",)


def test_a_zip_that_declares_more_than_the_limit_is_refused_unread(tmp_path: Path) -> None:
    """The declared size of a member, in the central directory, is set to 4 GiB - 1 twice."""
    raw = bytearray(npz(points=torus(5), more=np.arange(5)))
    at = raw.index(b"PK\x01\x02")
    while at >= 0:
        raw[at + 24 : at + 28] = b"\xfe\xff\xff\xff"
        at = raw.find(b"PK\x01\x02", at + 4)
    with pytest.raises(TooManyBytes, match=r"8589934588.* 4294967296"):
        read(tmp_path, bytes(raw))


def test_a_member_that_lies_about_its_size_is_malformed(tmp_path: Path) -> None:
    raw = bytearray(npz(points=torus(50)))
    at = raw.index(b"PK\x01\x02")
    raw[at + 24 : at + 28] = (10**9).to_bytes(4, "little")
    with pytest.raises(InvalidCloud):
        read(tmp_path, bytes(raw))


@pytest.mark.parametrize(("members", "shape"), [(1, (1000, 10_000)), (3, (1000, 4000))])
def test_arrays_far_beyond_the_points_stay_packed_and_are_kept(
    members: int, shape: tuple[int, int], tmp_path: Path
) -> None:
    """Zeros pack a thousand to one: less than a megabyte would be hundreds in memory."""
    with zipfile.ZipFile(path := tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", npy(torus(1000)))
        archive.writestr("label.npy", npy(np.arange(1000)))
        for member in range(members):
            with archive.open(f"extra_{member}.npy", "w") as file:
                header = {"descr": "<f8", "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, header)
                for _ in range(100):
                    file.write(bytes(8 * shape[0] * shape[1] // 100))
    tracemalloc.start()
    cloud, npz_format = read_cloud(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 16 << 20
    assert list(cloud.attributes) == ["label"]
    assert cloud.beside == tuple(f"extra_{member}.npy" for member in range(members))
    write_cloud(cloud.with_xyz(cloud.xyz + 1), after := tmp_path / "b.npz", npz_format)
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(after) as new:
        assert [(m.filename, m.CRC) for m in old.infolist()[1:]] == [(m.filename, m.CRC) for m in new.infolist()[1:]]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize("count", [5, 20_000])
def test_a_full_disk_is_the_disks_fault_not_the_archives(count: int, method: int, tmp_path: Path) -> None:
    cloud = read(tmp_path, npz(method, points=torus(count), label=np.arange(count)))
    with pytest.raises(OSError, match="space") as refused:
        write_cloud(cloud.with_xyz(cloud.xyz + 1), Path("/dev/full"), format_named("npz"))
    assert refused.value.errno == errno.ENOSPC
