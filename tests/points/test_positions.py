"""The axes' names, and no others, are the positions."""

from __future__ import annotations

from pathlib import Path

import pytest

from straightpcf.points.formats import read_cloud

NAMES = ("xy", "yz", "xyz")
ROWS = b"1 2 3 4 5 6\n" * 2
PLY = b"ply\nformat ascii 1.0\nelement vertex 2\n%send_header\n" % b"".join(
    b"property float %s\n" % name.encode() for name in ("x", "y", "z", *NAMES)
)
PCD = b"FIELDS x y z xy yz xyz\nPOINTS 2\nDATA ascii\n"


@pytest.mark.parametrize("raw", [PLY + ROWS, PCD + ROWS], ids=["ply", "pcd"])
def test_attributes_called_by_several_axes_are_attributes(raw: bytes, tmp_path: Path) -> None:
    (path := tmp_path / "a").write_bytes(raw)
    cloud, _ = read_cloud(path)
    assert cloud.xyz.tolist() == [[1, 2, 3]] * 2
    assert [(name, values.tolist()) for name, values in cloud.attributes.items()] == [
        (name, [4.0 + column] * 2) for column, name in enumerate(NAMES)
    ]
