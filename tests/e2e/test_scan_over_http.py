"""The promise of the README: a scan goes in, the same points come back, whoever asks."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import plyfile
import pytest

from straightpcf.clients.sdk import AsyncClient, Client
from tests.clouds import distance_to_torus, noisy, torus
from tests.conftest import RunningServer, clean_environment

POINTS = 2000
FAR = np.array([500_000.0, 5_400_000.0, 300.0])


def vertices_of(path: Path) -> npt.NDArray[Any]:
    return np.asarray(plyfile.PlyData.read(path)["vertex"].data)


def positions(vertices: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    return np.stack([vertices[axis] for axis in "xyz"], axis=1) - FAR


@pytest.fixture(scope="module", params=["ascii", "binary_little_endian", "binary_big_endian"])
def scan(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A torus scan with colours, intensity and a label around the positions, and faces after them."""
    rng = np.random.default_rng(0)
    vertices = np.zeros(
        POINTS,
        dtype=[("label", "i4"), ("x", "f8"), ("y", "f8"), ("z", "f8"), ("red", "u1"), ("green", "u1"), ("gps", "f8")],
    )
    xyz = noisy(torus(POINTS), 0.01) + FAR
    vertices["x"], vertices["y"], vertices["z"] = xyz.T
    vertices["label"] = np.arange(POINTS)[::-1]
    vertices["red"], vertices["green"] = rng.integers(0, 256, (2, POINTS))
    vertices["gps"] = rng.uniform(1e9, 2e9, POINTS)
    faces = np.array([([0, 1, 2],), ([2, 3, 4],)], dtype=[("vertex_indices", "i4", (3,))])
    path = tmp_path_factory.mktemp("scan") / "scan.ply"
    plyfile.PlyData(
        [plyfile.PlyElement.describe(vertices, "vertex"), plyfile.PlyElement.describe(faces, "face")],
        text=request.param == "ascii",
        byte_order=">" if request.param == "binary_big_endian" else "<",
        comments=["made by hand"],
    ).write(path)
    return path


def test_curl_gives_the_same_points_in_the_same_order_with_the_same_other_fields(
    server: RunningServer, scan: Path, tmp_path: Path
) -> None:
    target = tmp_path / "clean.ply"
    arguments = ["-sf", "-F", f"file=@{scan}", f"{server.url}/denoise", "-o", str(target)]
    subprocess.run(["curl", *arguments], check=True)
    before, after = vertices_of(scan), vertices_of(target)
    assert before.dtype.names == after.dtype.names
    for name in ("label", "red", "green", "gps"):
        np.testing.assert_array_equal(before[name], after[name])
    moved = np.linalg.norm([before[axis] - after[axis] for axis in "xyz"], axis=0)
    assert 0 < moved.max() < 0.2
    assert distance_to_torus(positions(after)).mean() < distance_to_torus(positions(before)).mean()
    sent, got = plyfile.PlyData.read(scan), plyfile.PlyData.read(target)
    assert (sent.comments, sent.text, sent.byte_order) == (got.comments, got.text, got.byte_order)
    np.testing.assert_array_equal(
        np.stack(list(sent["face"]["vertex_indices"])), np.stack(list(got["face"]["vertex_indices"]))
    )


@pytest.mark.parametrize("scan", ["binary_little_endian"], indirect=True)
def test_the_command_line_the_sdk_and_curl_give_the_same_bytes(
    server: RunningServer, scan: Path, tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "straightpcf.clients.cli", "denoise", str(scan), str(tmp_path / "cli.ply")]
    command += ["--iterations", "1", "--seed", "3", "--device", "cpu"]
    subprocess.run(command, check=True, env=clean_environment(), capture_output=True)
    url = f"{server.url}/denoise"
    form = ["-F", f"file=@{scan}", "-F", "iterations=1", "-F", "seed=3"]
    subprocess.run(["curl", "-sf", *form, url, "-o", str(tmp_path / "curl.ply")], check=True)
    with Client(server.url) as client:
        client.denoise(scan, tmp_path / "sdk.ply", iterations=1, seed=3)

    async def denoise() -> None:
        async with AsyncClient(server.url) as client:
            await client.denoise(str(scan), str(tmp_path / "async.ply"), iterations=1, seed=3)

    asyncio.run(denoise())
    results = {name: (tmp_path / f"{name}.ply").read_bytes() for name in ("cli", "curl", "sdk", "async")}
    assert len(set(results.values())) == 1
