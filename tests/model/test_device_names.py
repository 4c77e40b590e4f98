"""A device is named, and is there, or it is refused."""

from __future__ import annotations

import pytest
import torch

from straightpcf.model.filter import device_named, load_filter
from straightpcf.points.errors import DeviceUnavailable


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_a_device_that_is_not_here_is_named() -> None:
    with pytest.raises(DeviceUnavailable, match="cuda"):
        load_filter(device="cuda")


def test_a_device_that_its_driver_cannot_serve_is_not_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device_named("auto") == "cpu"
    with pytest.raises(DeviceUnavailable, match="0 CUDA devices"):
        device_named("cuda")


@pytest.mark.parametrize("name", ["tpu", "cuda:", "cuda:x", "auto:1", ""])
def test_a_device_of_no_kind_is_refused(name: str) -> None:
    with pytest.raises(DeviceUnavailable, match="must be"):
        load_filter(device=name)
