"""Fixtures of the service."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.clouds import noisy, torus
from tests.service.rest import POINTS


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clouds") / "torus.npy"
    np.save(path, noisy(torus(POINTS), 0.01).astype(np.float32))
    return path
