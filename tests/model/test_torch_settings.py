"""What a program has set of torch for itself changes nothing of what is filtered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from straightpcf.model.checkpoint import save_checkpoint
from straightpcf.model.filter import Filter, load_filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.on_device import OnDevice
from straightpcf.points.options import DenoiseOptions
from tests.clouds import noisy, torus

CLOUD, ONE_PASS = noisy(torus(60), 0.01), DenoiseOptions(iterations=1)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    save_checkpoint(StraightPCF(width=32, distance_width=32), path := tmp_path_factory.mktemp("weights") / "w")
    return path


def loaded(weights: Path, *, as_device: bool = False) -> Filter:
    filter = load_filter(weights, device="cpu", threads=1)
    if as_device:
        filter.processor = OnDevice(filter, "cpu", batch=1)
    return filter


@pytest.mark.parametrize("as_device", [False, True], ids=["host", "device"])
def test_another_default_type_is_no_matter_before_or_after_loading(as_device: bool, weights: Path) -> None:
    """The kernels write float32 into what they are given: it may be no shorter."""
    filter = loaded(weights, as_device=as_device)
    expected = filter.denoise(CLOUD, ONE_PASS).xyz
    before = torch.get_default_dtype()
    try:
        for dtype in (torch.float64, torch.float16):
            torch.set_default_dtype(dtype)
            for one in (filter, loaded(weights, as_device=as_device)):
                np.testing.assert_array_equal(one.denoise(CLOUD, ONE_PASS).xyz, expected)
    finally:
        torch.set_default_dtype(before)


def test_weights_that_are_loaded_in_inference_mode_take_the_kernels_too(weights: Path) -> None:
    expected = loaded(weights).denoise(CLOUD, ONE_PASS).xyz
    with torch.inference_mode():
        filter = loaded(weights)
    assert not any(weight.is_inference() for weight in filter.network.parameters())
    np.testing.assert_array_equal(filter.denoise(CLOUD, ONE_PASS).xyz, expected)
