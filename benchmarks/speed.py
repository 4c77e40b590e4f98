"""Time this project's filter beside the authors' way to compute, same weights, same cloud, same run.

    python -m benchmarks.speed
    python -m benchmarks.speed --resolution 10000 --patches all
    python -m benchmarks.speed --device cuda --iterations 2

Each side runs in a process of its own, so that its peak memory is its own. The authors' scheme is
`benchmarks.reference`: it is timed on a sample of its patches and extrapolated unless `--patches all`. On a device both
sides are timed when all is compiled and captured, from points to points on the host; the authors' scheme has its
network there, and the rest on the host.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from benchmarks.command import device, errors_in_one_line, positive
from benchmarks.quality import SHARED
from benchmarks.shapes import Shape, analytic, make_noise, punet
from straightpcf.model.cpus import usable_cpus

if TYPE_CHECKING:
    from straightpcf.model.patches import Patches
    from straightpcf.model.processor import Finish, Floats, Processor

_T = TypeVar("_T")
NOISE = 0.02
SAMPLE = 16
NEIGHBOURS = 32
GEMM_ROWS = 32_000  # the edges of a patch
_GEMM_SECONDS = 2.0  # a rate is measured for so long, once at least


@dataclass(frozen=True)
class Timing:
    """What one side took: seconds, patches computed of those it has, peak resident MiB, and its result.

    gflop: in the matrix products of the patches that it has; neighbour searches are not counted.
    """

    seconds: float
    gflop: float
    patches: str
    peak_mib: float
    xyz: npt.NDArray[np.float64] | None


_R = TypeVar("_R")


@errors_in_one_line()
def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    options = _parser().parse_args(arguments)
    place = options.device if options.device == "cpu" else _alone(_name, options)
    print(f"{place}, {os.cpu_count()} CPUs, {options.threads} threads, {options.iterations} passes, noise {NOISE:g}")
    rates = _alone(_gemm_rates, options)
    said = ", ".join(f"{rate:.0f} in {kind}" for kind, rate in rates.items())
    print(f"GEMM {GEMM_ROWS} x 256 x 256 here, GFLOP/s: {said}")
    for resolution in options.resolution:
        shape = _shape(options, resolution)
        noisy = shape.noisy.get(NOISE)
        noisy = make_noise("gaussian", shape.clean, NOISE, 0) if noisy is None else noisy
        columns = f"{'seconds':>9s} {'peak MiB':>9s} {'GFLOP':>8s} {'/s':>6s} {'CD':>8s} {'P2M':>8s}  patches"
        print(f"\n{shape.name}, {resolution} points {columns}")
        _print("noisy input", None, noisy, shape)
        ours = _alone(_ours, noisy, options)
        _print("this project", ours, ours.xyz, shape)
        theirs = _alone(_reference, noisy, options)
        _print("authors' scheme", theirs, theirs.xyz, shape)
        print(f"ratio {theirs.seconds / ours.seconds:.1f}")


def _ours(noisy: npt.NDArray[np.float64], options: argparse.Namespace) -> Timing:
    from straightpcf.model.filter import load_filter
    from straightpcf.points.options import DenoiseOptions

    model = load_filter(options.weights, device=options.device, threads=options.threads)
    wanted = DenoiseOptions(iterations=options.iterations)
    # What is compiled or loaded once is not the cloud's; on a device, what is captured for its shapes neither.
    for warm in [noisy[:2000]] if options.device == "cpu" else [noisy] * 3:
        model.denoise(warm, wanted)
    model.processor = counting = _Counting(model.processor)
    began = time.perf_counter()
    result = model.denoise(noisy, wanted)
    seconds = time.perf_counter() - began
    done = counting.done
    evaluations = model.euler_steps * len(model.network.velocity_modules)
    gflop = sum(_patch_gflop(points, rows, evaluations, model.full_evaluations) for points, rows in done)
    return Timing(seconds, gflop, f"all, {model.coverage:g}-fold", _peak(), result.xyz)


class _Counting:
    """A Processor that notes each patch's points, and how many of them were wanted."""

    def __init__(self, processor: Processor) -> None:
        self._processor, self.done = processor, list[tuple[int, int]]()
        self.distances, self.spread, self.survey = processor.distances, processor.spread, processor.survey
        self.mapper = processor.mapper
        self.spacings = processor.spacings

    def displacements(
        self, positions: Floats, cut: Patches, scales: Floats, known_distances: Mapping[int, float], finish: Finish[_T],
        *, agree: bool,
    ) -> Iterator[_T | None]:  # fmt: skip
        self.done += [(cut.index.shape[1], int(some)) for some in cut.owned]
        return self._processor.displacements(positions, cut, scales, known_distances, finish, agree=agree)


