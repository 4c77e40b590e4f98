"""LAS, LAZ and PCD files as other programs write them, the LAS ones by laspy as an independent witness."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from straightpcf.points.formats import lzf
from tests.clouds import torus

__all__ = ["OTHER_SAMPLES", "pcd"]

N = 60


def pcd(data: str, count: int = N) -> bytes:
    """An organised file with padding, a histogram, packed colours and NaN points."""
    kind = [
        ("label", "<u4"),
        ("x", "<f4"),
        ("_", "u1", (3,)),
        ("y", "<f4"),
        ("z", "<f8"),
        ("h", "<i2", (2,)),
        ("rgba", "<u4"),
    ]
    rows = np.zeros(count, kind)
    rows["x"], rows["y"], rows["z"] = torus(count).T
    rows["z"][5:9] = rows["x"][5:9] = np.nan
    rows["h"], rows["rgba"] = np.arange(2 * count).reshape(-1, 2) - 9, 0xFF00FF00 + np.arange(count)
    head = "# .PCD v.7 - Point Cloud Data file format\nVERSION .7\nFIELDS label x _ y z h rgba\nSIZE 4 4 1 4 8 2 4\n"
    head += "TYPE U F U F F I U\nCOUNT 1 1 3 1 1 2 1\n"
    head += f"WIDTH {count // 2}\nHEIGHT 2\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
    if data == "ascii":
        body = "".join(
            f"{r['label']} {r['x']:.5f} 0 0 0 {r['y']:.5g}\t{r['z']:.7f} {r['h'][0]} {r['h'][1]}  {r['rgba']}\n"
            for r in rows
        )
        return (head + body).encode()
    if data == "binary":
        return head.encode() + rows.tobytes() + b"tail"
    planes = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names or ())
    packed = lzf.compress(planes)
    return head.encode() + struct.pack("<II", len(packed), len(planes)) + packed + b"\0\0"


def _laspy(point_format: int, version: str, *, laz: bool) -> Callable[[Path], Path]:
    def build(folder: Path) -> Path:
        import laspy

        header = laspy.LasHeader(point_format=point_format, version=version)
        header.offsets, header.scales = np.array([500_000, 4_000_000, 0.0]), np.array([0.001, 0.001, 0.01])
        header.add_extra_dim(laspy.ExtraBytesParams("reflectance", "f4"))
        header.add_extra_dim(laspy.ExtraBytesParams("three", "3i2"))
        header.vlrs.append(laspy.VLR("someone", 77, "kept", b"\x00\xffpayload"))
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = (torus(N) + np.array([500_100, 4_000_200, 30])).T
        rng = np.random.default_rng(1)
        cloud.intensity = rng.integers(0, 65536, N, np.uint16)
        cloud.return_number = np.arange(N) % 5 + 1
        cloud.classification = np.arange(N) % 20
        if "gps_time" in header.point_format.dimension_names:
            cloud.gps_time = rng.random(N) * 1e5
        if "red" in header.point_format.dimension_names:
            cloud.red = rng.integers(0, 65536, N, np.uint16)
        cloud["reflectance"] = rng.random(N).astype(np.float32)
        cloud["three"] = rng.integers(-9, 9, (N, 3)).astype(np.int16)
        if version == "1.4":
            cloud.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("late", 78, "after the points", b"evlr" * 20)])
        path = folder / ("a.laz" if laz else "a.las")
        cloud.write(path)
        return path

    return build


def _pcd(data: str) -> Callable[[Path], Path]:
    def build(folder: Path) -> Path:
        (path := folder / "a.pcd").write_bytes(pcd(data))
        return path

    return build


OTHER_SAMPLES: dict[str, Callable[[Path], Path]] = {
    "pcd ascii": _pcd("ascii"),
    "pcd binary": _pcd("binary"),
    "pcd compressed": _pcd("binary_compressed"),
    "las 1.2 format 3": _laspy(3, "1.2", laz=False),
    "las 1.4 format 7": _laspy(7, "1.4", laz=False),
    "laz 1.2 format 1": _laspy(1, "1.2", laz=True),
    "laz 1.4 format 8": _laspy(8, "1.4", laz=True),
}
