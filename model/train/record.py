"""Record training clouds as the filter's later passes see them, for `straightpcf train cvm --passed`.

python -m straightpcf.model.train.record passed.npz --data punet_train.npz
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from straightpcf.model.filter import Filter, Run, load_filter
from straightpcf.model.normalize import CloudFrame
from straightpcf.model.tiles import Tiling
from straightpcf.model.train.archive import by_stem, fingerprint, opened, read_array, split_name, write_archive
from straightpcf.model.train.command import (
    archive_to_write,
    device,
    errors_in_one_line,
    noise_level,
    positive,
    seed_number,
)
from straightpcf.model.train.data import drawn_noise, held_out_shapes
from straightpcf.model.train.state import read_network
from straightpcf.points.errors import InvalidOptions, MalformedFile
from straightpcf.points.options import DenoiseOptions

__all__ = ["write_passed"]

Floats = npt.NDArray[np.float64]
Clouds = tuple[list[Floats], Floats | None]  # of a shape, the coarsest first, and where its beams came from

LEVELS = (0.005, 0.01, 0.015, 0.02, 0.025, 0.03)  # noise std, in radii of the bounding sphere
COARSEST_SHARE = 0.75  # of the clouds; a finer one takes several times as long
_KEPT_EVERY, _PROGRESS = 300.0, "progress"  # seconds


def write_passed(
    path: Path, denoiser: Filter, data: Sequence[Path], count: int, *, seed: int = 0, levels: Sequence[float] = LEVELS
) -> None:
    """Filter `count` noisy training clouds of the archives `data`, and write them as they were before each later pass.

    levels: noise stds, in radii of the bounding sphere, each as likely. Shapes that are held out stay out. A cloud is
    named `<archive>/<shape>/<number>/xyz`, (N, 3) float32 in the frame in which the filter has it;
    `<archive>/<shape>/<number>/frame` is that one's centre and radius among the clean points. What is there so far is
    kept beside `path` now and then and where this is interrupted, and gone on with. Raises InvalidOptions where that is
    of another recording, of archives that were others by then, or two archives have one name, MalformedFile, OSError.
    """
    rng = np.random.default_rng(seed)
    by_stem(data)
    shapes = {archive: _training_clouds(archive) for archive in data}
    part = path.with_suffix(".part.npz")
    of = [seed, [archive.stem for archive in data], _digest(denoiser), list(levels)]
    contents = [fingerprint(archive) for archive in data]
    written = _gone_on_with(part, of, contents, rng)
    kept_at, state = time.monotonic(), rng.bit_generator.state
    _keep(part, written, of, state, contents)  # a folder that takes no file is found out before the work
    try:
        while len(written) < 2 * count:
            more = _recorded(denoiser, data, shapes, rng, levels, len(written) // 2)
            written, state = written | more, rng.bit_generator.state
            if time.monotonic() - kept_at > _KEPT_EVERY:
                _keep(part, written, of, state, contents)
                kept_at = time.monotonic()
        write_archive(path, written)
    except BaseException:
        _keep(part, written, of, state, contents)
        raise
    part.unlink()


def _recorded(
    denoiser: Filter, data: Sequence[Path], shapes: Mapping[Path, Mapping[str, Clouds]], rng: np.random.Generator,
    levels: Sequence[float], number: int,
) -> dict[str, npt.NDArray[np.generic]]:  # fmt: skip
    """Filter one noisy cloud, and return what is written of it, from that number on."""
    written: dict[str, npt.NDArray[np.generic]] = {}
    archive = data[int(rng.integers(len(data)))]
    names = list(shapes[archive])
    shape = names[int(rng.integers(len(names)))]
    clouds, eye = shapes[archive][shape]
    finer = clouds[1:] if rng.random() >= COARSEST_SHARE else []
    clean = (finer or clouds[:1])[int(rng.integers(len(finer or clouds[:1])))]
    own = CloudFrame.of(clean)
    noise = levels[int(rng.integers(len(levels)))] * drawn_noise(rng, clean, eye)
    run = _Recording(denoiser, own.enter(clean) + noise, DenoiseOptions(iterations=3 if finer else 4))
    for _ in run.patches():
        pass
    for xyz in run.seen:
        key = f"{archive.stem}/{shape}/{number + len(written) // 2}"
        centre = own.centre + own.radius * run.frame.centre
        written[f"{key}/xyz"] = xyz.astype(np.float32)
        written[f"{key}/frame"] = np.array([*centre, own.radius * run.frame.radius])
    return written


def _gone_on_with(
    part: Path, of: list[object], contents: list[int], rng: np.random.Generator
) -> dict[str, npt.NDArray[np.generic]]:
    """Return what `_keep` kept of a recording of the same, with `rng` as it was then; nothing if there is none."""
    if not part.exists():
        return {}
    with opened(part) as file:
        if _PROGRESS not in file:
            raise MalformedFile(f"{part} is no part of a recording: it has no {_PROGRESS}")
        theirs, state, *theirs_had = json.loads(str(file[_PROGRESS]))  # older ones kept no contents
        if theirs != of:  # hours of work, perhaps
            raise InvalidOptions(
                f"{part} is of another seed, other data, weights or noise: go on with those, or remove it"
            )
        if theirs_had not in ([], [contents]):
            raise InvalidOptions(
                f"{part} is of archives of these names that held other arrays: go on with those, or remove it"
            )
        rng.bit_generator.state = state
        return {name: file[name] for name in file.files if name != _PROGRESS}


def _keep(
    part: Path, written: Mapping[str, npt.NDArray[np.generic]], of: list[object], state: object, contents: list[int]
) -> None:
    write_archive(part, {_PROGRESS: np.array(json.dumps([of, state, contents])), **written})


def _digest(denoiser: Filter) -> int:
    """Tell weights from others."""
    digest = 0
    for tensor in denoiser.network.state_dict().values():
        digest = zlib.crc32(tensor.cpu().numpy().tobytes(), digest)
    return digest


class _Recording(Run):
    """Keep what each pass but the first is given, as long as it is shown in the usual size."""

    seen: tuple[Floats, ...] = ()

    def _pass(self, here: Floats, tiling: Tiling, left: int) -> Iterator[object]:  # type: ignore[override]
        if self.iterations > 1 and self.readings[-1].zoom == 1.0:
            self.seen = (*self.seen, here.copy())
        yield from super()._pass(here, tiling, left)


def _training_clouds(archive: Path) -> dict[str, Clouds]:
    """Return the clean clouds of each shape that is not held out, the coarsest first, and where its beams came from."""
    with opened(archive) as file:
        held_out = held_out_shapes(file.files)
        names = [split_name(name, archive) for name in file.files]
        found: dict[str, Clouds] = {}
        clouds = sorted((shape, int(what), what) for shape, what in names if what.isdecimal() and shape not in held_out)
        for shape, _, points in clouds:
            if shape not in found:
                eye = f"{shape}/eye"
                found[shape] = [], read_array(file, eye, archive).astype(np.float64) if eye in file else None
            found[shape][0].append(read_array(file, f"{shape}/{points}", archive).astype(np.float64))
    if not found:
        raise InvalidOptions(f"{archive} has no clouds called <shape>/<points> of a shape that is not held out")
    return found


def _interrupt(number: int, frame: object) -> None:
    for each in (signal.SIGINT, signal.SIGTERM):  # `timeout` sends two, and what is there is being kept
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt


@errors_in_one_line()
def _main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("path", type=archive_to_write, help="the .npz to write")
    parser.add_argument("--data", type=Path, action="append", required=True, help="clean clouds; may be given again")
    parser.add_argument("--weights", type=Path, help="a checkpoint or a training state; the shipped weights by default")
    parser.add_argument("--count", type=positive, default=500, help="clouds to record, three of each filtered one")
    parser.add_argument(
        "--noise",
        type=noise_level,
        nargs="+",
        default=LEVELS,
        help="stds, in radii of the bounding sphere, each as likely",
    )
    parser.add_argument("--seed", type=seed_number, default=0)
    parser.add_argument("--device", type=device, default="cpu", help='"cpu" (the default), "cuda" or "cuda:N"')
    parser.add_argument("--threads", type=positive)
    options = parser.parse_args()
    denoiser = load_filter(device=options.device, threads=options.threads)
    if options.weights is not None:
        denoiser.network.velocity_modules.load_state_dict(
            read_network(options.weights)[0].velocity_modules.state_dict()
        )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    try:
        write_passed(options.path, denoiser, options.data, options.count, seed=options.seed, levels=options.noise)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; the same command goes on from what it has\n")
        sys.exit(130)


if __name__ == "__main__":
    _main()
