"""Fixtures of the model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.clouds import sphere, torus


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "shapes.npz"
    clouds = {f"shape{i:02d}/2000": (torus(2000, i) if i % 2 else sphere(2000, i)) for i in range(11)}
    np.savez(path, **{name: cloud.astype(np.float32) for name, cloud in clouds.items()})
    return path
