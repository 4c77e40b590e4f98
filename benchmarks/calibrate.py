"""Calibrate a trained state and write the weights that ship.

python -m benchmarks.calibrate --state runs/dm/state.safetensors --out

Uses the training shapes, never the test split. Prints the table of d against known noise, and what `auto`
would do against the best fixed number of passes. With --keep nothing is measured: the DistanceModule and the
calibration of other weights go with the state's velocities.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.command import errors_in_one_line, file_to_write, noise_level, positive, share_of_two
from benchmarks.quality import SHARED
from benchmarks.shapes import NOISE_TYPES, make_noise
from straightpcf.model.calibration import Calibration
from straightpcf.model.checkpoint import read_checkpoint, save_checkpoint
from straightpcf.model.filter import DEFAULT_WEIGHTS, Filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.normalize import CloudFrame
from straightpcf.model.train.archive import opened
from straightpcf.model.train.calibrate import NOISE_LEVELS, Trace, calibrate, noise_table, passes, trace
from straightpcf.model.train.data import along_beams
from straightpcf.model.train.state import average_with, read_network, take_distance_module
from straightpcf.points.errors import InvalidOptions, MalformedFile

_Key = tuple[str, str, float]  # of a trace: its cloud, type and size of noise
_Floats = npt.NDArray[np.float64]
_ALONG_BEAMS = "beams"  # noise of scans (`model.train.scanned`): of that std, along the way to the scanner

# The table is read of every fifth shape's 50K points: with 3 % of noise d is lower there than at 10K, and noise read
# too low costs more than noise read too high (docs/filter.md).
_TABLE_CLOUDS, _TABLE_EVERY = "50000", 5


@errors_in_one_line()
def main() -> None:
    """Print both tables; with --out write the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--state", type=Path, required=True, help="the state of a finished stage 3, or 2")
    parser.add_argument("--distance", type=Path, help="a state whose DistanceModule to take instead")
    parser.add_argument(
        "--mean", type=Path, help="a state trained on from this one: take the mean of both's velocities"
    )
    parser.add_argument("--share", type=share_of_two, help="of the state in that mean, 0..1, 0.5 by default")
    parser.add_argument("--table", type=Path, help="weights whose table of noise to keep, instead of reading a new one")
    parser.add_argument("--keep", type=Path, help="weights whose DistanceModule and calibration to keep as they are")
    parser.add_argument("--data", type=Path, default=SHARED / "data" / "punet_train.npz")
    parser.add_argument(
        "--clouds",
        nargs="+",
        help="<shape>/<resolution>, or about that, of a scan; by default every shape at 10000, every eighth at 50000",
    )
    parser.add_argument("--traces", type=file_to_write, help="keep what was measured here, and use what is there")
    parser.add_argument("--noise", type=noise_level, nargs="+", default=NOISE_LEVELS)
    parser.add_argument(
        "--noise-type", choices=(*NOISE_TYPES, _ALONG_BEAMS), default="gaussian", help="beams: of an archive of scans"
    )
    parser.add_argument("--threads", type=positive, default=None)
    parser.add_argument("--out", type=file_to_write, nargs="?", const=DEFAULT_WEIGHTS, default=None)
    arguments = parser.parse_args()
    if arguments.keep is not None and (arguments.distance or arguments.table or arguments.traces):
        parser.error("--keep takes all from one file and measures nothing: no --distance, --table or --traces with it")

    if arguments.share is not None and arguments.mean is None:
        parser.error("--share is of a mean: give --mean with it")

    known = _recorded(arguments.traces)
    network, progress = read_network(arguments.state)
    if arguments.mean is not None:
        share = 0.5 if arguments.share is None else arguments.share
        progress["mean_with"] = average_with(network, arguments.mean, share)
        progress["share"] = share
    if arguments.keep is not None:
        take_distance_module(network, arguments.keep)
        _write(network, progress, Calibration.from_metadata(read_checkpoint(arguments.keep)[1]), arguments.out)
        return
    if arguments.distance is not None:
        take_distance_module(network, arguments.distance)
    with opened(arguments.data) as archive:
        shapes = sorted({key.split("/")[0] for key in archive.files})
        every = [f"{shape}/10000" for shape in shapes] + [f"{shape}/50000" for shape in shapes[3::8]]
        clouds = {name: _Cloud.read(archive, name) for name in arguments.clouds or every}
        dense = {}
        if arguments.table is None:
            names = [f"{shape}/{_TABLE_CLOUDS}" for shape in shapes[1::_TABLE_EVERY]]
            dense = {name: _Cloud.read(archive, name).clean for name in names}
    model = Filter(network, threads=arguments.threads)
    if arguments.table is None:
        model.calibration = noise_table(model, dense)
    else:
        model.calibration = Calibration.from_metadata(read_checkpoint(arguments.table)[1])
    traces = _traces(model, clouds, arguments.noise_type, arguments.noise, known, arguments.traces)
    calibration = calibrate(traces, model.calibration)
    columns = f"{'d before each pass':32} {'CD x1e4 after 0, 1, ...':42}"
    print(f"{'cloud':18} {'noise':>16}  {columns} auto best")
    for t in traces:
        chosen, best = passes(calibration, t), int(np.argmin(t.chamfer))
        distances = " ".join(f"{d:.3f}" for d in t.distances)
        chamfer = " ".join(f"{1e4 * c:7.3f}" for c in t.chamfer)
        print(f"{t.cloud:18} {t.noise_type:8.8} {t.noise_std:7.4f}  {distances:32} {chamfer:42} {chosen:4} {best:4}")
    print(f"\n{'points, noise':>23} {'d':>7} {'auto / best CD':>15}")
    for level in sorted({t.level for t in traces}):
        resolution, kind, std = level
        those = [t for t in traces if t.level == level]
        ratio = np.mean([t.chamfer[passes(calibration, t)] / max(min(t.chamfer[1:]), 1e-12) for t in those])
        print(f"{resolution:>6} {kind:8.8} {std:7.4f} {np.median([t.distances[0] for t in those]):7.3f} {ratio:15.3f}")
    _write(network, progress, calibration, arguments.out)


