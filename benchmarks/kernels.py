"""Time the compiled loops against their plain torch twins: `python -m benchmarks.kernels [--device cuda]`.

On a CPU one thread and 4 patches, on a device the batch of 32 that the filter gives it. `--every-set` times a
VelocityModule with the kernels of each instruction set that the processor has, for all points of a patch and for a
third of them, as most evaluations of the filter are.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from unittest import mock

import torch

from benchmarks.command import device as device_here
from benchmarks.speed import finish
from straightpcf.model import ops
from straightpcf.model.allocator import keep_large_buffers
from straightpcf.model.kernels import cpu
from straightpcf.model.nets.straightpcf import VelocityModule

POINTS, NEIGHBOURS = 1000, 32
OWNED = 334  # of a patch's points at 3-fold coverage


def main() -> None:
    """Print a row per operation."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kernels")
    parser.add_argument("--device", type=device_here, default="cpu", help='"cpu" (the default), "cuda" or "cuda:N"')
    parser.add_argument("--every-set", action="store_true", help="the CPU's instruction sets, one by one, instead")
    arguments = parser.parse_args()
    device = arguments.device
    patches = 4 if device == "cpu" else 32

    def milliseconds(function: Callable[..., object], *arguments: object, repeats: int = 7) -> float:
        """Return the median time of a call, per patch."""
        function(*arguments)
        times = []
        for _ in range(repeats):
            finish(device)
            began = time.perf_counter()
            function(*arguments)
            finish(device)
            times.append(time.perf_counter() - began)
        return sorted(times)[repeats // 2] * 1e3 / patches

    torch.set_num_threads(1)
    keep_large_buffers()
    if ":" in device:  # Triton launches on the current one
        torch.cuda.set_device(device)
    torch.set_default_device(device)
    generator = torch.Generator(device).manual_seed(0)
    patch = torch.randn(patches, POINTS, 3, generator=generator) * 0.2
    if arguments.every_set:
        print(f"{'VelocityModule, ms':24} {POINTS:>8} {OWNED:>8}")
        for name in cpu.instruction_sets():
            with mock.patch.object(cpu, "instruction_sets", lambda name=name: (name,)), torch.no_grad():
                cpu.load.cache_clear()
                if cpu.load() is None:  # plain torch's times are no set's
                    print(f"{name:24} not compiled", flush=True)
                    continue
                module = VelocityModule().eval()
                every, owned = (milliseconds(module, patch, rows) for rows in (None, OWNED))
            print(f"{name:24} {every:8.1f} {owned:8.1f}", flush=True)
        cpu.load.cache_clear()
        return
    where = torch.cuda.get_device_name(device) if device != "cpu" else f"{cpu.instruction_sets()[0]}, 1 thread"
    print(f"{where}, {POINTS} points, k = {NEIGHBOURS}, ms per patch")
    print(f"{'':24} {'kernel':>8} {'torch':>8} {'GFLOP/s':>8}")
    for dims in (3, 32, 64):
        x = torch.randn(patches, POINTS, dims, generator=generator)
        ours, torchs = milliseconds(ops.knn, x, NEIGHBOURS), milliseconds(ops.knn_torch, x, NEIGHBOURS, POINTS)
        print(f"knn, {dims:2} dimensions {ours:13.2f} {torchs:8.2f}")
    index = ops.knn(torch.randn(patches, POINTS, 3, generator=generator), NEIGHBOURS)
    for width in (32, 64, 256):
        a, b = (torch.randn(patches, POINTS, width, generator=generator, requires_grad=True) for _ in range(2))
        weight = torch.randn(width, width, generator=generator).div_(width**0.5).requires_grad_()
        with torch.no_grad():
            ours = milliseconds(ops.edge_max, a, b, index, weight)
            torchs = milliseconds(ops.edge_max_torch, a, b, index, weight, repeats=3)
        rate = 2 * POINTS * NEIGHBOURS * width**2 / ours / 1e6
        print(f"edge_max, {width:3} channels {ours:9.2f} {torchs:8.2f} {rate:8.0f}")
        out, grad = ops.edge_max(a, b, index, weight), torch.randn(patches, POINTS, width, generator=generator)
        ours = milliseconds(partial(torch.autograd.grad, retain_graph=True), out, (a, b, weight), grad)
        print(f"  its gradient {ours:18.2f}")
    module = VelocityModule().eval()
    with torch.no_grad():
        every, owned = (milliseconds(module, patch, rows) for rows in (None, OWNED))
    print(f"VelocityModule {every:18.2f}")
    print(f"  {OWNED} of the points {owned:12.2f}")


if __name__ == "__main__":
    main()
