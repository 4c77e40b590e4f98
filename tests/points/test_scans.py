"""Real scans come back as they were; skipped where the shared data is absent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from straightpcf.points.errors import MissingDependency
from straightpcf.points.formats import read_cloud, write_cloud

SCANS = Path(__file__).parents[2].parent / "shared" / "data" / "scans"
COUNTS = {
    "rue_madame_28.xyz": 124_962,
    "kitti_000000.bin": 115_384,
    "small_gicp_source.ply": 69_792,
    "mosd_test50.pcd": 307_200,
    "autzen_trim.las": 110_000,
    "split-1.laz": 122_893,
}


@pytest.mark.parametrize("name", COUNTS)
def test_a_real_scan_comes_back_and_only_what_moved_differs(name: str, tmp_path: Path) -> None:
    if not (scan := SCANS / name).is_file():
        pytest.skip(f"{scan} is absent")
    try:
        cloud, format = read_cloud(scan)
    except MissingDependency as missing:
        pytest.skip(missing.message)
    assert len(cloud) == COUNTS[name]
    write_cloud(cloud, same := tmp_path / f"same{scan.suffix}", format)
    assert same.read_bytes() == scan.read_bytes()

    moved = cloud.xyz.copy()
    moved[::3] += 0.03
    write_cloud(cloud.with_xyz(moved), other := tmp_path / f"moved{scan.suffix}", format)
    again, _ = read_cloud(other)
    rest = np.arange(len(cloud)) % 3 != 0
    np.testing.assert_array_equal(again.xyz[rest], cloud.xyz[rest])
    np.testing.assert_allclose(again.xyz, moved, atol=0.006)
    assert list(again.attributes) == list(cloud.attributes)
    for field, values in cloud.attributes.items():
        assert again.attributes[field].tobytes() == values.tobytes(), field
