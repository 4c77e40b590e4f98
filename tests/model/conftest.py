"""Fixtures of the model."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from straightpcf.model.filter import Filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.train import loop
from tests.clouds import sphere, torus


@pytest.fixture(scope="session")
def tiny() -> Filter:
    """An untrained narrow network: enough for everything but quality, and fast."""
    torch.manual_seed(0)
    return Filter(StraightPCF(width=64, distance_width=64), threads=2, coverage=2)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "shapes.npz"
    clouds = {f"shape{i:02d}/2000": (torus(2000, i) if i % 2 else sphere(2000, i)) for i in range(11)}
    np.savez(path, **{name: cloud.astype(np.float32) for name, cloud in clouds.items()})
    return path


@pytest.fixture(scope="module")
def few_to_validate_with() -> Iterator[None]:
    """Runs of a few iterations would take most of their time for the validation at their end: two batches will do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "_VALIDATION_PATCHES", 16)
        yield