def _write(network: StraightPCF, progress: dict[str, Any], calibration: Calibration, out: Path | None) -> None:
    print(json.dumps(calibration.to_metadata()))
    if out is not None:
        save_checkpoint(network, out, {"training": progress, **calibration.to_metadata()})
        out.chmod(0o644)
        print(f"written {out}")


@dataclass(frozen=True)
class _Cloud:
    """A clean cloud (N, 3) in the unit ball, and of a scan the place (3,) it was seen from."""

    clean: _Floats
    eye: _Floats | None

    @classmethod
    def read(cls, archive: np.lib.npyio.NpzFile, name: str) -> _Cloud:
        """Read <shape>/<resolution>, or of a scan, whose counts are what its beams met, the one nearest to it."""
        shape, _, wanted = name.partition("/")
        eye = archive[f"{shape}/eye"].astype(np.float64)[None] if f"{shape}/eye" in archive.files else None
        if eye is not None and wanted.isdecimal():
            counts = [n.removeprefix(f"{shape}/") for n in archive.files if n.startswith(f"{shape}/")]
            nearest = min(filter(str.isdecimal, counts), key=lambda count: abs(int(count) - int(wanted)))
            name = f"{shape}/{nearest}"
        xyz = archive[name].astype(np.float64)
        frame = CloudFrame.of(xyz)
        return cls(frame.enter(xyz), None if eye is None else frame.enter(eye)[0])

    def with_noise(self, kind: str, std: float) -> _Floats:
        if kind != _ALONG_BEAMS:
            return make_noise(kind, self.clean, std, seed=0)
        if self.eye is None:
            raise InvalidOptions("noise along beams is of scans: the archive has no <shape>/eye")
        noise = std * np.random.default_rng(0).standard_normal((len(self.clean), 1))
        return self.clean + along_beams(noise, self.clean, self.eye)


def _recorded(kept: Path | None) -> dict[_Key, Trace]:
    """Return the traces that are there; raises MalformedFile, before the work, for what is none."""
    found = {}
    for number, line in enumerate(kept.read_text().splitlines() if kept is not None and kept.is_file() else [], 1):
        try:
            known = Trace(**json.loads(line))
        except (ValueError, TypeError) as exc:
            raise MalformedFile(f"{kept}: line {number} is no trace: {exc}") from exc
        found[known.cloud, known.noise_type, known.noise_std] = known
    return found


def _traces(
    filter_: Filter, clouds: dict[str, _Cloud], kind: str, noise: list[float],
    known: dict[_Key, Trace], kept: Path | None,
) -> list[Trace]:  # fmt: skip
    for name, cloud in clouds.items():
        for std in noise:
            if (name, kind, std) in known:
                continue
            measured = trace(filter_, name, cloud.clean, cloud.with_noise(kind, std), std, kind)
            known[name, kind, std] = measured
            if kept is not None:
                with kept.open("a") as file:
                    file.write(json.dumps(asdict(measured)) + "\n")
    return list(known.values())


if __name__ == "__main__":
    main()