def _reference(noisy: npt.NDArray[np.float64], options: argparse.Namespace) -> Timing:
    import torch

    from benchmarks import reference
    from straightpcf.model.allocator import keep_large_buffers
    from straightpcf.model.checkpoint import architecture_of, read_checkpoint
    from straightpcf.model.filter import DEFAULT_WEIGHTS

    torch.set_num_threads(options.threads)
    keep_large_buffers()  # the comparison is of schemes, not of allocators
    state, _ = read_checkpoint(options.weights or DEFAULT_WEIGHTS)
    state = {name: tensor.to(options.device) for name, tensor in state.items()}
    there = reference.straightpcf(state, couplings=architecture_of(state)["couplings"])

    def move(patches: torch.Tensor) -> torch.Tensor:
        return there(patches.to(options.device)).cpu()

    batch = 1 if options.device == "cpu" else 8
    if options.device != "cpu":
        with torch.inference_mode():
            move(torch.randn(batch, reference.PATCH_SIZE, 3))
    result = reference.denoise(noisy, move, passes=options.iterations, batch=batch, sample=options.patches)
    whole = result.timed_patches == result.patches
    extrapolated = "all" if whole else f"{result.timed_patches} of {result.patches}, EXTRAPOLATED"
    points = reference.PATCH_SIZE
    evaluations = 3 * architecture_of(state)["couplings"]
    gflop = result.patches * _patch_gflop(points, points, evaluations, evaluations, per_edge=True)
    return Timing(result.seconds, gflop, f"{extrapolated}, 6-fold", _peak(), result.xyz if whole else None)


def _patch_gflop(points: int, rows: int, evaluations: int, full: int, *, per_edge: bool = False) -> float:
    """Count one patch: the DistanceModule, `full` evaluations for all points and the others for `rows` of them."""
    velocities = [points if n < min(full, evaluations - 1) else rows for n in range(evaluations)]
    return _net_gflop(128, points, points, per_edge) + sum(_net_gflop(256, points, r, per_edge) for r in velocities)


def _net_gflop(width: int, points: int, rows: int, per_edge: bool) -> float:
    """Count an encoder and its decoder, of which the last block computes `rows` points."""
    flop = 0.0
    for inside, out, made in ((3, width // 8, points), (width // 8, width // 4, points), (3 * width // 8, width, rows)):
        first = 2 * inside * made * NEIGHBOURS if per_edge else inside * (points + made)
        flop += 2 * (first * out + made * NEIGHBOURS * out**2 + made * inside * out)
    return (flop + 2 * rows * (width**2 + 64 * width + 64 * 3)) / 1e9


def finish(device: str) -> None:
    """Wait until a device has done what it was told; a CPU has."""
    import torch

    if device != "cpu":
        torch.cuda.synchronize(device)


def _name(options: argparse.Namespace) -> str:
    import torch

    return torch.cuda.get_device_name(options.device)


def _gemm_rates(options: argparse.Namespace) -> dict[str, float]:
    import torch

    torch.set_num_threads(options.threads)
    rates = {}
    for kind in (torch.float32, torch.bfloat16):
        # A patch's edges on the CPU, those of a batch on a device.
        rows = GEMM_ROWS if options.device == "cpu" else 32 * GEMM_ROWS
        a, b = (torch.randn(n, 256, dtype=kind, device=options.device) for n in (rows, 256))
        out = torch.empty_like(a)
        best, started = float("inf"), time.perf_counter()
        for _ in range(30):
            finish(options.device)
            began = time.perf_counter()
            torch.mm(a, b, out=out)
            finish(options.device)
            best = min(best, time.perf_counter() - began)
            if time.perf_counter() - started > _GEMM_SECONDS:  # a CPU without bfloat16 takes seconds for one
                break
        rates[str(kind).removeprefix("torch.")] = 2 * rows * 256**2 / best / 1e9
    return rates


def _alone(side: Callable[..., _R], *arguments: Any) -> _R:
    """Call one side in a fresh process."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(side, arguments)


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _print(name: str, timing: Timing | None, xyz: npt.NDArray[np.float64] | None, shape: Shape) -> None:
    from straightpcf.model.metrics import chamfer_distance, point_to_mesh_distance

    took = " " * 35
    if timing:
        rate = timing.gflop / timing.seconds
        took = f"{timing.seconds:9.2f} {timing.peak_mib:9.0f} {timing.gflop:8.0f} {rate:6.0f}"
    quality = f"{'-':>8s} {'-':>8s}"
    if xyz is not None:
        p2m = point_to_mesh_distance(xyz, shape.vertices, shape.faces)
        quality = f"{1e4 * chamfer_distance(xyz, shape.clean):8.3f} {1e4 * p2m:8.3f}"
    print(f"{name:18s} {took} {quality}  {timing.patches if timing else ''}", flush=True)


def _shape(options: argparse.Namespace, resolution: int) -> Shape:
    if options.shape in (None, "cow") and (options.data / "punet_test.npz").is_file():
        return punet(options.data, resolution, ["cow"])[0]
    return analytic(resolution, [options.shape or "torus"])[0]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--resolution", type=positive, nargs="+", default=[10000, 50000])
    parser.add_argument("--iterations", type=positive, default=1, help="passes of both")
    parser.add_argument("--threads", type=positive, default=usable_cpus())
    parser.add_argument("--device", type=device, default="cpu", help='"cpu" (the default), "cuda" or "cuda:N"')
    parser.add_argument(
        "--patches",
        type=lambda text: None if text == "all" else positive(text),
        default=SAMPLE,
        help=f'patches on which the authors\' scheme is timed, or "all" (default {SAMPLE})',
    )
    parser.add_argument("--shape", help="cow where PUNet is at hand (the default), or an analytic shape")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--data", type=Path, default=SHARED / "data")
    return parser


if __name__ == "__main__":
    main()
