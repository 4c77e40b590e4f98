"""The Triton kernels compute what their torch twins do, through Triton's interpreter, and compile for a GPU."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not installed: pip install triton")

# In processes of their own: the interpreter is chosen by the environment, before Triton is imported.
_COMPARE = """
import torch
from straightpcf.model import device_patches, ops
from straightpcf.model.kernels import cuda

device = "cuda" if torch.cuda.is_available() else "cpu"
generator = torch.Generator().manual_seed(0)
for points, channels, k, rows in ((200, 3, 32, 7), (200, 3, 16, 5), (130, 32, 32, 5), (333, 64, 32, 3),
                                  (20, 3, 32, 20), (2, 3, 32, 2), (34, 16, 32, 34)):
    x = torch.randn(2, points, channels, generator=generator).to(device)
    found, expected = cuda.knn(x, k, rows).long(), ops.knn_torch(x, k, rows)
    assert not (found == torch.arange(rows, device=device)[:, None]).any()
    distinct = [len(row.unique()) for index in (found, expected) for row in index.flatten(0, 1)]
    assert set(distinct) == {min(k, points - 1)}, (points, channels)
    # Which of two points as near as each other is taken depends on the rounding of a machine's products.
    squares = (x[:, :rows, None].double() - x[:, None].double()).square().sum(dim=3)
    apart, wanted = (squares.gather(2, index).sort(dim=2).values for index in (found, expected))
    assert torch.allclose(apart, wanted, rtol=2**-12), (points, channels, ((apart - wanted) / wanted).abs().max())
for channels, out in ((16, 16), (32, 32), (64, 64), (128, 128), (256, 256)):
    a, b = torch.randn(2, 2, 100, channels, generator=generator).to(device)
    weight = (torch.randn(out, channels, generator=generator) / channels**0.5).to(device)
    index = ops.knn_torch(b, 32, 22)
    found, expected = cuda.edge_max(a[:, :22], b, index.int(), weight), ops.edge_max_torch(a[:, :22], b, index, weight)
    assert (found - expected).norm() / expected.norm() < 2e-3, (channels, out)
cloud = torch.randn(9000, 3, generator=generator).to(device)
for wanted, first in ((1, 0), (8, 1), (8, 8999)):
    assert torch.equal(cuda.farthest(cloud, wanted, first), device_patches.farthest_torch(cloud, wanted, first))
print("same")
"""

# A module as one, and what each machine with a GPU asks of the kernels before it takes them.
_COMPARE_MODULES = """
import torch
from straightpcf.model.kernels import cuda, cuda_gradient
from straightpcf.model.kernels.fused_cuda import FusedOnDevice
from straightpcf.model.nets.straightpcf import DistanceModule, VelocityModule

torch.manual_seed(0)
device = "cuda" if torch.cuda.is_available() else "cpu"
generator = torch.Generator().manual_seed(0)
for module in (VelocityModule(128).eval(), DistanceModule(128).eval()):
    whole = FusedOnDevice(module.to(device).encoder, module.decoder, 32)
    x = torch.randn(1, 34, 3, generator=generator).to(device) * 0.2
    for rows in (None, 5)[: 2 if isinstance(module, VelocityModule) else 1]:
        with torch.no_grad():
            found, expected = whole(x, rows), module.decoder(module.encoder(x, rows))
        assert found.shape == expected.shape and found.dtype == torch.float32
        assert (found - expected).norm() / expected.norm() < 3e-2, (type(module), rows)
for prove in (cuda._prove, cuda_gradient._prove_gradient):
    prove(torch.device(device), 1000 if device == "cuda" else 34)
print("same")
"""

# The wrappers are called with tensors of the filter's shapes; compiling stands in for launching. What a block of an
# H100 or H200 may have: 227 KiB of shared memory.
_COMPILE = """
import torch, triton
from triton.backends.compiler import GPUTarget
from triton.runtime.jit import JITFunction
from straightpcf.model.kernels import cuda, cuda_gradient

class Hopper:
    def get_current_target(self): return GPUTarget("cuda", 90, 32)
    def get_current_device(self): return 0
    def get_current_stream(self, device): return 0

triton.runtime.driver.set_active(Hopper())
launch, made = JITFunction.run, []

def compile_only(kernel, *arguments, grid, warmup, **options):
    made.append(launch(kernel, *arguments, grid=grid, warmup=True, **options))

JITFunction.run = compile_only
for points, channels, k, rows in ((1000, 3, 32, 1000), (1000, 3, 16, 401), (1000, 16, 32, 1000), (1000, 32, 32, 1000),
                                  (1000, 64, 32, 384), (2048, 64, 32, 1), (33, 3, 32, 33)):
    cuda.knn(torch.zeros(2, points, channels), k, rows)
for width in (16, 32, 64, 128, 256):
    a, b, index = torch.zeros(2, 384, width), torch.zeros(2, 1000, width), torch.zeros(2, 384, 32, dtype=torch.int32)
    cuda.edge_max(a, b, index, torch.zeros(width, width))
    weight, half = torch.zeros(width, width).half(), torch.zeros(2, 384, 2 * width).half()[:, :, :width]
    cuda.edge_conv(a, b, a, index, weight, torch.zeros(width), half, activation=width < 128)
for count, wanted, first in ((50_000, 150, 0), (50_000, 150, 1), (50_000, 150, 7), (333, 1, 1)):
    cuda.farthest(torch.zeros(count, 3), wanted, first)
for width, rows in ((32, 1000), (256, 256)):
    a, b = torch.zeros(2, rows, width), torch.zeros(2, 1000, width)
    index = torch.zeros(2, rows, 32, dtype=torch.int32)
    of = a, b, torch.zeros(width, width)
    cuda_gradient._gradients(cuda_gradient.EdgeMax.apply, of, index, torch.ones(2, rows, width))
assert len(made) == 31, made
assert all(kernel.asm["cubin"] and kernel.metadata.shared <= 227 * 1024 for kernel in made)

# A gaming card has 99 KiB.
Hopper.get_current_target = lambda self: GPUTarget("cuda", 86, 32)
Hopper.get_current_device = lambda self: 1
cuda._room = lambda device: 99 * 1024
made.clear()
a, b, index = torch.zeros(2, 384, 256), torch.zeros(2, 1000, 256), torch.zeros(2, 384, 32, dtype=torch.int32)
cuda_gradient._gradients(cuda_gradient.EdgeMax.apply, (a, b, torch.zeros(256, 256)), index, torch.ones(2, 384, 256))
assert [kernel.metadata.shared <= 99 * 1024 for kernel in made] == [True] * 3, made
print("compiled")
"""


def ran(script: str, tmp_path: Path, **environment: str) -> str:
    (path := tmp_path / "script.py").write_text(script)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", path], env={**os.environ, **environment}, capture_output=True, text=True
    )
    return done.stdout + done.stderr


@pytest.mark.parametrize(
    "script", [_COMPARE, pytest.param(_COMPARE_MODULES, marks=pytest.mark.slow)], ids=["each", "modules"]
)
def test_the_kernels_are_their_torch_twins(script: str, tmp_path: Path) -> None:
    interpreted = {} if torch.cuda.is_available() else {"TRITON_INTERPRET": "1"}
    assert ran(script, tmp_path, **interpreted) == "same\n"


@pytest.mark.slow
def test_the_kernels_compile_for_hopper_and_fit_it(tmp_path: Path) -> None:
    # The interpreter runs what the compiler refuses: once none of these kernels compiled, and all agreed.
    assert ran(_COMPILE, tmp_path, TRITON_CACHE_DIR=str(tmp_path / "cache")) == "compiled\n"
