"""E57 files that another library wrote are read as it reads them, and broken ones are refused."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.points.errors import MalformedFile, StraightPCFError, TooManyBytes, TooManyPoints, UnsupportedCloud
from straightpcf.points.formats import estimate_points, format_named, read_cloud, write_cloud
from tests.clouds import sphere

pye57 = pytest.importorskip("pye57")
libe57 = pye57.libe57

TURN = np.array([np.cos(0.3), 0.0, 0.0, np.sin(0.3)])  # by 0.6 about z
PLACE = np.array([448000.25, 5411000.5, 310.0])
Columns = dict[str, npt.NDArray[Any]]


def scanned(count: int, seed: int) -> Columns:
    rng = np.random.default_rng(seed)
    xyz = sphere(count)
    colours = {f"color{name}": rng.integers(0, 256, count, np.uint8) for name in ("Red", "Green", "Blue")}
    return {
        **dict(zip(("cartesianX", "cartesianY", "cartesianZ"), xyz.T.copy(), strict=True)),
        "intensity": rng.random(count).astype(np.float32),
        **colours,
        "rowIndex": np.arange(count, dtype=np.uint16),
        "columnIndex": (np.arange(count) % 7).astype(np.uint16),
        "cartesianInvalidState": (np.arange(count) % 10 == 3).astype(np.int8),
    }


@pytest.fixture
def two_scans(tmp_path: Path) -> Path:
    path = tmp_path / "two.e57"
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(scanned(9000, 1), name="one", rotation=TURN, translation=PLACE)
        file.write_scan_raw(scanned(500, 2), name="two", translation=PLACE + 2)
    return path


class Field:
    """A field of a prototype: its node, made for a file, and its values."""

    def __init__(self, kind: str, values: npt.NDArray[Any], *arguments: Any) -> None:
        self.kind, self.values, self.arguments = kind, values, arguments


def write_fields(path: Path, fields: dict[str, Field], *, pose: bool = False) -> Path:
    """Write one scan of any fields, as no writer of whole scans does."""
    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        image.extensionsAdd("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt")
        scan, prototype, buffers = (
            libe57.StructureNode(image),
            libe57.StructureNode(image),
            libe57.VectorSourceDestBuffer(),
        )
        for name, field in fields.items():
            prototype.set(name, getattr(libe57, f"{field.kind}Node")(image, *field.arguments))
            scaled = field.kind == "ScaledInteger"
            buffers.append(libe57.SourceDestBuffer(image, name, field.values, len(field.values), True, scaled))
        if pose:
            rotation, turn = libe57.StructureNode(image), libe57.StructureNode(image)
            for axis, value in zip("wxyz", TURN, strict=True):
                turn.set(axis, libe57.FloatNode(image, value))
            rotation.set("rotation", turn)
            scan.set("pose", rotation)
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        scan.set("points", points)
        file.data3d.append(scan)
        points.writer(buffers).write(len(field.values))
    return path


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
    _patched(path, b'recordCount="60"', b'recordCount="0"')
    cloud, _ = read_cloud(path)
    assert list(cloud.attributes) == ["intensity", "red", "green", "blue", "rowIndex", "columnIndex", "scan"]
    assert set(cloud.attributes["scan"]) == {1}
    assert cloud.beside == ()


def test_a_scan_becomes_a_file_of_another_format_with_its_colours(two_scans: Path, tmp_path: Path) -> None:
    cloud, source = read_cloud(two_scans)
    write_cloud(cloud, tmp_path / "a.las", format_named("las"))
    again, _ = read_cloud(tmp_path / "a.las")
    np.testing.assert_allclose(again.xyz, cloud.xyz, atol=1e-3)
    np.testing.assert_array_equal(again.attributes["red"], cloud.attributes["red"].astype(np.uint16) * 257)
    for refuse in (source.check, lambda each: write_cloud(each, tmp_path / "a.e57", source)):
        with pytest.raises(UnsupportedCloud, match="read, not written: take another format"):
            refuse(cloud)
    assert not (tmp_path / "a.e57").exists()


def test_more_points_than_the_limit_are_refused_before_they_are_unpacked(two_scans: Path) -> None:
    with pytest.raises(TooManyPoints, match="9500 points; the limit is 9499"):
        read_cloud(two_scans, max_points=9499)


def test_points_that_take_no_bits_are_no_bomb(tmp_path: Path) -> None:
    same = {f"cartesian{axis}": Field("ScaledInteger", np.ones(60), 1, 1, 1, 1.0, 0.0) for axis in "XYZ"}
    path = write_fields(tmp_path / "a.e57", same)
    assert len(read_cloud(path)[0]) == 60
    _patched(path, b'recordCount="60"', b'recordCount="99999999"')
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
    _patched(two_scans, old, new)
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
        _resealed(broken)
        two_scans.write_bytes(broken)
        try:
            read_cloud(two_scans, max_points=20_000)
        except StraightPCFError:
            continue


def _patched(path: Path, old: bytes, new: bytes) -> None:
    """Replace some of the XML, which is the last in the file, and put lengths and checksums right."""
    raw = path.read_bytes()
    offset, length = struct.unpack_from("<QQ", raw, 24)
    payload = b"".join(raw[page : page + 1020] for page in range(0, len(raw), 1024))
    begin = offset // 1024 * 1020 + offset % 1024
    xml = payload[begin : begin + length]
    assert old in xml
    xml = xml.replace(old, new)
    payload = payload[:begin] + xml + bytes(-(begin + len(xml)) % 1020)
    whole = bytearray(b"".join(payload[page : page + 1020] + bytes(4) for page in range(0, len(payload), 1020)))
    struct.pack_into("<QQQ", whole, 16, len(whole), offset, len(xml))
    _resealed(whole)
    path.write_bytes(whole)


def _resealed(raw: bytearray) -> None:
    for begin in range(0, len(raw), 1024):
        struct.pack_into(">I", raw, begin + 1020, _crc32c(bytes(raw[begin : begin + 1020])))


def _crc32c(data: bytes) -> int:
    """Return the checksum of RFC 3720, byte by byte."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = (crc >> 8) ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFFFFFF


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = (byte >> 1) ^ (0x82F63B78 if byte & 1 else 0)
    return byte


_TABLE = [_remainder(byte) for byte in range(256)]
