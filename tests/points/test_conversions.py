"""What another format cannot hold of a cloud is named, and everything else arrives."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MissingDependency, UnsupportedCloud
from straightpcf.points.formats import FORMATS, Format, format_named, read_cloud, write_cloud
from straightpcf.points.formats.scalars import scalar_columns
from tests.effort import at_most_lines
from tests.points.samples import SAMPLES, torus

LARGE = np.array([1700000000123456789, 4611686018427387905, -9007199254740993])


def converted(cloud: PointCloud, name: str, tmp_path: Path) -> PointCloud:
    target = format_named(name)
    write_cloud(cloud, tmp_path / f"out{target.suffixes[0]}", target)
    return read_cloud(tmp_path / f"out{target.suffixes[0]}")[0]


def columns(cloud: PointCloud, name: str) -> npt.NDArray[np.generic]:
    """Return an attribute, or the columns that one of several became, (N, M); `extra_` is beside a LAS dimension."""
    label = re.escape(re.sub(r"[^A-Za-z0-9_.\-]", "_", name)[:32])
    extra, plain = (
        [values for key, values in cloud.attributes.items() if re.fullmatch(rf"{before}{label}(_\d+)?", key)]
        for before in ("extra_", "")
    )
    return np.column_stack(extra or plain)


@pytest.mark.parametrize("target", FORMATS, ids=lambda format: format.name)
@pytest.mark.parametrize("sample", SAMPLES)
def test_every_attribute_arrives_or_is_named(sample: str, target: Format, tmp_path: Path) -> None:
    try:
        cloud, source = read_cloud(SAMPLES[sample](tmp_path))
        lost = target.left_behind(cloud)
        again = converted(cloud, target.name, tmp_path)
    except (MissingDependency, UnsupportedCloud) as refused:  # NaN in LAS
        pytest.skip(refused.message)
    for name, values in cloud.attributes.items() if source is not target else ():
        if name not in {re.sub(r" \(rounded to .*\)$", "", some) for some in lost}:
            found = columns(again, name).astype(values.dtype)  # of a text, the number that it is the shortest of
            is_float = target.name == "kitti" or (target.name, name) == ("pcd", "intensity")
            np.testing.assert_allclose(found, values.reshape(len(cloud), -1), rtol=1e-6 * is_float)


@pytest.mark.parametrize(
    ("target", "is_held"), [("pcd", True), ("las", True), ("npz", True), ("csv", True), ("ply", False)]
)
def test_whole_numbers_of_64_bits_arrive_as_they_are_or_are_named(target: str, is_held: bool, tmp_path: Path) -> None:
    cloud = PointCloud(torus(3), {"stamp": LARGE, "id": np.arange(3)})
    assert format_named(target).left_behind(cloud) == ([] if is_held else ["stamp (rounded to float64)"])
    again = converted(cloud, target, tmp_path).attributes
    np.testing.assert_array_equal(again["stamp"], LARGE if is_held else LARGE.astype(np.float64))
    np.testing.assert_array_equal(again["id"], np.arange(3))


@pytest.mark.parametrize("target", ["ply", "pcd", "las", "csv", "xyz"])
def test_names_that_no_header_carries_become_others_and_are_named(target: str, tmp_path: Path) -> None:
    names = ["\u5f37\u5ea6", "__", "scan id", "field", "label"]
    cloud = PointCloud(torus(3), {name: np.arange(3, dtype=np.uint8) + index for index, name in enumerate(names)})
    said = [
        "\u5f37\u5ea6 (renamed to field)",
        "__ (renamed to field_2)",
        "scan id (renamed to scan_id)",
        "field (renamed to field_3)",
    ]
    assert format_named(target).left_behind(cloud) == said
    again = converted(cloud, target, tmp_path).attributes
    for index, name in enumerate(["field", "field_2", "scan_id", "field_3", "label"]):
        np.testing.assert_array_equal(again[name], np.arange(3) + index)


def test_thousands_of_columns_whose_names_become_one_are_numbered_at_once() -> None:
    names = [chr(0x4E00 + index) for index in range(4096)]
    cloud = PointCloud(torus(3), {name: np.arange(3.0) for name in names})
    with at_most_lines(400_000):  # some fifty a column
        said = format_named("ply").left_behind(cloud)
        columns = scalar_columns(cloud.attributes, ["f8"], taken=["x", "field_3"])
    assert (said[0], said[-1]) == (f"{names[0]} (renamed to field)", f"{names[-1]} (renamed to field_4096)")
    assert [*columns] == ["field", "field_2", *(f"field_{number}" for number in range(4, 4098))]


@pytest.mark.parametrize("target", ["ply", "pcd", "xyz", "csv", "tsv"])
def test_what_has_more_columns_than_are_read_again_is_refused_before_it_is_filtered(
    target: str, tmp_path: Path
) -> None:
    """One field of a PCD file may have any number, so may arrays with x, y, z; a file of 4096 columns is read again."""
    format = format_named(target)
    held = PointCloud(torus(5), {"id": np.arange(5), "shape": np.ones((5, 4092), np.float32)})
    format.check(held)
    assert len(converted(held, target, tmp_path).attributes) == 4093
    wide = PointCloud(torus(5), {"id": np.arange(5), "shape": np.ones((5, 4093), np.float32)})
    said = f"x, y, z and the attributes are 4097 columns, 4093 of them of 'shape'; the limit of {target}.* is 4096"
    for refused in (lambda: format.check(wide), lambda: converted(wide, target, tmp_path)):
        with pytest.raises(UnsupportedCloud, match=f"(?i){said}"):
            refused()


def test_a_wide_field_is_kept_by_its_own_format_and_left_behind_by_one_of_few_columns(tmp_path: Path) -> None:
    head = "FIELDS x y z shape\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 5000\nWIDTH 1\nHEIGHT 1\nDATA binary\n"
    (path := tmp_path / "wide.pcd").write_bytes(head.encode() + bytes(12 + 5000))
    wide, _ = read_cloud(path)
    moved = converted(wide.with_xyz(wide.xyz + 1), "pcd", tmp_path)
    assert (moved.attributes["shape"].shape, moved.xyz.tolist()) == ((1, 5000), [[1, 1, 1]])
    assert not converted(wide, "pts", tmp_path).attributes


@pytest.mark.parametrize("target", ["las", "laz"])
def test_columns_whose_names_las_has_no_room_for_are_named(target: str, tmp_path: Path) -> None:
    distance, half = "scalar_C2C_absolute_distances__X_", np.arange(3) + 0.5  # as CloudCompare calls them
    cloud = PointCloud(torus(3), {"intensity": half, distance: half + 1, f"{distance}_2": half + 2, "roughness": half})
    said = ["intensity (renamed to extra_intensity)", f"{distance} (renamed to {distance[:32]})"]
    said.append(f"{distance}_2 (renamed to {distance[:30]}_2)")
    assert format_named(target).left_behind(cloud) == said
    assert format_named(target).left_behind(PointCloud(torus(3), {"X": np.ones(3)})) == ["X (renamed to X_2)"]
    again = converted(cloud, target, tmp_path).attributes
    for index, name in enumerate(["extra_intensity", distance[:32], f"{distance[:30]}_2"]):
        np.testing.assert_array_equal(again[name], half + index)


def test_columns_of_text_faces_and_records_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,z,kind,w\n1,2,3,tree,7\n")
    table = read_cloud(tmp_path / "a.csv")[0]
    assert format_named("ply").left_behind(table) == ["kind"]
    assert format_named("csv").left_behind(table) == []
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "property list uchar int seen\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "1 2 3 1 5\n3 0 0 0\n"
    )
    assert format_named("pcd").left_behind(read_cloud(tmp_path / "a.ply")[0]) == ["list seen", "element face"]
    colours = PointCloud(torus(2), {"red": np.arange(2, dtype=np.uint8), "intensity": np.ones(2, np.float32)})
    assert format_named("kitti").left_behind(colours) == ["red"]
    assert format_named("npy").left_behind(colours) == ["red", "intensity"]


@pytest.mark.parametrize("kind", ["<f2", ">f2"])
def test_halves_become_a_dimension_of_las_where_they_fit(kind: str, tmp_path: Path) -> None:
    whole, beyond = np.arange(40).astype(kind), np.full(40, np.inf, kind)
    again = converted(PointCloud(torus(40), {"Intensity": whole, "User Data": beyond}), "las", tmp_path)
    np.testing.assert_array_equal(again.attributes["intensity"], whole)
    np.testing.assert_array_equal(again.attributes["User_Data"], beyond)


def test_whole_numbers_that_are_called_as_a_normal_stay_as_they_are_in_pcd(tmp_path: Path) -> None:
    values = np.arange(40, dtype=np.int32) + 2**30
    cloud = PointCloud(torus(40), {"normal_x": values})
    assert format_named("pcd").left_behind(cloud) == []
    np.testing.assert_array_equal(converted(cloud, "pcd", tmp_path).attributes["normal_x"], values)


MANY = {f"column_{column}": np.zeros(9) for column in range(400)}
NOT_FINITE = np.where(np.arange(27) == 5, np.nan, torus(9).ravel()).reshape(9, 3)
CLOUDS = {
    "plain": PointCloud(torus(9)),
    "NaN": PointCloud(NOT_FINITE),
    "huge": PointCloud(torus(9) * 1e200),
    "UTM": PointCloud(torus(9) + 5e6),
    "many attributes": PointCloud(torus(9), MANY),
    "an intensity beyond float32": PointCloud(torus(9), {"intensity": np.full(9, 1e300)}),
    "no points": PointCloud(np.empty((0, 3))),
}


@pytest.mark.parametrize("target", FORMATS, ids=lambda format: format.name)
@pytest.mark.parametrize("case", CLOUDS)
def test_a_cloud_that_cannot_be_written_is_refused_by_the_check_already(
    case: str, target: Format, tmp_path: Path
) -> None:
    try:
        write_cloud(CLOUDS[case], tmp_path / "out", target)
    except (MissingDependency, UnsupportedCloud) as refused:
        with pytest.raises(type(refused), match=re.escape(refused.message)):
            target.check(CLOUDS[case])
    else:
        target.check(CLOUDS[case])


def test_the_check_looks_for_what_packs_laz(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lazrs", None)
    format_named("las").check(CLOUDS["plain"])
    with pytest.raises(MissingDependency, match=r"pip install 'straightpcf\[las\]'"):
        format_named("laz").check(CLOUDS["plain"])
