"""Print CD and P2M (x 1e4) per shape and on average, beside the noisy input and the paper's rows.

python -m benchmarks.quality --split punet --resolution 10000 --noise 0.01 0.02 0.03
python -m benchmarks.quality --model ours official jet    # and a table of all, beside the noisy input and the paper
python -m benchmarks.quality --split validation
python -m benchmarks.quality --split punet --resolution 50000 --noise 0    # what becomes of clean clouds
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from benchmarks.command import coverage, device, errors_in_one_line, noise_level, positive, seed_number
from benchmarks.conventional import check_jet, jet_smooth
from benchmarks.shapes import ANALYTIC, NOISE_TYPES, Shape, analytic, make_noise, punet
from straightpcf.model.checkpoint import load_official_checkpoint
from straightpcf.model.filter import Filter, load_filter
from straightpcf.model.metrics import chamfer_distance, point_to_mesh_distance
from straightpcf.model.nets.straightpcf import StraightPCF, VelocityModule
from straightpcf.model.train.calibrate import Trace, every_pass, passes
from straightpcf.model.train.state import read_header, read_network
from straightpcf.points.options import DenoiseOptions

Floats = npt.NDArray[np.float64]

SHARED = Path(__file__).resolve().parents[2] / "shared"
PAPER_ROWS = ("Score", "PDFlow", "DeepPSR", "IterativePFN", "StraightPCF")
OFFICIAL_STEPS = 4


@dataclass(frozen=True)
class Filtered:
    """A cloud (N, 3) as it came out; every: with --every-pass, after 1, 2, ... passes."""

    xyz: Floats
    iterations: int
    every: tuple[Floats, ...] = ()


Run = Callable[[Floats, float], Filtered]  # cloud, noise level


@dataclass(frozen=True)
class Row:
    """One shape at one noise level; distances x 1e4; every: CD and P2M after 1, 2, ... passes, if asked for."""

    model: str
    shape: str
    resolution: int
    noise: float
    noisy_cd: float
    noisy_p2m: float
    cd: float
    p2m: float
    iterations: int
    seconds: float
    every: tuple[tuple[float, float], ...] = ()


@errors_in_one_line()
def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    options = _parser().parse_args(arguments)
    if options.threads:
        torch.set_num_threads(options.threads)
    if options.every_pass and (options.model, options.iterations) != (["ours"], "auto"):
        raise SystemExit("--every-pass takes `auto` of this project's model apart: no other --model or --iterations")
    if options.weights and len(options.model) > 1:
        raise SystemExit("--weights are of one model: give no other --model with them")
    runs = {model: _runner(model, options) for model in options.model}
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.open("a").close()  # what cannot be written is found out before the work
    rows: list[Row] = []
    for resolution in options.resolution:
        for noise in options.noise:
            for model, run in runs.items():
                rows += _cell(model, resolution, noise, options, run)
                if options.json:
                    options.json.write_text(json.dumps(_record(options, rows), indent=1) + "\n")
    if len(options.model) > 1:
        _table(rows, options)


def _cell(model: str, resolution: int, noise: float, options: argparse.Namespace, run: Run) -> list[Row]:
    cell: list[Row] = []
    print(f"\n{options.split}, {resolution} points, {options.noise_type} noise {noise:g}, {model}")
    print(f"{'shape':14s} {'noisy CD':>9s} {'P2M':>8s}  {'CD':>9s} {'P2M':>8s}  passes  seconds")
    for shape in _shapes(options, resolution):
        cell.append(_measure(model, shape, resolution, noise, options, run))
        _print(cell[-1])
    _summary(cell, resolution, noise, options)
    return cell


def _table(rows: list[Row], options: argparse.Namespace) -> None:
    """Print the means of all models, beside the noisy input's and the paper's."""
    for resolution in options.resolution:
        found: dict[str, dict[float, tuple[float, float]]] = {"noisy": {}, **{model: {} for model in options.model}}
        for noise in options.noise:
            for model in options.model:
                of = [row for row in rows if (row.model, row.resolution, row.noise) == (model, resolution, noise)]
                cd, p2m, before_cd, before_p2m = np.mean(
                    [(row.cd, row.p2m, row.noisy_cd, row.noisy_p2m) for row in of], axis=0
                )
                found["noisy"][noise], found[model][noise] = (before_cd, before_p2m), (cd, p2m)
            for name, cd, p2m in _paper(resolution, noise, options):
                found.setdefault(f"paper, {name}", {})[noise] = cd, p2m
        print(f"\n{options.split}, {resolution} points, CD / P2M")
        print(f"{'noise':20s}" + "".join(f"{noise:>18g}" for noise in options.noise))
        for name, cells in found.items():
            shown = (f"{cells[n][0]:.3f} / {cells[n][1]:.3f}" if n in cells else "" for n in options.noise)
            print(f"{name:20s}" + "".join(f"{figures:>18s}" for figures in shown))


def _measure(model: str, shape: Shape, resolution: int, noise: float, options: argparse.Namespace, run: Run) -> Row:
    made = options.noise_type != "gaussian" or noise not in shape.noisy
    noisy = make_noise(options.noise_type, shape.clean, noise, options.seed) if made else shape.noisy[noise]
    began = time.perf_counter()
    filtered = run(noisy, noise)
    seconds = time.perf_counter() - began
    before = _distances(noisy, shape)
    after = before if filtered.xyz is noisy else _distances(filtered.xyz, shape)
    every = tuple(_distances(xyz, shape) for xyz in filtered.every)
    return Row(model, shape.name, resolution, noise, *before, *after, filtered.iterations, seconds, every)


def _distances(cloud: Floats, shape: Shape) -> tuple[float, float]:
    cd, p2m = chamfer_distance(cloud, shape.clean), point_to_mesh_distance(cloud, shape.vertices, shape.faces)
    return 1e4 * cd, 1e4 * p2m


def _shapes(options: argparse.Namespace, resolution: int) -> list[Shape]:
    if options.split == "validation":
        return analytic(resolution, options.shapes)
    if not (options.data / "punet_test.npz").is_file():
        raise SystemExit(f"{options.data} has no punet_test.npz; `--split validation` needs no data")
    return punet(options.data, resolution, options.shapes)


def _runner(name: str, options: argparse.Namespace) -> Run:
    if name == "noisy":
        return lambda cloud, _: Filtered(cloud, 0)
    if name == "jet":
        check_jet()
        return lambda cloud, noise: Filtered(*jet_smooth(cloud, noise))
    if name == "official":
        module = load_official_checkpoint(options.weights or options.data / "official" / "ckpt_vm.pt")
        if not isinstance(module, VelocityModule):
            raise SystemExit("--model official takes the authors' single VelocityModule")
        network = StraightPCF(couplings=1)
        network.velocity_modules[0] = module
        model = Filter(_without_distance(network), threads=options.threads, euler_steps=OFFICIAL_STEPS, zoom=False)
    else:
        model = _ours(options)
    told = options.iterations == "told" or (options.iterations == "auto" and name == "official")

    def run(cloud: Floats, noise: float) -> Filtered:
        wanted = str(max(1, round(100 * noise))) if told else options.iterations
        result = model.denoise(cloud, DenoiseOptions.parse(iterations=wanted, seed=str(options.seed)))
        return Filtered(result.xyz, result.iterations)

    def run_every(cloud: Floats, _: float) -> Filtered:
        states, readings = every_pass(model, cloud, seed=options.seed)
        known = Trace.of(readings, (), cloud="", noise_std=0.0, noise_type="", points=len(cloud))
        chosen = passes(model.calibration, known)
        return Filtered(states[chosen], chosen, tuple(states[1:]))

    return run_every if options.every_pass else run


def _ours(options: argparse.Namespace) -> Filter:
    if options.weights and _is_training_state(options.weights):
        network, _ = read_network(options.weights)
        shipped = load_filter(device=options.device)
        network.to(shipped.device)
        model = Filter(network, calibration=shipped.calibration, device=shipped.device, threads=options.threads)
    else:
        model = load_filter(options.weights, device=options.device, threads=options.threads)
    model.euler_steps = options.euler_steps or model.euler_steps
    model.coverage = options.coverage or model.coverage
    if options.every_evaluation:
        model.full_evaluations = model.euler_steps * len(model.network.velocity_modules)
        model.agree = False
    if options.without_distance:
        _without_distance(model.network)
        model.zoom = False  # d tells no noise
    return model


def _is_training_state(path: Path) -> bool:
    return "progress" in read_header(path)


def _without_distance(network: StraightPCF) -> StraightPCF:
    """Make the distance always 1."""

    class One(nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return x.new_ones(len(x), 1)

    network.distance_module = One()  # type: ignore[assignment]
    return network


def _print(row: Row) -> None:
    figures = f"{row.noisy_cd:9.3f} {row.noisy_p2m:8.3f}  {row.cd:9.3f} {row.p2m:8.3f}"
    print(f"{row.shape:14s} {figures}  {row.iterations:6d}  {row.seconds:7.2f}", flush=True)


def _summary(rows: list[Row], resolution: int, noise: float, options: argparse.Namespace) -> None:
    before = np.mean([(row.noisy_cd, row.noisy_p2m) for row in rows], axis=0)
    after = np.mean([(row.cd, row.p2m) for row in rows], axis=0)
    passes = np.bincount([row.iterations for row in rows])
    chosen = ", ".join(f"{count} x {n}" for n, count in enumerate(passes) if count)
    seconds = np.mean([row.seconds for row in rows])
    print(f"{'mean':14s} {before[0]:9.3f} {before[1]:8.3f}  {after[0]:9.3f} {after[1]:8.3f}          {seconds:7.2f}")
    print(f"passes (shapes x passes): {chosen}")
    for done, (cd, p2m) in enumerate(np.mean([row.every for row in rows], axis=0) if options.every_pass else (), 1):
        print(f"  passes: {done:<23d} {cd:9.3f} {p2m:8.3f}  auto's CD: {100 * (after[0] / cd - 1):+.1f} %")
    if noise > 0:
        less = 100 * (1 - after / before)
        print(f"less than the noisy input: CD {less[0]:.1f} %, P2M {less[1]:.1f} %")
        if worse := [row.shape for row in rows if row.cd > row.noisy_cd or row.p2m > row.noisy_p2m]:
            print(f"WORSE than the noisy input: {', '.join(worse)}")
    for name, cd, p2m in _paper(resolution, noise, options):
        print(f"  paper, {name:13s} {'':12s} {cd:9.3f} {p2m:8.3f}")


def _paper(resolution: int, noise: float, options: argparse.Namespace) -> list[tuple[str, float, float]]:
    """Return the published rows of this cell, as long as all 20 shapes were measured and the file is here."""
    path = options.data.parent / "reference" / "paper_results.json"
    if options.split != "punet" or options.shapes or not path.is_file():
        return []
    table: dict[str, Any] = json.loads(path.read_text()).get(options.noise_type, {}).get("PUNet", {})
    cell = f"{resolution // 1000}K/{round(100 * noise)}%"
    return [
        (name, table[name][f"{cell}/CD"], table[name][f"{cell}/P2M"])
        for name in PAPER_ROWS
        if f"{cell}/CD" in table.get(name, {}) and np.isclose(noise, round(100 * noise) / 100)
    ]


def _record(options: argparse.Namespace, rows: list[Row]) -> dict[str, Any]:
    said = {name: str(value) if isinstance(value, Path) else value for name, value in vars(options).items()}
    return {"options": said, "rows": [asdict(row) for row in rows]}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality",
        description=(__doc__ or "").splitlines()[0],
        epilog=f"Shapes of the validation split: {', '.join(ANALYTIC)}.",
    )
    parser.add_argument("--split", choices=("punet", "validation"), default="punet")
    parser.add_argument("--resolution", type=positive, nargs="+", default=[10000])
    parser.add_argument("--noise", type=noise_level, nargs="+", default=[0.01, 0.02, 0.03], help="in unit-sphere radii")
    parser.add_argument("--noise-type", choices=tuple(NOISE_TYPES), default="gaussian")
    parser.add_argument(
        "--iterations",
        default="auto",
        help='"auto", a number of passes, or "told": 1, 2, 3 at 1, 2, 3 %%, as the paper',
    )
    parser.add_argument(
        "--every-pass",
        action="store_true",
        help='"auto" beside every fixed number of passes, which it is cut from: seconds are those of all of them',
    )
    parser.add_argument("--euler-steps", type=positive, help="N of the paper, 3 by default")
    parser.add_argument("--coverage", type=coverage, help="patches a point, 3 by default; the published scheme takes 6")
    parser.add_argument("--every-evaluation", action="store_true", help="evaluate every point of a patch every time")
    parser.add_argument("--without-distance", action="store_true", help="d = 1, as in the paper's ablation")
    parser.add_argument("--shapes", nargs="+", help="only these")
    parser.add_argument(
        "--model",
        choices=("ours", "official", "jet", "noisy"),
        nargs="+",
        default=["ours"],
        help="ours, the authors' single VelocityModule through the same filter, jet smoothing of CGAL, the input",
    )
    parser.add_argument("--weights", type=Path, help="other weights, or the state of a training run")
    parser.add_argument("--device", type=device, default="auto", help='"auto" (the default), "cpu", "cuda" or "cuda:N"')
    parser.add_argument("--threads", type=positive, help="CPU threads, all by default")
    parser.add_argument("--seed", type=seed_number, default=0, help="of made noise and of the filter")
    parser.add_argument("--data", type=Path, default=SHARED / "data")
    parser.add_argument("--json", type=Path, help="write every row there, after each cell")
    return parser


if __name__ == "__main__":
    main()
