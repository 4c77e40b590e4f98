"""What ships, and what it is called."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]

PUBLIC = {
    "straightpcf": ["__version__"],
    "straightpcf.points.cloud": ["NORMALS", "PointCloud", "as_positions"],
    "straightpcf.points.options": [
        "DECIMAL",
        "MAX_ITERATIONS",
        "MAX_THREADS",
        "MIN_TILE_POINTS",
        "DenoiseOptions",
        "check_threads",
    ],
    "straightpcf.model.filter": [
        "DEFAULT_WEIGHTS",
        "MIN_POINTS",
        "DenoiseResult",
        "Filter",
        "FinishedPatch",
        "Run",
        "denoise",
        "device_named",
        "load_filter",
    ],
    "straightpcf.model.metrics": ["chamfer_distance", "point_to_mesh_distance", "unit_sphere"],
    "straightpcf.model.nets.straightpcf": ["DistanceModule", "StraightPCF", "VelocityModule"],
    "straightpcf.model.train": ["Stage", "TrainStep", "train"],
}


@pytest.mark.parametrize("module", PUBLIC)
def test_the_public_names_stay_what_they_are(module: str) -> None:
    assert importlib.import_module(module).__all__ == PUBLIC[module]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        return archive.namelist()


@pytest.mark.parametrize(
    "path",
    [
        "straightpcf/__init__.py",
        "straightpcf/__main__.py",
        "straightpcf/py.typed",
        "straightpcf/points/cloud.py",
        "straightpcf/model/kernels/edgeconv.cpp",
        "straightpcf/model/kernels/fused.cpp",
        "straightpcf/model/kernels/kernels.h",
        "straightpcf/model/kernels/knn.cpp",
        "straightpcf/model/kernels/linear.cpp",
        "straightpcf/model/kernels/products.h",
        "straightpcf/model/kernels/tiles.h",
        "straightpcf/model/kernels/vectors.h",
        "straightpcf/model/weights/straightpcf.safetensors",
        "straightpcf/model/weights/README.md",
        "straightpcf/service/app.py",
        "straightpcf/clients/cli.py",
    ],
)
def test_the_wheel_holds_the_package_the_weights_and_the_kernels(wheel: list[str], path: str) -> None:
    assert path in wheel


def test_the_wheel_holds_nothing_else(wheel: list[str]) -> None:
    assert {name.split("/")[0] for name in wheel} == {"straightpcf", "straightpcf-0.1.0.dist-info"}
    assert not [name for name in wheel if "resume" in name or name.endswith((".so", ".pyc"))]


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("straightpcf.clients.sdk", "torch"),
        ("straightpcf.points.formats", "torch"),
        ("straightpcf.service.app", "torch"),
        ("straightpcf.model.filter", "triton"),  # of no use to a CPU
    ],
)
def test_importing_it_does_not_bring_what_is_heavy(module: str, heavy: str) -> None:
    code = f"import sys, {module}; sys.exit({heavy!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("package", ["grpcio", "grpcio-health-checking", "grpcio-reflection", "protobuf"])
def test_no_older_package_is_let_in_than_the_committed_stubs_take(package: str) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (wanted,) = (each for each in map(Requirement, extras["grpc"]) if each.name == package)
    (least,) = (Version(each.version) for each in wanted.specifier if each.operator == ">=")
    stubs, what = "straightpcf_pb2_grpc.py", r"GRPC_GENERATED_VERSION = '(\d+)\.(\d+)\.(\d+)'"
    if package == "protobuf":
        stubs, what = "straightpcf_pb2.py", r"\n    (\d+),\n    (\d+),\n    (\d+),"
    made_by = re.search(what, (ROOT / "points" / "wire" / stubs).read_text())
    assert made_by is not None
    assert least >= Version(".".join(made_by.groups()))
