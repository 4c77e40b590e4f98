"""Send real scans through the command line; check what comes back, measure it, draw it.

python -m benchmarks.scans [FILE ...] [--pictures runs/pictures]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from benchmarks.command import errors_in_one_line, positive
from benchmarks.quality import SHARED
from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import StraightPCFError
from straightpcf.points.formats import read_cloud

Floats = npt.NDArray[np.float64]

NEIGHBOURS = 24
MEASURED_POINTS = 20_000
CROP_POINTS = 3000


@errors_in_one_line()
def main(arguments: list[str] | None = None) -> None:
    """Run the command line; exit with 1 if any scan came back wrong."""
    options = _parser().parse_args(arguments)
    files = options.files or sorted((options.data / "scans").glob("*"))
    if not files:
        raise SystemExit(f"no scans in {options.data / 'scans'}; name files to run on")
    failed = [file.name for file in files if not _one(file, options)]
    print(f"\n{len(files) - len(failed)} of {len(files)} scans came back whole")
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


def _one(file: Path, options: argparse.Namespace) -> bool:
    print(f"\n{file.name}")
    with tempfile.TemporaryDirectory() as folder:
        source = _readable(file, Path(folder))
        target = Path(folder) / f"out{source.suffix}"
        began = time.perf_counter()
        ended = subprocess.run(_command(source, target, options), capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - began
        print("  " + (ended.stderr.strip().splitlines() or [""])[-1])
        if ended.returncode:
            print(f"  FAILED with exit code {ended.returncode}")
            return False
        before, after = read_cloud(source)[0], read_cloud(target)[0]
    problems = _differences(before, after)
    fields = ", ".join(before.attributes) or "none"
    print(f"  {len(after)} points, fields {fields}: {'; '.join(problems) or 'same count, order and fields'}")
    if not problems:
        _report(before, after, seconds)
        if options.pictures:
            _draw(file.stem, before, after, options.pictures)
    return not problems


def _readable(file: Path, folder: Path) -> Path:
    """Return the file itself, or for a KITTI frame, which names neither its fields nor itself, a PLY of it."""
    if file.suffix != ".bin":
        return file
    try:
        read_cloud(file)
    except StraightPCFError:
        from plyfile import PlyData, PlyElement

        rows = np.fromfile(file, dtype=[(name, "<f4") for name in ("x", "y", "z", "intensity")])
        print("  a bare float32 frame: read as x y z intensity and sent as PLY")
        PlyData([PlyElement.describe(rows, "vertex")]).write(folder / f"{file.stem}.ply")
        return folder / f"{file.stem}.ply"
    return file


def _command(source: Path, target: Path, options: argparse.Namespace) -> list[str]:
    command = [sys.executable, "-m", "straightpcf.clients.cli", "denoise", str(source), str(target)]
    command += ["--iterations", options.iterations]
    for name in ("weights", "threads"):
        if (value := getattr(options, name)) is not None:
            command += [f"--{name}", str(value)]
    return command


def _differences(before: PointCloud, after: PointCloud) -> list[str]:
    """Say what besides finite positions is not the same, byte for byte."""
    if len(before) != len(after):
        return [f"{len(before)} points went in, {len(after)} came out"]
    problems = []
    if list(before.attributes) != list(after.attributes):
        problems.append(f"fields {list(before.attributes)} became {list(after.attributes)}")
    for name in before.attributes.keys() & after.attributes.keys():
        a, b = np.asarray(before.attributes[name]), np.asarray(after.attributes[name])
        if a.dtype != b.dtype or a.tobytes() != b.tobytes():
            problems.append(f"field {name} changed")
    invalid = ~np.isfinite(before.xyz).all(axis=1)
    if not np.array_equal(before.xyz[invalid], after.xyz[invalid], equal_nan=True):
        problems.append("points that are not finite changed")
    if not np.isfinite(after.xyz[~invalid]).all():
        problems.append("finite points became NaN")
    elif _moved_far(before.xyz[~invalid], after.xyz[~invalid]):
        problems.append("points are not near where they were: the order changed")
    return problems


def _moved_far(before: Floats, after: Floats) -> bool:
    """Say whether the median point moved farther than its neighbourhood reaches, which no filter does."""
    sample = np.random.default_rng(0).permutation(len(before))[:2000]
    reach = cKDTree(before).query(before[sample], k=min(200, len(before)))[0][:, -1]
    return bool(np.median(np.linalg.norm(after[sample] - before[sample], axis=1) / np.maximum(reach, 1e-300)) > 1)


def _report(before: PointCloud, after: PointCloud, seconds: float) -> None:
    finite = np.isfinite(before.xyz).all(axis=1)
    old, new = before.xyz[finite], after.xyz[finite]
    sample = np.random.default_rng(0).permutation(len(old))[:MEASURED_POINTS]
    was, now = _residual(old, sample), _residual(new, sample)
    moved = np.linalg.norm(new - old, axis=1)
    percentiles = "  ".join(
        f"{p} % {v:.3g}" for p, v in zip((50, 90, 99), np.percentile(moved, (50, 90, 99)), strict=True)
    )
    print(f"  plane-fit residual over {NEIGHBOURS} neighbours:")
    for name, a, b in (("rms", _rms(was), _rms(now)), ("median", np.median(was), np.median(now))):
        print(f"    {name:6s} {a:.4g} -> {b:.4g} ({100 * (b / a - 1) if a > 0 else 0.0:+.1f} %)")
    print(f"  moved: {percentiles}  most {moved.max():.3g} (the cloud's unit)")
    print(f"  {seconds:.1f} s with start and files, {1e6 * seconds / len(before):.1f} s per million points")


def _residual(xyz: Floats, sample: npt.NDArray[np.int64]) -> Floats:
    """Return the rms distance of each sampled point's neighbours from their best plane."""
    _, index = cKDTree(xyz).query(xyz[sample], k=min(NEIGHBOURS + 1, len(xyz)))
    local = xyz[index] - xyz[index].mean(axis=1, keepdims=True)
    smallest = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", local, local) / index.shape[1])[:, 0]
    return np.asarray(np.sqrt(np.maximum(smallest, 0)))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _draw(name: str, before: PointCloud, after: PointCloud, folder: Path) -> None:
    """Write a picture: a flat crop from above and from the side, a crop with structure, how far points moved."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    finite = np.isfinite(before.xyz).all(axis=1)
    old, new = before.xyz[finite], after.xyz[finite]
    moved = np.linalg.norm(new - old, axis=1)
    style: dict[str, Any] = {"s": 3, "cmap": "viridis", "vmin": 0, "vmax": np.percentile(moved, 98)}
    figure, axes = pyplot.subplot_mosaic(
        [["flat 0", "flat 1"], ["side 0", "side 1"], ["edge 0", "edge 1"], ["moved", "moved"]],
        figsize=(14, 17),
        layout="constrained",
    )
    for row, flatness in (("flat", True), ("edge", False)):
        crop, turn, centre = _crop(old, flat=flatness)
        views = [(xyz[crop] - centre) @ turn for xyz in (old, new)]  # columns: normal, across, along
        for column, view in enumerate(views):
            said = ("before", "after")[column]
            across = view[:, 1] if flatness else view[:, 0]
            dots = axes[f"{row} {column}"].scatter(view[:, 2], across, c=moved[crop], **style)
            axes[f"{row} {column}"].set_title(f"{name}, {said}: a {'flat' if flatness else 'structured'} place")
            axes[f"{row} {column}"].set_aspect("equal")
            if flatness:
                slice_ = np.abs(views[0][:, 1]) < np.percentile(np.abs(views[0][:, 1]), 30)
                axes[f"side {column}"].scatter(view[slice_, 2], view[slice_, 0], c=moved[crop][slice_], **style)
                axes[f"side {column}"].set_title("the same from the side, a slice, height stretched")
                axes["side 1"].set(xlim=axes["side 0"].get_xlim(), ylim=axes["side 0"].get_ylim())
    spacing = float(np.median(cKDTree(old).query(old[:MEASURED_POINTS], k=2)[0][:, 1]))
    bins = np.geomspace(max(moved.max(), 1e-12) * 1e-4, max(moved.max(), 1e-12), 80)
    axes["moved"].hist(moved, bins=bins.tolist())
    axes["moved"].axvline(spacing, color="k", linestyle=":")
    axes["moved"].set(
        xscale="log", xlabel="moved by (the cloud's unit); dotted: to the nearest neighbour", ylabel="points"
    )
    figure.colorbar(dots, ax=[axes[key] for key in axes if key != "moved"], label="moved by (the cloud's unit)")
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.png", dpi=80)
    pyplot.close(figure)
    print(f"  picture: {folder / f'{name}.png'}")


def _crop(xyz: Floats, *, flat: bool) -> tuple[npt.NDArray[np.int64], Floats, Floats]:
    """Choose one of 200 neighbourhoods: its rows, its axes (normal first), its centre.

    flat: the roundest of the flat ones; otherwise the one that is widest in its two lesser directions.
    """
    tree = cKDTree(xyz)
    best: tuple[float, Any] = (-np.inf, None)
    for seed in np.random.default_rng(0).integers(len(xyz), size=200):
        index = tree.query(xyz[seed], k=min(CROP_POINTS, len(xyz)))[1]
        centre = np.median(xyz[index], axis=0)
        spread, axes = np.linalg.eigh(np.cov((xyz[index] - centre).T))
        round_, thick = spread[1] / max(spread[2], 1e-300), spread[0] / max(spread[1], 1e-300)
        score = round_ - 20 * max(0.0, thick - 0.01) if flat else round_ * thick
        if score > best[0]:
            best = (score, (index, axes, centre))
    return best[1]  # type: ignore[no-any-return]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scans", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", type=Path, nargs="*", help="all of DATA/scans by default")
    parser.add_argument("--iterations", default="auto")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--threads", type=positive)
    parser.add_argument("--data", type=Path, default=SHARED / "data")
    parser.add_argument("--pictures", type=Path, default=Path("runs/pictures"), help="folder for PNGs")
    return parser


if __name__ == "__main__":
    main()
