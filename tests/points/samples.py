"""Small valid files of every format, as other programs write them, built here so that no test needs data."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from straightpcf.points.cloud import PointCloud
from straightpcf.points.formats import FORMATS, Format
from tests.clouds import torus

__all__ = ["SAMPLES", "npy", "npz", "plain_cloud"]

N = 60


def plain_cloud(count: int = N) -> PointCloud:
    """A cloud of no format, with two attributes."""
    rng = np.random.default_rng(3)
    attributes = {"intensity": rng.random(count).astype(np.float32), "label": rng.integers(0, 9, count, np.uint8)}
    return PointCloud(torus(count, seed=2).astype(np.float32).astype(np.float64), attributes)


def npy(array: np.ndarray[Any, Any]) -> bytes:
    np.save(buffer := io.BytesIO(), array)
    return buffer.getvalue()


def npz(method: int = zipfile.ZIP_DEFLATED, **arrays: np.ndarray[Any, Any]) -> bytes:
    with zipfile.ZipFile(buffer := io.BytesIO(), "w", method) as archive:
        for name, array in arrays.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", (2001, 2, 3, 4, 5, 6)), npy(array), method)
    return buffer.getvalue()


def _ply_ascii() -> bytes:
    rows = [f"{x:.4f}\t{y:.6e} 7  {z:.3f} {i} 2 {i} {i + 1} " for i, (x, y, z) in enumerate(torus(N))]
    head = ["ply", "format ascii 1.0", "comment a  b\xe9", "obj_info made by hand", "element camera 1"]
    head += ["property float fov", f"element vertex {N}", "property float x", "property double y", "property uchar red"]
    head += ["property float32 z", "property int id", "property list uchar int near", "element face 2"]
    head += ["property list uint8 int32 vertex_indices", "end_header"]
    return "\r\n".join([*head, "45.50", *rows, "3 0 1 2", "4 0 1 2 3", ""]).encode("latin-1")


def _ply_binary(order: str) -> bytes:
    name = {"<": b"binary_little_endian", ">": b"binary_big_endian"}[order]
    kind = [("nx", order + "f4"), ("x", order + "f4"), ("y", order + "f4"), ("z", order + "f8"), ("red", "u1")]
    rows = np.zeros(N, np.dtype(kind))
    rows["x"], rows["y"], rows["z"] = torus(N).T
    rows["red"] = np.arange(N)
    head = b"ply\nformat %s 1.0\ncomment \xff\xfe\nelement vertex %d\nproperty float nx\nproperty float x\n" % (name, N)
    head += b"property float y\nproperty double z\nproperty uchar red\nelement face 1\n"
    head += b"property list uchar int vertex_indices\nend_header\n"
    return head + rows.tobytes() + b"\x03" + np.arange(3, dtype=order + "i4").tobytes()


def _ply_lists() -> bytes:
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty list uchar short near\n" % N
    head += b"property float x\nproperty float y\nproperty float z\nproperty list int float w\nproperty ushort id\n"
    body = b""
    for i, row in enumerate(torus(N).astype("<f4")):
        body += bytes([i % 3]) + np.arange(i % 3, dtype="<i2").tobytes() + row.tobytes()
        body += np.int32(i % 2).tobytes() + np.arange(i % 2, dtype="<f4").tobytes() + np.uint16(i).tobytes()
    return head + b"end_header\n" + body


def _text(separator: str, *above: str, end: str = "\n") -> bytes:
    rows = [separator.join([f"{x:.3f}", f"{y:.7f}", f"{z:.2e}", str(i)]) for i, (x, y, z) in enumerate(torus(N))]
    return end.join([*above, *rows[:20], "", *rows[20:], ""]).encode()


def _ptx() -> bytes:
    """Two scans, the first of a colour; the scanner did not move."""
    pose = ["1 2 3", "1 0 0", "0 1 0", "0 0 1", "1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"]
    rows = [f"{x:.6f} {y:.6f} {z:.6f} {i / N:.4f}" for i, (x, y, z) in enumerate(torus(N))]
    first = [f"{row} {i} 2 255" for i, row in enumerate(rows[:20])]
    return "\r\n".join(["4", "5", *pose, *first, "1", "40", *pose, *rows[20:], ""]).encode()


_FILES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "ply ascii": ("a.ply", _ply_ascii),
    "ply little": ("a.ply", lambda: _ply_binary("<")),
    "ply big": ("a.ply", lambda: _ply_binary(">")),
    "ply lists": ("a.ply", _ply_lists),
    "xyz spaces": ("a.xyz", lambda: _text(" ")),
    "xyz tabs, comments": ("a.txt", lambda: _text(" \t", "# made by hand", "", "// two")),
    "xyz csv": ("a.csv", lambda: _text(",", '"x","Y","z","Number"', end="\r\n")),
    "tsv": ("a.tsv", lambda: _text("\t", "x\ty\tz\tNumber")),
    "tsv without tabs": ("a.tsv", lambda: _text(" ")),
    "xyz semicolons": ("a.asc", lambda: _text("; ")),
    "xyz pts": ("a.pts", lambda: _text(" ", str(N))),
    "ptx": ("a.ptx", _ptx),
    "npy float32": ("a.npy", lambda: npy(torus(N).astype("<f4"))),
    "npy fortran": ("a.npy", lambda: npy(np.asfortranarray(np.tile(torus(N), 2).astype(">f8")))),
    "npy float16": ("a.npy", lambda: npy(torus(N).astype("<f2"))),
    "npz deflated": ("a.npz", lambda: npz(pos=torus(N), label=np.arange(N), scale=np.float32(3))),
    "npz stored": ("a.npz", lambda: npz(zipfile.ZIP_STORED, cloud=torus(N).astype(">f4"), names=np.array(["a"] * N))),
}


def _written(format: Format) -> Callable[[Path], Path]:
    def build(folder: Path) -> Path:
        path = folder / f"new{format.suffixes[0]}"
        format.write(plain_cloud(), path)
        return path

    return build


def _stored(name: str, content: Callable[[], bytes]) -> Callable[[Path], Path]:
    def build(folder: Path) -> Path:
        (path := folder / name).write_bytes(content())
        return path

    return build


SAMPLES: dict[str, Callable[[Path], Path]] = {
    **{title: _stored(name, content) for title, (name, content) in _FILES.items()},
    **{f"{format.name} of ours": _written(format) for format in FORMATS},
}
