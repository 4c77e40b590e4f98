"""The Triton kernels compute what their torch twins do; on the CPU, through Triton's interpreter."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not installed: pip install triton")

# In a process of its own: the interpreter is chosen by the environment, before Triton is imported.
_COMPARE = """
import torch
from straightpcf.model.kernels import cuda
from straightpcf.model import ops

device = "cuda" if torch.cuda.is_available() else "cpu"
generator = torch.Generator().manual_seed(0)
for points, channels, rows in ((200, 3, 200), (130, 32, 70), (333, 64, 40), (20, 3, 20), (34, 16, 34)):
    x = torch.randn(2, points, channels, generator=generator).to(device)
    found, expected = cuda.knn(x, 32, rows).long(), ops.knn_torch(x, 32, rows)
    assert (found.sort().values == expected.sort().values).float().mean() > 0.999, (points, channels)
for channels, out in ((16, 16), (32, 32), (64, 64), (128, 128), (256, 256)):
    a, b = torch.randn(2, 2, 100, channels, generator=generator).to(device)
    weight = (torch.randn(out, channels, generator=generator) / channels**0.5).to(device)
    index = ops.knn_torch(b, 32, 70)
    found, expected = cuda.edge_max(a[:, :70], b, index.int(), weight), ops.edge_max_torch(a[:, :70], b, index, weight)
    assert (found - expected).norm() / expected.norm() < 2e-3, (channels, out)
print("same")
"""


def test_the_kernels_are_their_torch_twins(tmp_path: Path) -> None:
    (script := tmp_path / "compare.py").write_text(_COMPARE)
    interpreted = {} if torch.cuda.is_available() else {"TRITON_INTERPRET": "1"}
    import os

    done = subprocess.run(
        [sys.executable, "-W", "ignore", script], env={**os.environ, **interpreted}, capture_output=True, text=True
    )
    assert done.stdout == "same\n", done.stderr
