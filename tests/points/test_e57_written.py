"""E57 files whose points have moved, and new ones, are read by another library as they are meant."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import UnsupportedCloud
from straightpcf.points.formats import format_named, read_cloud
from straightpcf.points.formats.e57_bits import bits_packed
from straightpcf.points.formats.e57_file import HEADER, MAGIC, E57File, E57Points, scans_of
from straightpcf.points.formats.e57_pages import in_pages
from straightpcf.points.formats.e57_write import in_file, put_section, section_of
from tests.clouds import sphere
from tests.points.e57_samples import PLACE, Field, edit, libe57, patched, pye57, write_fields, write_two_scans

E57 = format_named("e57")
AXES = ("cartesianX", "cartesianY", "cartesianZ")


def raw_scans(path: Path) -> list[dict[str, npt.NDArray[Any]]]:
    """Return what another library reads of each scan, in its own frame, with what is no point."""
    with pye57.E57(str(path)) as file:
        return [file.read_scan_raw(index) for index in range(file.scan_count)]


def positions(path: Path) -> npt.NDArray[np.float64]:
    """Return what another library reads of all scans' points, in the file's frame."""
    with pye57.E57(str(path)) as file:
        scans = [file.read_scan(index, ignore_missing_fields=True) for index in range(file.scan_count)]
    return np.concatenate([np.stack([scan[axis] for axis in AXES], axis=1) for scan in scans])


def moved_file(path: Path, rows: slice, by: float = 0.05) -> tuple[Path, PointCloud]:
    """Move some points of a file at random; return where it then is and what it is to hold."""
    cloud, format = read_cloud(path)
    xyz = cloud.xyz.copy()
    xyz[rows] += np.random.default_rng(5).normal(0, by, xyz[rows].shape)
    format.check(cloud)
    format.write(cloud.with_xyz(xyz), path.with_name("moved.e57"))
    return path.with_name("moved.e57"), cloud.with_xyz(xyz)


def test_what_moved_is_read_by_another_library_and_all_else_keeps_its_bits(tmp_path: Path) -> None:
    path = write_two_scans(tmp_path / "a.e57")
    new, cloud = moved_file(path, slice(100, 3000))
    np.testing.assert_allclose(positions(new), cloud.xyz, atol=2e-7)  # float32 in the scan's frame
    assert len(raw_scans(new)) == 2
    stayed = np.ones(9000, bool)
    stayed[np.flatnonzero(np.arange(9000) % 10 != 3)[100:3000]] = False
    for index, (before, after) in enumerate(zip(raw_scans(path), raw_scans(new), strict=True)):
        assert list(before) == list(after)
        for name in before:
            rows = stayed if index == 0 and name in AXES else slice(None)
            np.testing.assert_array_equal(before[name][rows], after[name][rows])


def test_a_file_in_which_nothing_moved_is_the_same_to_the_byte(tmp_path: Path) -> None:
    path = write_two_scans(tmp_path / "a.e57")
    new, _ = moved_file(path, slice(0, 0))
    assert new.read_bytes() == path.read_bytes()


def limits(path: Path, scan: int, name: str) -> tuple[float, float]:
    """Return the limits that the XML says of a field."""
    points = E57Points.of(scans_of(E57File(path.read_bytes()).root)[scan])
    (element,) = [field.element for field in points.fields if field.name == name]
    return float(element.attrib["minimum"]), float(element.attrib["maximum"])


@pytest.mark.parametrize("in_own_frame", [True, False])
def test_bounds_and_limits_are_those_of_the_new_points(in_own_frame: bool, tmp_path: Path) -> None:
    path = write_two_scans(tmp_path / "a.e57")
    if in_own_frame:  # as E2807 has it, and pye57 has not
        edit(path, rb"<([xyz])Minimum type=\"Float\">[^<]*<", rb'<\1Minimum type="Float">-1<')
        edit(path, rb"<([xyz])Maximum type=\"Float\">[^<]*<", rb'<\1Maximum type="Float">1<')
    new, cloud = moved_file(path, slice(None), by=0.3)
    scans = raw_scans(new)
    own = np.concatenate([np.stack([raw[n][raw["cartesianInvalidState"] == 0] for n in AXES], axis=1) for raw in scans])
    xyz = own if in_own_frame else cloud.xyz
    with pye57.E57(str(new)) as file:
        for index, some in enumerate((xyz[:8100], xyz[8100:])):
            box = file.get_header(index).cartesianBounds
            for axis, column in zip("xyz", some.T, strict=True):
                bounds = [box[f"{axis}{end}"].value() for end in ("Minimum", "Maximum")]
                np.testing.assert_allclose(bounds, [column.min(), column.max()], rtol=0, atol=1e-6)
            for name in AXES:
                least, most = limits(new, index, name)
                assert least <= scans[index][name].min()
                assert most >= scans[index][name].max()


def scaled(xyz: npt.NDArray[np.float64]) -> dict[str, Field]:
    """Describe positions (N, 3) by whole numbers of thousandths with limits that are just theirs."""
    fields = {}
    for name, column in zip(AXES, np.rint(xyz.T * 1000), strict=True):
        limits = int(column.min()), int(column.max())
        fields[name] = Field("ScaledInteger", column / 1000, limits[0], *limits, 1e-3, 0.0)
    return fields


@pytest.mark.parametrize("by", [0.01, 40.0])
def test_whole_numbers_get_the_bits_that_new_ones_need(by: float, tmp_path: Path) -> None:
    whole = np.arange(7000, dtype=np.longlong)
    path = write_fields(tmp_path / "a.e57", {**scaled(sphere(7000)), "id": Field("Integer", whole, 0, 0, 6999)})
    new, cloud = moved_file(path, slice(0, 6000), by)
    np.testing.assert_allclose(positions(new), cloud.xyz, atol=0.0005001)
    np.testing.assert_array_equal(positions(new)[6000:], cloud.xyz[6000:])
    np.testing.assert_array_equal(read_cloud(new)[0].attributes["id"], whole)
    least, most = limits(new, 0, AXES[0])
    assert least <= np.rint(cloud.xyz[:, 0].min() * 1000)
    assert most >= np.rint(cloud.xyz[:, 0].max() * 1000)


def test_a_coordinate_beyond_64_bits_is_refused(tmp_path: Path) -> None:
    cloud, format = read_cloud(write_fields(tmp_path / "a.e57", scaled(sphere(60))))
    far = cloud.xyz.copy()
    far[5, 1] = 1e17
    with pytest.raises(UnsupportedCloud, match="new cartesianY has no place in 64 bits at the E57 file's scale"):
        format.write(cloud.with_xyz(far), tmp_path / "b.e57")
    assert not (tmp_path / "b.e57").exists()


def test_azimuths_go_on_round_as_the_scan_counts_them(tmp_path: Path) -> None:
    xyz = 3 * sphere(4000)
    reach = np.linalg.norm(xyz, axis=1)
    turned = np.arctan2(xyz[:, 1], xyz[:, 0]) % (2 * np.pi)  # 0 to a whole turn
    fields = {
        "sphericalRange": Field("Float", reach),
        "sphericalAzimuth": Field("Float", turned.copy()),
        "sphericalElevation": Field("Float", np.arcsin(xyz[:, 2] / reach)),
    }
    new, cloud = moved_file(write_fields(tmp_path / "a.e57", fields, pose=True), slice(None), 0.01)
    np.testing.assert_allclose(read_cloud(new)[0].xyz, cloud.xyz, atol=1e-12)
    (raw,) = raw_scans(new)
    flat = np.hypot(xyz[:, 0], xyz[:, 1])
    assert np.abs(raw["sphericalAzimuth"] - turned)[flat > 0.5].max() < 0.15


def test_what_is_infinite_stays_as_it_is(tmp_path: Path) -> None:
    xyz = sphere(100)
    xyz[3], xyz[5, 1], xyz[7] = np.inf, np.nan, 1e308
    places = {name: Field("Float", column.copy()) for name, column in zip(AXES, xyz.T, strict=True)}
    cloud, format = read_cloud(write_fields(tmp_path / "a.e57", places, pose=True))
    moved = cloud.xyz.copy()
    moved[50:] += 0.25
    format.write(cloud.with_xyz(moved), tmp_path / "b.e57")
    (raw,) = raw_scans(tmp_path / "b.e57")
    np.testing.assert_array_equal(np.stack([raw[name][:50] for name in AXES], axis=1), xyz[:50])
    np.testing.assert_allclose(read_cloud(tmp_path / "b.e57")[0].xyz[50:], moved[50:], atol=1e-12)


def test_normals_that_are_computed_anew_turn_back_with_the_pose(tmp_path: Path) -> None:
    xyz = sphere(900)
    normals = {f"nor:normal{axis}": Field("Float", column.copy()) for axis, column in zip("XYZ", xyz.T, strict=True)}
    places = {name: Field("Float", column.copy()) for name, column in zip(AXES, xyz.T, strict=True)}
    cloud, format = read_cloud(write_fields(tmp_path / "a.e57", {**places, **normals}, pose=True))
    fresh = -cloud.old_normals()
    format.write(cloud.with_normals(fresh), tmp_path / "b.e57")
    again, _ = read_cloud(tmp_path / "b.e57")
    np.testing.assert_allclose(again.old_normals(), fresh, atol=1e-12)
    np.testing.assert_array_equal(again.xyz, cloud.xyz)  # these have not moved


def write_with_company(path: Path) -> Path:
    """Write two scans of whole numbers, groups of points that have a section of their own, and a picture."""
    rng = np.random.default_rng(0)
    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        for count in (20_000, 300):
            scan, prototype = libe57.StructureNode(image), libe57.StructureNode(image)
            buffers = libe57.VectorSourceDestBuffer()
            fields = scaled(rng.normal(size=(count, 3)))  # the library holds on to no values
            for name, field in fields.items():
                prototype.set(name, libe57.ScaledIntegerNode(image, *field.arguments))
                buffers.append(libe57.SourceDestBuffer(image, name, field.values, count, True, True))
            points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
            scan.set("points", points)
            file.data3d.append(scan)
            points.writer(buffers).write(count)
            _add_groups(image, scan)
        one, picture = libe57.StructureNode(image), libe57.BlobNode(image, 3000)
        one.set("jpegImage", picture)
        image.root()["images2D"].append(one)
        picture.write(np.arange(3000, dtype=np.uint8) % 251, 0, 3000)
    return path


def _add_groups(image: Any, scan: Any) -> None:
    schemes, lines, prototype = (libe57.StructureNode(image) for _ in range(3))
    prototype.set("startPointIndex", libe57.IntegerNode(image, 0, 0, 1 << 30))
    groups = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    lines.set("groups", groups)
    schemes.set("groupingByLine", lines)
    scan.set("pointGroupingSchemes", schemes)
    begins = np.arange(0, 200, 7, dtype=np.longlong)
    buffers = libe57.VectorSourceDestBuffer()
    buffers.append(libe57.SourceDestBuffer(image, "startPointIndex", begins, len(begins), True))
    groups.writer(buffers).write(len(begins))


def company(path: Path) -> tuple[list[list[int]], bytes]:
    """Return what another library reads of the groups and of the picture."""
    found = []
    with pye57.E57(str(path)) as file:
        for index in range(file.scan_count):
            groups = file.data3d[index]["pointGroupingSchemes"]["groupingByLine"]["groups"]
            begins = np.zeros(groups.childCount(), np.longlong)
            buffers = libe57.VectorSourceDestBuffer()
            buffers.append(libe57.SourceDestBuffer(file.image_file, "startPointIndex", begins, len(begins), True))
            groups.reader(buffers).read()
            found.append(begins.tolist())
        picture = file.root["images2D"][0]["jpegImage"]
        content = np.zeros(3000, np.uint8)
        picture.read(content, 0, 3000)
    return found, content.tobytes()


@pytest.mark.parametrize("rows", [slice(0, 50), slice(20_000, 20_300), slice(None)], ids=["first", "second", "both"])
def test_what_stands_behind_a_section_that_grows_moves_and_stays_whole(rows: slice, tmp_path: Path) -> None:
    path = write_with_company(tmp_path / "a.e57")
    new, cloud = moved_file(path, rows, by=100.0)
    assert new.stat().st_size > path.stat().st_size
    np.testing.assert_allclose(positions(new), cloud.xyz, atol=0.0005001)
    assert company(new) == company(path)
    again, _ = moved_file(new, rows, by=100.0)
    assert company(again) == company(path)


def test_two_scans_of_the_same_points_are_refused_before_anything_is_computed(tmp_path: Path) -> None:
    path = write_two_scans(tmp_path / "a.e57")
    offsets = [points.file_offset for points in map(E57Points.of, scans_of(E57File(path.read_bytes()).root))]
    patched(path, b'fileOffset="%d"' % offsets[1], b'fileOffset="%d"' % offsets[0])
    cloud, format = read_cloud(path)
    assert len(cloud) == 8100 + 450
    with pytest.raises(UnsupportedCloud, match="two scans of the E57 file share their points"):
        format.check(cloud)


def test_xml_that_stands_before_something_else_and_is_written_in_another_manner_is_changed_too(tmp_path: Path) -> None:
    path = write_two_scans(tmp_path / "a.e57")
    edit(path, rb'<xMinimum type="Float">[^<]*</xMinimum>', b"<xMinimum  type = 'Float' />")
    edit(
        path,
        rb'<points type="CompressedVector" fileOffset="(\d+)"',
        rb"<points fileOffset='\1' type='CompressedVector'",
    )
    content = E57File(path.read_bytes()).content + b"what some other program has put behind it"
    struct.pack_into("<Q", content, 16, -(-len(content) // 1020) * 1024)
    path.write_bytes(in_pages(content))
    new, cloud = moved_file(path, slice(None))
    np.testing.assert_allclose(positions(new), cloud.xyz, atol=2e-7)
    file = E57File(new.read_bytes())
    assert b"what some other program has put behind it" in file.content
    bounds = [element.text for element in file.root.iter() if element.tag.endswith("xMinimum")]
    np.testing.assert_allclose(list(map(float, bounds)), [cloud.xyz[:8100, 0].min(), cloud.xyz[8100:, 0].min()])


def test_text_of_points_stays_whole_and_packets_are_no_longer_than_they_may_be() -> None:
    count, said = 30_000, "".join(f"{index}," for index in range(30_000)).encode()
    one = ElementTree.fromstring(
        f"""<vectorChild><points type="CompressedVector" fileOffset="48" recordCount="{count}"><prototype>
        <cartesianX type="Float"/><name type="String"/><id type="Integer" minimum="0" maximum="6"/>
        </prototype></points></vectorChild>"""
    )
    points = E57Points.of(one)
    streams = [np.arange(count, dtype="<f8").tobytes(), said, bits_packed(np.arange(count) % 7, 3)]
    section = section_of(points.fields, streams, count)
    content = bytearray(48) + section + b"<e57Root/>"
    put_section(content, 48, len(section))
    content[:48] = HEADER.pack(MAGIC, 1, 0, 0, 0, 0, 1024)
    file = E57File(in_file(content[:-10], b"<e57Root/>"))
    assert points.streams(file) == streams
    assert sum(1 for _ in file.packets(points)) > 5


def test_rows_too_long_for_a_packet_are_refused() -> None:
    fields = "".join(f'<f{index} type="Float"/>' for index in range(1100))
    one = ElementTree.fromstring(
        f"""<vectorChild><points type="CompressedVector" fileOffset="48" recordCount="9"><prototype>{fields}
        </prototype></points></vectorChild>"""
    )
    with pytest.raises(UnsupportedCloud, match="points of 8800 bytes do not fit into an E57 file's packets"):
        section_of(E57Points.of(one).fields, [bytes(72)] * 1100, 9)


def test_a_new_file_is_read_by_another_library_with_colours_and_intensities(tmp_path: Path) -> None:
    count, rng = 20_000, np.random.default_rng(1)
    cloud = PointCloud(
        sphere(count) + PLACE,
        {
            "Intensity": rng.random(count).astype(np.float32),
            **{name: rng.integers(0, 256, count, np.uint8) for name in ("red", "green", "blue")},
            "rowIndex": np.arange(count, dtype=np.uint16),
            "2nd value": rng.normal(size=count),
            "stamp": rng.integers(-(2**62), 2**62, count),
            "cartesianInvalidState": np.ones(count, np.int8),
            **{name: column for name, column in zip(("nx", "ny", "nz"), sphere(count).T.astype("f4"), strict=True)},
        },
    )
    E57.check(cloud)
    E57.write(cloud, tmp_path / "a.e57")
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        theirs = file.read_scan(0, intensity=True, colors=True, row_column=False)
        assert file.data3d[0]["colorLimits"]["colorRedMaximum"].value() == 255
    np.testing.assert_array_equal(np.stack([theirs[name] for name in AXES], axis=1), cloud.xyz)
    np.testing.assert_array_equal(theirs["intensity"], cloud.attributes["Intensity"])
    for name, ours in (("colorRed", "red"), ("colorGreen", "green"), ("colorBlue", "blue")):
        np.testing.assert_array_equal(theirs[name], cloud.attributes[ours])
    again, _ = read_cloud(tmp_path / "a.e57")
    for name, called in {"stamp": "stamp", "2nd value": "n_2nd_value", "rowIndex": "rowIndex", "nx": "nx"}.items():
        np.testing.assert_array_equal(again.attributes[called], cloud.attributes[name])
        assert again.attributes[called].dtype == cloud.attributes[name].dtype
    np.testing.assert_array_equal(again.attributes["cartesianInvalidState_2"], 1)
    assert E57.left_behind(cloud) == [
        "2nd value (renamed to 2nd_value)",
        "cartesianInvalidState (renamed to cartesianInvalidState_2)",
        "2nd_value (renamed to n_2nd_value)",
    ]
    E57.write(cloud, tmp_path / "b.e57")
    assert (tmp_path / "a.e57").read_bytes() == (tmp_path / "b.e57").read_bytes()


def test_what_is_no_number_is_refused_in_a_new_file(tmp_path: Path) -> None:
    xyz = sphere(30)
    xyz[7, 2] = np.nan
    with pytest.raises(UnsupportedCloud, match=r"point 7 is \[.*nan\], which an E57 file does not hold"):
        E57.check(PointCloud(xyz))
