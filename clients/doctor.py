"""Find out what this machine has of what denoising needs."""

from __future__ import annotations

import importlib.metadata
import platform
import warnings
from pathlib import Path
from typing import Any

import straightpcf
from straightpcf.points.errors import MissingDependency, StraightPCFError

__all__ = ["examine"]

# As in pyproject.toml, without the extras that an extra takes in.
EXTRAS = {
    "model": ("torch", "scipy", "fpsample", "safetensors"),
    "service": (
        "fastapi",
        "fastapi-offline",
        "starlette",
        "uvicorn",
        "pydantic",
        "python-multipart",
        "prometheus-client",
    ),
    "grpc": ("grpcio", "grpcio-health-checking", "grpcio-reflection", "grpcio-status", "protobuf"),
    "las": ("lazrs",),
    "open3d": ("open3d",),
}


def examine() -> tuple[dict[str, Any], bool]:
    """Return what was found, and whether a cloud can be denoised here."""
    findings: dict[str, Any] = {
        "straightpcf": straightpcf.__version__,
        "python": f"{platform.python_version()} on {platform.platform()}",
        "extras": {extra: _extra(packages) for extra, packages in EXTRAS.items()},
    }
    try:
        findings |= _examine_model()
    except ImportError as exc:
        return findings | {"problem": MissingDependency.of("model", exc).message}, False
    except StraightPCFError as exc:
        return findings | {"problem": f"[{exc.code}] {exc.message}"}, False
    except OSError as exc:
        return findings | {"problem": str(exc)}, False
    return findings, True


def _examine_model() -> dict[str, Any]:
    import torch

    from straightpcf.model.filter import load_filter

    names = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    denoiser = load_filter()
    return {
        "torch": f"{torch.__version__}, {torch.get_num_threads()} threads",
        "cuda": ", ".join(names) or "none",
        "device": denoiser.device,
        "kernels": _kernels(),
        "weights": "shipped, loaded",
    }


def _kernels() -> str:
    """Say which compiled loops the CPU has, or why it has none and takes several times as long; compiles them."""
    from straightpcf.model.kernels import cpu

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        library = cpu.load()
    if told or library is None:
        return str(told[0].message) if told else "none, as STRAIGHTPCF_NO_KERNELS asks; several times slower"
    return Path(library._name).name.split("-")[2]


def _extra(packages: tuple[str, ...]) -> str:
    missing = [name for name in packages if not _version(name)]
    return f"missing {', '.join(missing)}" if missing else "installed"


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
