"""E57 files that another library writes, for tests; and how a test changes one that is written."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

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


def write_two_scans(path: Path) -> Path:
    """Write two scans of fields as scanners have them, the first turned and moved, the other one moved."""
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


def patched(path: Path, old: bytes, new: bytes) -> None:
    """Replace some of the XML, as `edit` does."""
    edit(path, re.escape(old), new.replace(b"\\", rb"\\"))


def edit(path: Path, old: bytes, new: bytes) -> None:
    """Replace what matches in the XML, which is the last in the file, and put lengths and checksums right."""
    raw = path.read_bytes()
    offset, length = struct.unpack_from("<QQ", raw, 24)
    payload = b"".join(raw[page : page + 1020] for page in range(0, len(raw), 1024))
    begin = offset // 1024 * 1020 + offset % 1024
    xml = payload[begin : begin + length]
    assert re.search(old, xml)
    xml = re.sub(old, new, xml)
    payload = payload[:begin] + xml + bytes(-(begin + len(xml)) % 1020)
    whole = bytearray(b"".join(payload[page : page + 1020] + bytes(4) for page in range(0, len(payload), 1020)))
    struct.pack_into("<QQQ", whole, 16, len(whole), offset, len(xml))
    resealed(whole)
    path.write_bytes(whole)


def resealed(raw: bytearray) -> None:
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
