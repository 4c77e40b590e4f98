"""The network is the paper's: an independent plain implementation agrees, the authors' weights give their figures."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from straightpcf.model.checkpoint import load_official_checkpoint, read_official_checkpoint
from straightpcf.model.kernels import cpu
from straightpcf.model.metrics import chamfer_distance, point_to_mesh_distance
from straightpcf.model.nets.straightpcf import StraightPCF, VelocityModule

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "data"
CHECKPOINT, SHAPES = SHARED / "official" / "ckpt_vm.pt", SHARED / "punet_test.npz"
EULER_STEPS = 4

needs_data = pytest.mark.skipif(
    not (CHECKPOINT.is_file() and SHAPES.is_file()), reason=f"the authors' checkpoint and PUNet are not in {SHARED}"
)


@pytest.fixture(scope="module")
def reference() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        from benchmarks import reference

        yield reference


@pytest.fixture(params=["torch", "kernels"])
def tolerance(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> float:
    """Run with the plain torch twins, then with the CPU kernels; return what share of the largest value may differ."""
    if request.param == "torch":
        monkeypatch.setattr(cpu, "load", lambda: None)
        return 1e-3  # over several steps a neighbour at equal distance may change
    return 0.03  # products may be bfloat16


def torus_patch(points: int = 1000) -> torch.Tensor:
    """Return a noisy (1, P, 3) patch of a torus of radius 1, its first point at the origin."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-0.5, 0.5, points), rng.uniform(-1, 1, points)
    ring = 0.7 + 0.3 * np.cos(v)
    xyz = np.stack([ring * np.cos(u), ring * np.sin(u), 0.3 * np.sin(v)], axis=1)
    xyz += rng.normal(scale=0.01, size=xyz.shape)
    return torch.from_numpy((xyz - xyz[0]).astype(np.float32))[None]


def network() -> StraightPCF:
    """Return a StraightPCF whose BatchNorms have statistics that matter."""
    torch.manual_seed(0)
    model = StraightPCF()
    generator = torch.Generator().manual_seed(1)
    for name, buffer in model.named_buffers():
        if buffer.is_floating_point():
            buffer.copy_(torch.rand(buffer.shape, generator=generator) * 0.2 + (1.0 if name.endswith("var") else -0.1))
    return model.eval()


def share_that_differs(ours: torch.Tensor, theirs: torch.Tensor) -> float:
    return float((ours - theirs).abs().max() / theirs.abs().max())


@torch.inference_mode()
def test_velocity_module_is_the_plain_formula(reference: ModuleType, tolerance: float) -> None:
    model, patch = network().velocity_modules[0], torus_patch()
    assert share_that_differs(model(patch), reference.velocity(model.state_dict(), patch)) < tolerance


@torch.inference_mode()
def test_distance_module_is_the_plain_formula(reference: ModuleType, tolerance: float) -> None:
    model, patch = network().distance_module, torus_patch()
    ours, plain = (torch.logit(d) for d in (model(patch), reference.distance(model.state_dict(), patch)))
    assert share_that_differs(ours, plain) < tolerance


@torch.inference_mode()
def test_one_pass_is_the_plain_formula(reference: ModuleType, tolerance: float) -> None:
    model, patch = network(), torus_patch()
    moved, _ = model(patch, euler_steps=2)
    plain = reference.straightpcf(model.state_dict(), couplings=2, steps=2)(patch)
    assert share_that_differs(moved - patch, plain - patch) < tolerance


@needs_data
@torch.inference_mode()
def test_official_weights_are_the_plain_formula(reference: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    patch = torus_patch()
    state = reference.part(read_official_checkpoint(CHECKPOINT), "velocity_modules.0.")
    monkeypatch.setattr(cpu, "load", lambda: None)
    assert share_that_differs(official()(patch), reference.velocity(state, patch)) < 1e-4


@pytest.mark.slow
@needs_data
def test_official_weights_give_the_authors_figures_on_cow(reference: ModuleType) -> None:
    cd, p2m = measured(reference, "cow")
    assert cd == pytest.approx(1.547, rel=0.02)
    assert p2m == pytest.approx(0.384, rel=0.02)


@needs_data
@pytest.mark.slow
def test_official_weights_give_the_authors_figures_on_twenty_shapes(reference: ModuleType) -> None:
    figures = [measured(reference, shape) for shape in shapes()]
    assert len(figures) == 20
    cd, p2m = np.mean(figures, axis=0)
    assert cd == pytest.approx(2.01, rel=0.02)
    assert p2m == pytest.approx(0.35, rel=0.02)


def official() -> VelocityModule:
    model = load_official_checkpoint(CHECKPOINT)
    assert isinstance(model, VelocityModule)
    assert sum(parameter.numel() for parameter in model.parameters()) == 234_947
    return model


def shapes() -> list[str]:
    return sorted({key.split("/")[0] for key in _data().files})


def measured(reference: ModuleType, shape: str) -> tuple[float, float]:
    """Return CD and P2M x 1e4 of the authors' single module, 10K points, 1 % noise, one pass of 4 Euler steps."""
    data, model = _data(), official()

    def move(x: torch.Tensor) -> torch.Tensor:
        for _ in range(EULER_STEPS):
            x = x + model(x) / EULER_STEPS
        return x

    result = reference.denoise(data[f"{shape}/10000/noisy_0.01"], move, batch=1)
    assert result.uncovered == 0
    cd = chamfer_distance(result.xyz, data[f"{shape}/10000"])
    p2m = point_to_mesh_distance(result.xyz, data[f"{shape}/vertices"], data[f"{shape}/faces"])
    return cd * 1e4, p2m * 1e4


@functools.cache
def _data() -> Any:
    return np.load(SHAPES)
