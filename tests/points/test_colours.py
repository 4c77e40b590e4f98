"""A file of another format has the colour where other programs look for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.points.cloud import PointCloud
from straightpcf.points.formats import format_named, read_cloud, write_cloud
from straightpcf.points.formats.colours import in_8_bits
from tests.clouds import torus

N = 256
BYTES = np.stack([np.arange(N), 255 - np.arange(N), np.arange(N) // 2], axis=1).astype(np.uint8)
WORDS = BYTES.astype("<u4") @ np.array([1 << 16, 1 << 8, 1], "<u4")
NAMES = ("red", "green", "blue")


def three(rgb: npt.NDArray[Any], names: tuple[str, ...] = NAMES) -> dict[str, npt.NDArray[Any]]:
    return dict(zip(names, rgb.T, strict=True))


SAID = {
    "uchar": three(BYTES),
    "LAS": three(BYTES.astype(np.uint16) * 257),
    "LAS, high bytes only": three(BYTES.astype(np.uint16) << 8),
    "LAS, low bytes only": three(BYTES.astype(np.uint16)),
    "text": three(BYTES.astype(np.float64), ("R", "G", "B")),
    "text of shares": three(BYTES / 255),
    "shares in a PLY file": three((BYTES / 255).astype(np.float32)),
    "OpenSfM's": three(BYTES, ("diffuse_red", "diffuse_green", "diffuse_blue")),
    "PCL's rgb": {"rgb": WORDS.view("<f4")},
    "PCL's rgba": {"rgba": WORDS | np.uint32(0xFF000000)},
    "PCL's rgb that are NaN": {"rgb": (WORDS | np.uint32(0xFF000000)).view("<f4")},
    "big-endian rgb": {"rgb": WORDS.view("<f4").astype(">f4")},
    "an array of bytes": {"Colors": BYTES},
    "an array called rgb": {"rgb": BYTES},
    "an array of Open3D's shares": {"colors": BYTES / 255},
    "an array of torch's shares": {"color": (BYTES / 255).astype(np.float32)},
}


def converted(said: dict[str, npt.NDArray[Any]], name: str, folder: Path) -> Path:
    target = format_named(name)
    write_cloud(PointCloud(torus(N), said), path := folder / f"a{target.suffixes[0]}", target)
    return path


def stacked(cloud: PointCloud) -> npt.NDArray[Any]:
    return np.stack([cloud.attributes[name] for name in NAMES], axis=1)


@pytest.mark.parametrize("case", SAID)
def test_every_way_to_say_it_becomes_the_one_of_each_format(case: str, tmp_path: Path) -> None:
    ply, pcd, las, pts = (read_cloud(converted(SAID[case], name, tmp_path))[0] for name in ("ply", "pcd", "las", "pts"))
    assert all(ply.attributes[name].dtype == np.uint8 for name in NAMES)
    np.testing.assert_array_equal(stacked(ply), BYTES)
    assert list(pcd.attributes) == ["rgb"]
    np.testing.assert_array_equal(pcd.attributes["rgb"].view("<u4"), WORDS)
    factor = 256 if "high" in case else 1 if "low" in case else 257  # 16 bits stay as they are
    np.testing.assert_array_equal(stacked(las), BYTES * np.uint16(factor))
    np.testing.assert_array_equal(stacked(pts), BYTES)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_laspy_finds_it_in_its_own_dimensions(suffix: str, tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy", reason="laspy, of the extra straightpcf[dev], is not installed")
    theirs = laspy.read(converted(SAID["uchar"] | {"gps_time": np.arange(N) / 7}, suffix, tmp_path))
    assert theirs.point_format.id == 3
    np.testing.assert_array_equal(np.stack([theirs[name] for name in NAMES], axis=1), BYTES * np.uint16(257))


@pytest.mark.parametrize("name", ["ply", "pcd", "pts"])
def test_open3d_finds_it(name: str, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="open3d, of the extra straightpcf[open3d], is not installed")
    theirs = open3d.io.read_point_cloud(str(converted(SAID["PCL's rgb"], name, tmp_path)))
    if name != "pcd":  # of which some of its readers take no double
        np.testing.assert_allclose(np.asarray(theirs.points), torus(N), atol=1e-6)
    np.testing.assert_allclose(np.asarray(theirs.colors), BYTES / 255, atol=1e-6)


def test_sixteen_bits_are_kept_where_they_say_more(tmp_path: Path) -> None:
    fine = np.random.default_rng(0).integers(0, 65536, (N, 3), np.uint16)
    for name in ("ply", "las", "csv", "pcd"):
        np.testing.assert_array_equal(stacked(read_cloud(converted(three(fine), name, tmp_path))[0]), fine)
    pcd = read_cloud(tmp_path / "a.pcd")[0].attributes["rgb"].view("<u4")
    np.testing.assert_array_equal(pcd >> 16, fine[:, 0] >> 8)
    lost = format_named("pts").left_behind(PointCloud(torus(N), three(fine)))
    assert lost == [f"{name} (rounded to uint8)" for name in NAMES]


def test_a_pts_file_has_its_columns_and_no_names(tmp_path: Path) -> None:
    """Open3D takes the second line for the first point, and looks for a colour in the last three of seven columns."""
    more = {"intensity": np.arange(N), "time": np.linspace(0, 1, N)}
    first, second = converted(SAID["uchar"] | more, "pts", tmp_path).read_bytes().splitlines()[:2]
    assert (first, second.split()[3:]) == (b"256", [b"0", b"0", b"255", b"0"])
    cloud = read_cloud(tmp_path / "a.pts")[0]
    assert list(cloud.attributes) == ["intensity", *NAMES]
    assert format_named("pts").left_behind(PointCloud(torus(N), SAID["uchar"] | more)) == ["time"]
    part = {"intensity": np.linspace(0, 1, N)}
    assert format_named("pts").left_behind(PointCloud(torus(N), part)) == []
    assert format_named("pts").left_behind(PointCloud(torus(N), SAID["uchar"] | part)) == []
    np.testing.assert_array_equal(
        read_cloud(converted(SAID["uchar"] | part, "pts", tmp_path))[0].attributes["intensity"], part["intensity"]
    )


def test_packed_colours_become_columns_of_text_and_others_stay(tmp_path: Path) -> None:
    assert converted(SAID["PCL's rgba"], "csv", tmp_path).read_bytes().startswith(b"x,y,z,red,green,blue\n")
    assert converted(SAID["an array of bytes"], "csv", tmp_path).read_bytes().startswith(b"x,y,z,red,green,blue\n")
    assert converted(SAID["text"], "csv", tmp_path).read_bytes().startswith(b"x,y,z,R,G,B\n")


def test_alpha_is_kept_where_it_says_something() -> None:
    alpha = np.arange(N, dtype=np.uint32)
    np.testing.assert_array_equal(in_8_bits({"rgba": WORDS | alpha << 24})["alpha"], alpha)
    assert list(in_8_bits(SAID["PCL's rgba"])) == [*NAMES]


@pytest.mark.parametrize("alpha", [np.full(N, 255, np.uint8), np.arange(N, dtype=np.uint8)], ids=["of 255", "of all"])
def test_a_colour_with_meshlabs_alpha_is_one_again_behind_pcd(alpha: npt.NDArray[np.uint8], tmp_path: Path) -> None:
    pcd = read_cloud(converted({**SAID["uchar"], "alpha": alpha}, "pcd", tmp_path))[0]
    for name in ("ply", "las", "csv", "pts"):
        cloud = read_cloud(converted(dict(pcd.attributes), name, tmp_path))[0]
        np.testing.assert_array_equal(stacked(cloud), BYTES * np.uint16(257 if name == "las" else 1))
        if name != "pts":
            np.testing.assert_array_equal(cloud.attributes["alpha"], alpha)


@pytest.mark.parametrize(
    "said",
    [
        {"red": BYTES[:, 0], "green": BYTES[:, 1]},
        three(BYTES // 51 / 5),
        three(BYTES / 255.5),
        three(BYTES // 255 * 1.0),
        three(-BYTES.astype(np.int32)),
        {"rgb": WORDS.astype(np.float64)},
        {"rgb": WORDS.view("<f4"), "red": BYTES[:, 0]},
        {"rgba": WORDS | np.arange(N, dtype="<u4") << 24, "alpha": BYTES[:, 0]},
        {"rgb": BYTES[:, :2]},
        {"colors": np.random.default_rng(0).random((N, 3))},
        {"colors": BYTES - 0.5},
        {"colors": BYTES[:, :2]},
        {"colors": BYTES, "red": BYTES[:, 0]},
    ],
)
def test_what_may_be_something_else_stays_as_it_is(said: dict[str, npt.NDArray[Any]]) -> None:
    again = in_8_bits(said)
    assert list(again) == list(said)
    assert all(again[name] is values for name, values in said.items())
