"""New normals go where the old ones stood, and nothing else of a file changes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from straightpcf.points.cloud import NORMALS, PointCloud
from straightpcf.points.formats import format_named, read_cloud, write_cloud

N = 50
_RNG = np.random.default_rng(0)
XYZ, OLD = (_RNG.standard_normal((N, 3)).astype("<f4") for _ in range(2))
NEW = _RNG.standard_normal((N, 3)).astype("<f4").astype(np.float64)


def ply(kind: str, *, faces: bool = False) -> bytes:
    lines = ["ply", f"format {kind} 1.0", f"element vertex {N}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")] + ["property uchar red"]
    lines += ["property list uchar int ring"] if faces else []
    head = "\n".join([*lines, "end_header", ""]).encode()
    order = ">" if "big" in kind else "<"
    rows = []
    for i in range(N):
        ring = [1, i] if faces else []
        if kind == "ascii":
            numbers = [repr(float(value)) for value in (*XYZ[i], *OLD[i])]
            rows.append((" ".join([*numbers, str(i), *map(str, ring)]) + "\n").encode())
        else:
            floats = np.concatenate([XYZ[i], OLD[i]]).astype(order + "f4").tobytes()
            list_ = bytes([1]) + np.array([i], order + "i4").tobytes() if faces else b""
            rows.append(floats + bytes([i]) + list_)
    return head + b"".join(rows)


def pcd(tmp_path: Path, encoding: str) -> bytes:
    names = ("normal_x", "normal_y", "normal_z")
    columns = {name: OLD[:, axis] for axis, name in enumerate(names)} | {"red": np.arange(N, dtype="<u1")}
    write_cloud(PointCloud(XYZ.astype(np.float64), columns), tmp_path / "new.pcd", format_named("pcd"))
    raw = (tmp_path / "new.pcd").read_bytes()
    if encoding == "binary":
        return raw
    head, body = raw.split(b"DATA binary\n")
    table = np.frombuffer(body, [(name, "<f4") for name in (*"xyz", *names)] + [("red", "u1")])
    if encoding == "ascii":
        return head + b"DATA ascii\n" + "\n".join(" ".join(map(repr, row)) for row in table.tolist()).encode() + b"\n"
    from straightpcf.points.formats import lzf

    planes = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names or ())
    packed = lzf.compress(planes)
    return head + b"DATA binary_compressed\n" + np.array([len(packed), len(planes)], "<u4").tobytes() + packed


CASES = ("ascii", "binary_little_endian", "binary_big_endian", "binary with lists", "ascii with lists",
         "pcd ascii", "pcd binary", "pcd compressed")  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_new_normals_stand_where_the_old_ones_stood(case: str, tmp_path: Path) -> None:
    if case.startswith("pcd"):
        content, name = pcd(tmp_path, case.split()[1]), "cloud.pcd"
    else:
        kind = {"binary with lists": "binary_little_endian", "ascii with lists": "ascii"}.get(case, case)
        content, name = ply(kind, faces="lists" in case), "cloud.ply"
    (source := tmp_path / name).write_bytes(content)
    cloud, format = read_cloud(source)
    assert len(cloud.normal_names) == 3
    write_cloud(cloud.with_normals(cloud.old_normals()), tmp_path / "same", format)
    assert (tmp_path / "same").read_bytes() == content
    moved = cloud.xyz + 0.5
    write_cloud(cloud.with_xyz(moved).with_normals(NEW), tmp_path / f"out_{name}", format)
    back, _ = read_cloud(tmp_path / f"out_{name}")
    np.testing.assert_allclose(back.xyz, moved, atol=1e-6)
    np.testing.assert_allclose(back.old_normals(), NEW, atol=1e-7)
    np.testing.assert_array_equal(back.attributes["red"], cloud.attributes["red"])
    head = re.compile(rb".*?(end_header|DATA [a-z_]+)\n", re.S)
    assert head.match((tmp_path / f"out_{name}").read_bytes())[0] == head.match(content)[0]  # type: ignore[index]


def test_another_format_gets_the_new_normals_too(tmp_path: Path) -> None:
    (source := tmp_path / "cloud.ply").write_bytes(ply("binary_little_endian"))
    cloud, _ = read_cloud(source)
    write_cloud(cloud.with_normals(NEW), tmp_path / "cloud.pcd", format_named("pcd"))
    back, _ = read_cloud(tmp_path / "cloud.pcd")
    assert back.normal_names == ("normal_x", "normal_y", "normal_z")
    np.testing.assert_allclose(back.old_normals(), NEW, atol=1e-7)


@pytest.mark.parametrize(
    ("target", "called"), [("ply", ("nx", "ny", "nz")), ("pcd", ("normal_x", "normal_y", "normal_z"))]
)
@pytest.mark.parametrize("names", NORMALS)
def test_a_new_file_calls_normals_as_its_readers_do(
    names: tuple[str, ...], target: str, called: tuple[str, ...], tmp_path: Path
) -> None:
    """Open3D and PCL read normal_x from PCD alone, Open3D and MeshLab nx from PLY."""
    columns = dict(zip(names, OLD.T, strict=True))
    cloud = PointCloud(XYZ.astype(np.float64), {"label": np.arange(N), **columns})
    write_cloud(cloud, out := tmp_path / f"new.{target}", format_named(target))
    back, _ = read_cloud(out)
    assert [*back.attributes] == ["label", *called]
    np.testing.assert_array_equal(back.old_normals(), OLD)
    both = PointCloud(cloud.xyz, dict(zip((*NORMALS[0], *NORMALS[1]), (*OLD.T, *NEW.T), strict=True)))
    write_cloud(both, out, format_named(target))
    assert [*read_cloud(out)[0].attributes] == [*NORMALS[0], *NORMALS[1]]


def test_normals_in_a_text_of_cloudcompare_are_some(tmp_path: Path) -> None:
    rows = ["//X Y Z Nx Ny Nz", str(N), *(" ".join(map(repr, row)) for row in np.hstack([XYZ, OLD]).tolist())]
    (source := tmp_path / "cloud.txt").write_text("\n".join(rows))
    cloud, _ = read_cloud(source)
    write_cloud(cloud.with_normals(NEW), out := tmp_path / "new.ply", format_named("ply"))
    assert read_cloud(out)[0].normal_names == ("nx", "ny", "nz")
    np.testing.assert_array_equal(read_cloud(out)[0].old_normals(), NEW)


def test_an_array_of_normals_becomes_columns(tmp_path: Path) -> None:
    np.savez(source := tmp_path / "cloud.npz", points=XYZ, normals=OLD, colors=np.full((N, 3), 255, np.uint8))
    cloud, _ = read_cloud(source)
    for target in ("ply", "pcd"):
        write_cloud(cloud, out := tmp_path / f"new.{target}", format_named(target))
        np.testing.assert_array_equal(read_cloud(out)[0].old_normals(), OLD)
    both = PointCloud(cloud.xyz, {"normals": OLD, "nx": OLD[:, 0]})
    write_cloud(both, out := tmp_path / "new.ply", format_named("ply"))
    assert [*read_cloud(out)[0].attributes] == ["normals_0", "normals_1", "normals_2", "nx"]


@pytest.mark.parametrize("table", ["csv", "xyz", "las"])
def test_an_array_of_normals_are_normals_behind_a_table_too(table: str, tmp_path: Path) -> None:
    """Else only the numbers would arrive, of columns called normals_0, normals_1 and normals_2."""
    xyz = XYZ.astype(np.float64)
    write_cloud(PointCloud(xyz, {"normals": OLD}), out := tmp_path / f"cloud.{table}", format_named(table))
    back = read_cloud(out)[0]
    assert back.normal_names == ("nx", "ny", "nz")
    np.testing.assert_allclose(back.old_normals(), OLD, atol=1e-7)
    columns = dict(zip(("normal_x", "normal_y", "normal_z"), OLD.T, strict=True))
    write_cloud(PointCloud(xyz, {"normals": OLD, **columns}), out, format_named(table))
    assert read_cloud(out)[0].normal_names == tuple(columns)


def test_a_cloud_without_normals_takes_none() -> None:
    cloud = PointCloud(XYZ.astype(np.float64), {"nx": OLD[:, 0], "ny": OLD[:, 1]})
    assert cloud.normal_names == ()
    with pytest.raises(ValueError, match="no normals"):
        cloud.with_normals(NEW)
