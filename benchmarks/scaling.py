"""Time and peak memory of the filter against the number of points, with the fitted exponent and a plot.

python -m benchmarks.scaling [--points 1000 10000 100000 1000000] [--plot docs/scaling.png]

A noisy torus of each size, one pass, each in a process of its own, so that its peak memory is its own.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from pathlib import Path

import numpy as np

from benchmarks.command import file_to_write, positive
from straightpcf.model.cpus import usable_cpus
from straightpcf.model.filter import MIN_POINTS

POINTS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
FIT_FROM = 10_000  # below, one patch is most of the cloud


def main() -> None:
    """Print a row for each size."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=positive, nargs="+", default=POINTS)
    parser.add_argument("--threads", type=positive, default=usable_cpus())
    parser.add_argument("--plot", type=file_to_write)
    options = parser.parse_args()
    if min(options.points) < MIN_POINTS:
        parser.error(f"argument --points: {min(options.points)} points; at least {MIN_POINTS} can be filtered")
    print(f"{options.threads} threads, one pass\n{'points':>9} {'seconds':>9} {'peak MiB':>9} {'points/s':>9}")
    rows = []
    for points in options.points:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            seconds, peak = pool.apply(_measure, (points, options.threads))
        rows.append((points, seconds, peak))
        print(f"{points:9d} {seconds:9.2f} {peak:9.0f} {points / seconds:9.0f}", flush=True)
    large = np.array([row for row in rows if row[0] >= FIT_FROM])
    if len(large) > 1:
        exponent = np.polyfit(np.log(large[:, 0]), np.log(large[:, 1]), 1)[0]
        slope = np.polyfit(large[:, 0], large[:, 2] * 2**20, 1)[0]
        print(f"from {FIT_FROM} points on: seconds ~ N^{exponent:.2f}, memory + {slope:.0f} bytes a point")
    if options.plot:
        _plot(np.array(rows), options.plot)


def _measure(points: int, threads: int) -> tuple[float, float]:
    from straightpcf.model.filter import load_filter
    from straightpcf.points.options import DenoiseOptions

    random = np.random.default_rng(0)
    u, v = random.uniform(0, 2 * np.pi, (2, points))
    ring = 1 + 0.4 * np.cos(v)
    xyz = np.stack([ring * np.cos(u), ring * np.sin(u), 0.4 * np.sin(v)], axis=1)
    xyz += 0.01 * random.standard_normal(xyz.shape)
    model = load_filter(device="cpu", threads=threads)
    model.denoise(xyz[:1000], DenoiseOptions(iterations=1))
    began = time.perf_counter()
    model.denoise(xyz, DenoiseOptions(iterations=1))
    return time.perf_counter() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _plot(rows: np.ndarray, path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for axis, column, label in zip(axes, (1, 2), ("seconds", "peak memory, MiB"), strict=True):
        axis.loglog(rows[:, 0], rows[:, column], "o-")
        axis.set(xlabel="points", ylabel=label)
        axis.grid(visible=True, which="both", alpha=0.2)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
