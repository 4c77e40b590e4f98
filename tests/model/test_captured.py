"""What a CUDA graph is to hold never waits for the device nor takes anything from the host, shown without either.

Meta tensors stand in for those of a device: they have shapes and no values, so nothing that asks for a value runs.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from straightpcf.model.filter import Filter
from straightpcf.model.kernels import cuda, cuda_gradient
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.on_device import OnDevice, _DeviceCut, _Heard
from straightpcf.model.patches import Patches
from straightpcf.model.train.data import PatchSource
from straightpcf.model.train.losses import coupled_loss, distance_loss, velocity_loss
from straightpcf.model.train.soap import SOAP
from straightpcf.model.train.step import GraphedStep
from straightpcf.model.turns import turns
from tests.clouds import torus

DEVICE = torch.device("meta")
# Beside what meta tensors refuse by themselves: on a GPU these read their result's size, or an error, on the host.
WAIT = {"_local_scalar_dense", "equal", "nonzero", "masked_select", "unique", "_unique2", "bincount", "linalg_eigh"}


class Captured(TorchDispatchMode):
    """Refuse what a capture refuses."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        tensors = [leaf for leaf in torch.utils._pytree.tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        assert name not in WAIT, f"{name} waits for the device"
        assert all(tensor.device == DEVICE for tensor in tensors), f"{name} reads from the host"
        made = func(*args, **(kwargs or {}))
        for tensor in torch.utils._pytree.tree_leaves(made):
            assert not isinstance(tensor, torch.Tensor) or tensor.device == DEVICE, f"{name} makes a tensor of the host"
        return made


class OnCuda(TorchFunctionMode):
    """Let meta tensors say that they are on a GPU."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return True if func == torch.Tensor.is_cuda.__get__ else func(*args, **(kwargs or {}))  # type: ignore[attr-defined]


class Launched:
    """A kernel that is given meta tensors, and does nothing."""

    def __getitem__(self, grid: Any) -> Any:
        return lambda *tensors, **constants: None


@pytest.fixture(autouse=True)
def shapes_for_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    def knn(x: torch.Tensor, k: int, rows: int) -> torch.Tensor:
        return x.new_empty((len(x), rows, k), dtype=torch.int32)

    def edge_max(a: torch.Tensor, b: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        return a.new_empty((*a.shape[:2], len(weight)))

    def edge_conv(a: torch.Tensor, *others: torch.Tensor, activation: bool) -> torch.Tensor:
        *_, half = others
        return half.new_empty(half.shape if activation else 0, dtype=torch.float32)

    for name, shaped in {
        "load": lambda: True,
        "knn": knn,
        "edge_max": edge_max,
        "edge_conv": edge_conv,
    }.items():
        monkeypatch.setattr(cuda, name, shaped)
    monkeypatch.setattr(cuda_gradient, "load_gradient", lambda: cuda.triton is not None)
    monkeypatch.setattr(cuda, "_edge_max", Launched(), raising=False)
    for kernel in ("_hidden_gradient", "_weight_gradient"):
        monkeypatch.setattr(cuda_gradient, kernel, Launched(), raising=False)
    monkeypatch.setattr(torch, "_standard_gamma", torch.empty_like)  # torch 2.11 does not know its shape


def on_device() -> StraightPCF:
    with DEVICE:  # widths that the kernels take
        return StraightPCF(width=128, distance_width=128).eval()


@pytest.mark.parametrize("read_before", [False, True])
def test_the_network_of_a_pass_can_be_captured(*, read_before: bool) -> None:
    network, positions = on_device().requires_grad_(requires_grad=False), turns(6).to(DEVICE)
    x, owned = torch.empty(4, 1000, 3, device=DEVICE), torch.empty(4, dtype=torch.int64, device=DEVICE)
    distance = torch.empty(4, 1, device=DEVICE) if read_before else None
    with torch.inference_mode(), OnCuda(), Captured():
        moved, _ = network(x, rows=384, owned=owned, distance=distance, turns=positions)
    assert moved.shape == (4, 384, 3)


@pytest.mark.parametrize("known_distances", [{}, dict.fromkeys(range(40), 0.5)])
@pytest.mark.parametrize("agree", [False, True])
def test_a_batch_waits_for_nothing(known_distances: dict[int, float], *, agree: bool) -> None:
    network, captured = on_device().requires_grad_(requires_grad=False), []
    model = Filter(network, device="meta", threads=1)

    def capture(run: Any) -> tuple[Any, torch.Tensor]:
        captured.append(run)
        return run, run()

    rows, each = np.arange(40), np.ones(40)
    cut = Patches(rows, np.zeros((40, 1000), np.int32), 4 * rows + 1, each)
    processor = OnDevice(model, "meta", batch=8, capture=capture)
    points = torch.empty(5000, 3, dtype=torch.float64, device=DEVICE)
    sent = _DeviceCut.of(cut, each, known_distances, DEVICE)
    heard = _Heard(5000, sent) if agree else None
    with OnCuda(), Captured():
        for first in range(0, 40, 8):
            if heard is not None:
                assert processor._hear(points, sent, heard, slice(first, first + 8)) == 8
        for first in range(0, 40, 8):
            assert processor._launch(points, cut, sent, range(first, first + 8), heard).shape[0] == 8
    # Rows up to 64 and to 128 come twice, up to 192 once; the first evaluation is of all points.
    assert len(captured) == (3 if agree else 2)


@pytest.mark.parametrize("loss", [velocity_loss, coupled_loss, distance_loss])
def test_an_iteration_of_training_can_be_captured(loss: Any) -> None:
    network = on_device()
    trained: torch.nn.Module = network.velocity_modules
    if loss is distance_loss:
        trained, _ = network.distance_module, network.velocity_modules.requires_grad_(requires_grad=False)
    source = PatchSource([[torus(4500).astype(np.float32), torus(7000).astype(np.float32)]])
    optimiser = SOAP(trained.train().parameters())
    step = GraphedStep(source, partial(loss, network, rows=256), trained, optimiser, DEVICE, 4)
    with OnCuda():
        step._run()  # what is set up in the first iterations is not captured
        with Captured():
            step._run()
