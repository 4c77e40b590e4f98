"""The SDK against a real server."""

from __future__ import annotations

import asyncio
import io
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import httpx2
import numpy as np
import pytest

from straightpcf.clients import sdk
from straightpcf.clients.sdk import AsyncClient, AsyncJob, Client, Job
from straightpcf.clients.sdk.aio import AsyncJobs
from straightpcf.clients.sdk.client import Jobs
from straightpcf.clients.sdk.request import upload_call
from straightpcf.points.errors import (
    InvalidCloud,
    InvalidOptions,
    InvalidRequest,
    MissingDependency,
    TooFewPoints,
    TooManyBytes,
    UnknownFormat,
)
from tests.clouds import noisy, sphere, torus
from tests.conftest import RunningServer

POINTS = 400


@pytest.fixture
def client(server: RunningServer) -> Iterator[Client]:
    with Client(server.url) as client:
        yield client


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    np.save(path := tmp_path / "scan.npy", noisy(torus(POINTS), 0.01))
    return path


def test_the_public_names_are_these() -> None:
    assert sdk.__all__ == [
        "AsyncClient", "AsyncJob", "Client", "Completed", "Denoised", "Event", "Health", "Job", "JobInfo", "Log",
        "Output", "Preview", "Progress", "Queued", "Report", "ResultInfo", "ServerInfo", "Started",
    ]  # fmt: skip
    assert public(Client) == {"close", "denoise", "health", "info"}
    assert public(AsyncClient) == {"aclose", "denoise", "health", "info"}
    assert public(Job) == public(AsyncJob) == {
        "cancel", "delete", "events", "id", "patches", "refresh", "result", "wait",
    }  # fmt: skip
    assert public(Jobs) == public(AsyncJobs) == {"create", "get", "list"}


def public(kind: type) -> set[str]:
    return {name for name in vars(kind) if not name.startswith("_")}


def test_the_sdk_imports_neither_torch_nor_a_server() -> None:
    heavy = "{'torch', 'fastapi', 'uvicorn', 'scipy', 'pydantic', 'open3d', 'plyfile', 'laspy'}"
    code = f"import sys, straightpcf.clients.sdk; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() in ("[]", "['plyfile']")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_array_comes_back_as_an_array_of_its_dtype_and_frame(client: Client, dtype: Any) -> None:
    xyz = (noisy(torus(POINTS), 0.01) + np.array([100.0, -50.0, 7.0])).astype(dtype)
    result = client.denoise(xyz, iterations=1)
    assert result.xyz.dtype == dtype
    assert result.xyz.shape == xyz.shape
    assert np.abs(result.xyz - xyz).max() < 0.5
    assert (result.points, result.iterations, result.untouched) == (POINTS, 1, 0)
    assert result.request_id


def test_positions_of_an_array_of_more_columns_are_three(client: Client, tmp_path: Path) -> None:
    np.save(path := tmp_path / "wide.npy", np.hstack([noisy(torus(POINTS), 0.01), np.ones((POINTS, 3))]))
    assert client.denoise(path, iterations=1).xyz.shape == (POINTS, 3)


