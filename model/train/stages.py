"""Train the three stages one after the other, each from the one before; resumable.

python -m straightpcf.model.train.stages runs/all --data punet_train.npz --data solids.npz [--device cuda --minutes 9]
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from straightpcf.model.train.command import device, errors_in_one_line, positive, positive_number, seed_number
from straightpcf.model.train.loop import STATE_FILE, Stage, TrainStep, train
from straightpcf.model.train.state import read_header

__all__ = ["RUNS", "StageRun", "train_stages"]

_INTERRUPTED = 130  # exit code, as a shell has it
_SAID_EVERY = 250  # iterations


@dataclass(frozen=True)
class StageRun:
    """One run of the chain: its folder's name, and what `train` is told."""

    name: str
    stage: Stage
    iterations: int
    batch_size: int
    learning_rate: float
    settled: bool = False
    euler_steps: int = 1


# As docs/training.md, "From nothing to weights that ship", has them.
RUNS = (
    StageRun("vm", "vm", 24_000, 16, 1e-3),
    StageRun("vm2", "vm", 7_000, 16, 1e-3, settled=True),
    StageRun("cvm", "cvm", 7_000, 8, 5e-4, settled=True, euler_steps=3),
    StageRun("dm", "dm", 9_000, 16, 1e-3),
)


def train_stages(
    run_dir: Path,
    *,
    data: Sequence[Path],
    share: float = 1.0,
    rows: int = 256,
    seed: int = 0,
    device: str = "cpu",
    threads: int | None = None,
    processes: int = 1,
    minutes: float | None = None,
    on_step: Callable[[StageRun, TrainStep], None] = lambda run, step: None,
    stop: Callable[[], bool] = lambda: False,
) -> Path | None:
    """Train all of RUNS in folders of `run_dir`, going on where it was left; return the last one's state.

    share: of each run's iterations. minutes: of all, from now on; what is not done by then, or where `stop` says so,
    is gone on with by the next call, and None is returned. The others are those of `train`, which says what is raised.
    """
    until = None if minutes is None else time.monotonic() + 60 * minutes
    state: Path | None = None
    for run in RUNS:
        init, state = state, run_dir / run.name / STATE_FILE
        iterations = max(1, round(share * run.iterations))
        if not _is_done(state, iterations):
            left = None if until is None else (until - time.monotonic()) / 60
            if left is not None and left <= 0:
                return None
            train(
                run.stage,
                data=data,
                run_dir=state.parent,
                iterations=iterations,
                batch_size=run.batch_size,
                learning_rate=run.learning_rate,
                rows=rows,
                seed=seed,
                device=device,
                threads=threads,
                processes=processes,
                minutes=left,
                init=init,
                settled=run.settled,
                euler_steps=run.euler_steps,
                on_step=lambda step, run=run: on_step(run, step),  # type: ignore[misc]
                stop=stop,
            )
        if not _is_done(state, iterations) or (stop() and run is not RUNS[-1]):
            return None
    return state


def _is_done(state: Path, iterations: int) -> bool:
    """Tell whether a run is over, without its data."""
    return state.exists() and json.loads(read_header(state).get("progress", "{}")).get("iteration", 0) >= iterations


def _say(run: StageRun, step: TrainStep) -> None:
    if step.iteration % _SAID_EVERY == 0 or step.iteration == step.iterations:
        validation = "" if step.validation is None else f", validation {step.validation:g}"
        _line(f"{run.name}: {step.iteration} of {step.iterations}, loss {step.loss:.4g}{validation}")


def _line(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


@errors_in_one_line()
def _main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run_dir", type=Path, help="a folder of each run is made in it")
    parser.add_argument("--data", type=Path, action="append", required=True, help="clean clouds; may be given again")
    parser.add_argument("--share", type=positive_number, default=1.0, help="of each run's iterations")
    parser.add_argument("--seed", type=seed_number, default=0)
    parser.add_argument("--device", type=device, default="cpu", help='"cpu" (the default), "cuda" or "cuda:N"')
    parser.add_argument("--threads", type=positive)
    parser.add_argument("--processes", type=positive, default=1, help="on a CPU, to share each batch")
    parser.add_argument("--minutes", type=positive_number, help="of all runs; the same command goes on from there")
    options = parser.parse_args()
    asked: list[int] = []

    def interrupt(number: int, frame: object) -> None:
        if asked:  # once more: it waits for nothing
            raise KeyboardInterrupt
        asked.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    state = train_stages(on_step=_say, stop=lambda: bool(asked), **vars(options))
    if state is None:
        _line("not done yet; the same command goes on from here")
        sys.exit(_INTERRUPTED if asked else 0)
    _line(str(state))


if __name__ == "__main__":
    _main()
