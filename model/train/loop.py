"""One linear training loop for the three stages."""

from __future__ import annotations

import copy
import csv
import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from straightpcf.model.allocator import keep_large_buffers
from straightpcf.model.filter import device_named
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.train.data import Batch, PatchSource
from straightpcf.model.train.losses import coupled_loss, distance_loss, velocity_loss
from straightpcf.model.train.passed import training_patches
from straightpcf.model.train.run_lock import held
from straightpcf.model.train.soap import SOAP
from straightpcf.model.train.state import Average, load_state, read_network, save_state, take_distance_module
from straightpcf.model.train.step import GraphedStep, HostStep, Step
from straightpcf.model.train.team import NetworkLoss, Team
from straightpcf.points.errors import InvalidOptions
from straightpcf.points.options import check_threads

__all__ = ["STATE_FILE", "Stage", "TrainStep", "train"]

Stage = Literal["vm", "cvm", "dm"]
STATE_FILE = "state.safetensors"
_LOG_FILE, _COLUMNS = "log.csv", ("stage", "iteration", "loss", "validation", "learning_rate", "seconds")
_LOSSES = {"vm": velocity_loss, "cvm": coupled_loss, "dm": distance_loss}
_WARMUP = 200
_TURN_EVERY = 10  # iterations between two turns of the optimiser's bases
_EMA_DECAY = 0.999
_LOG_EVERY = 50
_SAVE_SECONDS = {"cpu": 0.0, "cuda": 20.0}  # between two states: a GPU makes an iteration while one file is written
_VALIDATE_EVERY = 250
_VALIDATION_PATCHES = 64


@dataclass(frozen=True)
class TrainStep:
    """One iteration as it was; validation is None in between."""

    iteration: int
    iterations: int
    loss: float
    validation: float | None
    learning_rate: float