def test_positions_of_records_are_their_x_y_and_z(client: Client, tmp_path: Path) -> None:
    records = np.zeros(POINTS, [("intensity", "<f4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    records["x"], records["y"], records["z"] = noisy(torus(POINTS), 0.01).T
    np.save(path := tmp_path / "records.npy", records)
    result = client.denoise(path, tmp_path / "clean.npy", iterations=1)
    clean = np.load(tmp_path / "clean.npy")
    np.testing.assert_array_equal(result.xyz, np.stack([clean["x"], clean["y"], clean["z"]], axis=1))


def test_path_bytes_and_array_give_the_same_points(client: Client, scan: Path, tmp_path: Path) -> None:
    target = tmp_path / "clean.npy"
    by_path = client.denoise(scan, target, iterations=1)
    assert by_path.path == target
    assert by_path.content is None
    by_bytes = client.denoise(scan.read_bytes(), iterations=1)
    by_array = client.denoise(np.load(scan), iterations=1)
    assert target.read_bytes() == by_bytes.content == by_array.content
    np.testing.assert_array_equal(by_path.xyz, by_array.xyz)
    assert by_bytes.save(tmp_path / "saved.npy").read_bytes() == by_bytes.content


def test_the_suffix_of_the_target_chooses_the_format(client: Client, scan: Path, tmp_path: Path) -> None:
    result = client.denoise(scan, tmp_path / "clean.xyz", iterations=1)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "clean.xyz"), result.xyz)
    assert client.denoise(scan, format="xyz", iterations=1).xyz.shape == (POINTS, 3)
    with pytest.raises(UnknownFormat):
        client.denoise(scan, tmp_path / "clean.gif")


def test_the_async_client_gives_what_the_sync_one_gives(server: RunningServer, scan: Path, tmp_path: Path) -> None:
    async def both() -> None:
        async with AsyncClient(server.url) as client:
            assert (await client.health()).ready
            assert (await client.info()).version
            assert (await client.denoise(b"1 2 3\n" + b"4 5 6\n" * 99, name="a.xyz", iterations=1)).points == 100
            one, two = await asyncio.gather(
                client.denoise(scan, tmp_path / "clean.npy", iterations=1), client.denoise(np.load(scan), iterations=1)
            )
            np.testing.assert_array_equal(one.xyz, two.xyz)
            with pytest.raises(TooFewPoints):
                await client.denoise(sphere(5))

    asyncio.run(both())
    with Client(server.url) as client:
        assert client.denoise(scan, iterations=1).content == (tmp_path / "clean.npy").read_bytes()


def test_an_error_of_the_server_is_raised_as_its_class_with_the_request_id(client: Client, tmp_path: Path) -> None:
    target = tmp_path / "clean.npy"
    target.write_bytes(b"of old")
    with pytest.raises(TooFewPoints) as caught:
        client.denoise(sphere(5), target)
    assert caught.value.request_id
    assert target.read_bytes() == b"of old"
    assert list(tmp_path.iterdir()) == [target]


def test_what_can_be_known_here_is_refused_before_anything_is_sent() -> None:
    with Client("http://127.0.0.1:1") as client:
        with pytest.raises(InvalidOptions):
            client.denoise(sphere(100), iterations=0)
        with pytest.raises(InvalidCloud, match=r"\(3, 100\).*transpose"):
            client.denoise(sphere(100).T)
        with pytest.raises(FileNotFoundError):
            client.denoise("no-such-file.ply")
        with pytest.raises(FileNotFoundError, match="of a pipe, give its bytes"):
            client.denoise("/dev/null")
        with pytest.raises(InvalidRequest, match="give its bytes"):
            client.denoise(io.BytesIO(b"x"))


def test_whole_numbers_and_any_path_are_taken(client: Client, tmp_path: Path) -> None:
    whole = np.round(100 * sphere(POINTS)).astype(np.int32)
    np.save(path := tmp_path / "whole.npy", whole.astype(np.float64))

    class Somewhere:
        def __fspath__(self) -> str:
            return str(path)

    results = [client.denoise(source, iterations=1).xyz for source in (whole, Somewhere())]
    np.testing.assert_array_equal(*results)


def test_a_body_over_the_limit_is_refused_by_its_class(strict_server: RunningServer) -> None:
    with Client(strict_server.url, max_retries=0) as client, pytest.raises(TooManyBytes):
        client.denoise(sphere(200_000))


def test_info_and_health(client: Client) -> None:
    info = client.info()
    assert client.health() == sdk.Health(status="ok", ready=True)
    assert "ply" in info.formats
    assert info.devices == ("cpu",)


@pytest.mark.parametrize("transport", ["http", "grpc"])
def test_info_holds_all_that_the_server_says_it_takes(server: RunningServer, transport: str) -> None:
    said = httpx2.get(f"{server.url}/v1/info").json()
    with Client(server.url if transport == "http" else server.grpc_url) as client:
        info = asdict(client.info())
    shown = said | {"devices": tuple(said["devices"]), "formats": tuple(each["name"] for each in said["formats"])}
    assert info == shown
    assert [(name, info[name]) for name in ("max_queued_points", "max_sync_seconds", "result_ttl_seconds")] == [
        ("max_queued_points", 200_000_000), ("max_sync_seconds", 300.0), ("result_ttl_seconds", 3600.0),
    ]  # fmt: skip


def test_an_open3d_cloud_comes_back_as_one(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    """open3d itself is 1.2 GB; this one has its shape."""

    class PointCloud:
        def __init__(self, other: Any = None) -> None:
            self.points = None if other is None else other.points
            self.colors = None if other is None else other.colors

    PointCloud.__module__ = "open3d.cpu.pybind.geometry"
    fake = ModuleType("open3d")
    fake.geometry = SimpleNamespace(PointCloud=PointCloud)  # type: ignore[attr-defined]
    fake.utility = SimpleNamespace(Vector3dVector=np.asarray)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "open3d", fake)
    cloud = PointCloud()
    cloud.points, cloud.colors = noisy(sphere(POINTS), 0.01), "red"
    clean = client.denoise(cloud, iterations=1).to_open3d()
    assert clean.colors == "red"
    assert clean.points.shape == (POINTS, 3)


def test_arrays_of_every_kind_are_sent_as_numbers_that_a_server_reads() -> None:
    def sent(source: object) -> np.ndarray:
        call = upload_call(source, iterations=1, seed=0, strength=1.0, format=None)
        assert isinstance(call.body, bytes)
        array: np.ndarray = np.load(io.BytesIO(call.body))
        return array

    masked = np.ma.masked_array(np.ones((2, 3), dtype=np.float32), mask=[[0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(sent(masked), np.array([[1, 1, 1], [np.nan, 1, 1]], dtype=np.float32))
    assert sent(np.ones((2, 3), dtype=np.longdouble)).dtype == np.float64
    assert sent([[1, 2, 3], [4, 5, 6]]).dtype == np.float64
    for wrong, text in (([[1, 2, 3], [4, 5]], "inhomogeneous"), ((row for row in [[1, 2, 3]]), "got a generator")):
        with pytest.raises(InvalidCloud, match=text):
            sent(wrong)


def test_an_open3d_cloud_without_open3d_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingDependency, match=r"straightpcf\[open3d\]"):
        sdk.Denoised(job=SimpleNamespace(), request_id="", content=b"").to_open3d()  # type: ignore[arg-type]