def train(
    stage: Stage,
    *,
    data: Path | Sequence[Path],
    run_dir: Path,
    iterations: int,
    batch_size: int = 16,
    learning_rate: float = 1e-3,
    rows: int = 256,
    couplings: int = 2,
    seed: int = 0,
    device: str = "cpu",
    threads: int | None = None,
    processes: int = 1,
    minutes: float | None = None,
    init: Path | None = None,
    distance: Path | None = None,
    passed: Sequence[Path] = (),
    settled: bool = False,
    euler_steps: int = 1,
    on_step: Callable[[TrainStep], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Path:
    """Train one stage up to `iterations`, going on from `run_dir` where a run was left there.

    data: the archives of clean clouds (`PatchSource.read`), which a run that goes on may change; passed: of stage cvm,
    archives of their shapes as later passes see them (`write_passed`).
    init: the state to start from on a fresh run: the stage before ("cvm" and "dm" need it), or the same stage, or
    weights that ship. distance: one of these whose DistanceModule to start from instead. rows: points of a patch in the
    loss. settled: without dropout, BatchNorm's statistics kept as they are: for a network that was trained before. The
    learning rate warms up, then falls along half a cosine to 2 % at `iterations`. minutes: stop there with the state
    saved, to go on another time (a GPU may be lent for ten minutes at once). processes: on a CPU, how many share each
    batch, one thread each; batch_size must be a multiple. euler_steps: N of the pass that stage cvm trains on
    (`coupled_loss`). stop: asked after each iteration, whether to end there with the state saved, as an interruption
    wants it.
    Writes `state.safetensors` and `log.csv` to run_dir and returns the state's path; on a CPU the same seed, thread
    and process count give the same weights, on CUDA sums have no fixed order. Raises InvalidOptions where `init` is
    missing or unfit, another process trains in run_dir or the run diverges (the last state is kept), DeviceUnavailable,
    and what `PatchSource.read` does.
    """
    place = torch.device(device_named(device))
    if batch_size % processes:
        raise InvalidOptions(f"{processes} processes cannot share batches of {batch_size}: give a multiple of them")
    if processes > 1 and place.type != "cpu":
        raise InvalidOptions(f"{processes} processes cannot share batches on {place}: they do so on a CPU")
    if passed and stage != "cvm":
        raise InvalidOptions(f"clouds after passes are for stage 'cvm', not for {stage!r}")
    check_threads(threads)
    archives = [data] if isinstance(data, Path) else list(data)
    if threads is not None:
        torch.set_num_threads(threads)
    keep_large_buffers()
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    run_dir.mkdir(parents=True, exist_ok=True)
    state_path = run_dir / STATE_FILE
    if place.type == "cuda" and place.index is not None:  # "cuda" is the current one, and set_device takes no other
        torch.cuda.set_device(place)  # captures and Triton work on the current one

    with ExitStack() as lent:
        lent.enter_context(held(run_dir))
        if resuming := state_path.exists():
            _check_run(state_path, stage, couplings)
        network = _network(stage, None if resuming else init, couplings, resuming=resuming).to(place)
        if distance is not None and not resuming:
            take_distance_module(network, distance)
        trained = _trained_part(stage, network)
        optimiser = SOAP(trained.parameters())
        average = Average(network, _EMA_DECAY)
        start = saved = load_state(state_path, network, average, optimiser, rng)["iteration"] if resuming else 0

        source = training_patches(archives, passed, network.distance_module)
        stage_loss: NetworkLoss = partial(_LOSSES[stage], rows=rows)
        if stage == "cvm":
            stage_loss = partial(coupled_loss, rows=rows, euler_steps=euler_steps)
        loss_of = partial(stage_loss, network)
        held_out = PatchSource.read(*archives, validation=True)
        fixed = held_out.draw(np.random.default_rng(1), _VALIDATION_PATCHES, augment=False).to(place)
        _cut_log(run_dir / _LOG_FILE, start)
        share = batch_size // processes
        team = None
        if processes > 1:
            team = lent.enter_context(
                Team(processes - 1, network, trained, stage_loss, archives, share, seed, start=start, passed=passed)
            )
        step: Step = (
            GraphedStep(source, loss_of, trained, optimiser, place, batch_size)
            if place.type == "cuda"
            else HostStep(source, loss_of, trained, optimiser, rng, share, team)
        )
        began = saved_at = time.monotonic()
        validation: float | None = None
        file = lent.enter_context((run_dir / _LOG_FILE).open("a", newline=""))
        log = csv.writer(file)
        recent: list[float] = []
        recent_loss = math.nan
        trained.train(not settled)
        for iteration in range(start + 1, iterations + 1):
            rate = _learning_rate(learning_rate, iteration, iterations)
            loss = step(rate)
            average.update(iteration)
            if iteration % _TURN_EVERY == 0:
                optimiser.turn_bases()
            last = iteration == iterations or (minutes is not None and time.monotonic() - began >= 60 * minutes)
            stopping = stop()
            # On CUDA reading the loss waits for the device: only where it is reported.
            if place.type == "cpu" or iteration % _LOG_EVERY == 0 or last or stopping:
                recent.append(loss.item())
                recent_loss = recent[-1]
                if not math.isfinite(recent_loss):
                    raise _diverged(f"the loss is {recent_loss}", iteration, saved, learning_rate, state_path)
            if (iteration % _VALIDATE_EVERY == 0 or last) and not stopping:  # who interrupts does not wait for long
                validation = _validate(stage_loss, network, average, fixed)
            if iteration % _LOG_EVERY == 0 or last or stopping:
                if last or stopping or time.monotonic() - saved_at >= _SAVE_SECONDS[place.type]:
                    progress = {"stage": stage, "iteration": iteration, "seed": seed, "batch_size": batch_size,
                                "learning_rate": learning_rate, "validation": validation}  # fmt: skip
                    if not average.is_finite():  # the loss says so an iteration later, and the old state would be gone
                        raise _diverged("weights are not finite", iteration, saved, learning_rate, state_path)
                    save_state(state_path, network, average, optimiser, rng, progress)
                    saved, saved_at = iteration, time.monotonic()
                seconds = round(time.monotonic() - began, 1)
                log.writerow([stage, iteration, round(float(np.mean(recent)), 5), validation, rate, seconds])
                file.flush()
                recent.clear()
            if on_step is not None:
                on_step(TrainStep(iteration, iterations, recent_loss, validation, rate))
            validation = None
            if last or stopping:
                break
    return state_path


def _diverged(what: str, iteration: int, saved: int, learning_rate: float, state: Path) -> InvalidOptions:
    kept = f"{state} has iteration {saved}, from which the same command goes on" if saved else "nothing was saved"
    advice = f"give it a lower learning rate than {learning_rate:g}"
    return InvalidOptions(f"{what} at iteration {iteration}: the run diverged; {kept}; {advice}")


def _check_run(path: Path, stage: Stage, couplings: int) -> None:
    """Raise InvalidOptions where the state in the run's directory is of another stage or stack."""
    network, progress = read_network(path)
    have, count = len(network.velocity_modules), 1 if stage == "vm" else couplings
    if progress.get("stage") != stage or have != count:
        raise InvalidOptions(
            f"{path} is of stage {progress.get('stage')!r} with {have} modules, not {stage!r} with {count}: "
            "another run takes another directory"
        )


def _cut_log(path: Path, start: int) -> None:
    """Keep of a log what the state has that a run goes on from: what an interruption lost will come again."""
    rows: list[list[str]] = []
    if start and path.exists():
        with path.open(newline="") as file:
            rows = [row for row in csv.reader(file) if len(row) == len(_COLUMNS) and row[1].isdigit()]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([_COLUMNS, *(row for row in rows if int(row[1]) <= start)])


def _network(stage: Stage, init: Path | None, couplings: int, *, resuming: bool) -> StraightPCF:
    count = 1 if stage == "vm" else couplings
    if init is None and (stage == "vm" or resuming):
        network = StraightPCF(couplings=count)
        for module in network.velocity_modules:
            module.start_slow()  # type: ignore[operator]
    elif init is None:
        raise InvalidOptions(f"stage {stage!r} starts from the stage before: give its {STATE_FILE} as init")
    else:
        network, _ = read_network(init)
        have = len(network.velocity_modules)
        # How products round depends on where tensors lie: a file's are mapped, those of a run gone on with are not.
        for tensor in (*network.parameters(), *network.buffers()):
            tensor.data = tensor.data.clone()
        if stage == "cvm" and have == 1:
            first = network.velocity_modules[0]
            network.velocity_modules.extend(copy.deepcopy(first) for _ in range(count - 1))
        elif have != count:
            raise InvalidOptions(f"{init} has {have} coupled modules; this run wants {count}")
    if stage == "dm":
        network.velocity_modules.requires_grad_(requires_grad=False)
    return network.eval()


def _trained_part(stage: Stage, network: StraightPCF) -> torch.nn.Module:
    return network.distance_module if stage == "dm" else network.velocity_modules


def _learning_rate(peak: float, iteration: int, iterations: int) -> float:
    if iteration < _WARMUP:
        return peak * iteration / _WARMUP
    done = (iteration - _WARMUP) / max(1, iterations - _WARMUP)
    return peak * (0.02 + 0.98 * (1 + math.cos(math.pi * done)) / 2)


@torch.no_grad()
def _validate(loss: NetworkLoss, network: StraightPCF, average: Average, fixed: Batch) -> float:
    averaged = copy.deepcopy(network)
    averaged.load_state_dict(average.tensors)
    averaged.eval()
    return round(float(np.mean([loss(averaged, part).item() for part in fixed.split(8)])), 5)
