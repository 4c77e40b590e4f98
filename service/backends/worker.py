"""The worker process: load the model once, then denoise files as they are asked for."""

from __future__ import annotations

import logging
import math
import signal
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

from straightpcf.points.errors import InternalError, JobCanceled, MissingDependency, StraightPCFError, TooLarge
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.backends.base import FileJob, FileReport
from straightpcf.service.backends.denoise_file import denoise_file
from straightpcf.service.jobs.full_disk import full_disk_as_spool_full

if TYPE_CHECKING:
    from straightpcf.model.filter import Filter

__all__ = [
    "SERVERS_OWN",
    "Cancel",
    "Done",
    "Failed",
    "Preview",
    "Progress",
    "Ready",
    "Unusable",
    "WorkerSpec",
    "run_worker",
]

# Ctrl-C reaches the whole group, and so does what systemd, `timeout` and a closed terminal send: the server says when
# to end.
SERVERS_OWN = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

PROGRESS_INTERVAL_SECONDS = 0.05
# More than a patch on a CPU, more than a batch of patches on a device, so that the usual path is the one that is warm.
WARM_UP_POINTS, DEVICE_WARM_UP_POINTS = 1200, 12_000

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class WorkerSpec:
    """Say what a worker computes with."""

    device: str
    weights: Path | None
    threads: int | None
    tile_points: int | None = None


# What crosses the pipe. To the worker: FileJob, Cancel, None to end. From it: the others.
@dataclass(frozen=True)
class Cancel:
    """Ask the worker to drop a job at its next patch."""

    job_id: str


@dataclass(frozen=True)
class Ready:
    """Tell that the model is loaded and one cloud went through it."""

    device: str


@dataclass(frozen=True)
class Progress:
    """Tell the share of a job that is done, 0..1."""

    job_id: str
    fraction: float
    iteration: int


@dataclass(frozen=True)
class Preview:
    """Tell where a few points are after a pass."""

    job_id: str
    iteration: int
    indices: list[int]
    xyz: list[list[float]]


@dataclass(frozen=True)
class Done:
    """Tell that a job's target file is complete."""

    job_id: str
    report: FileReport


@dataclass(frozen=True)
class Failed:
    """Tell why a job, or with job_id None the start, failed; the code names the class."""

    job_id: str | None
    code: str
    message: str


@dataclass(frozen=True)
class Unusable:
    """Tell that a job's files could not be read or written, which is no fault of the job."""

    job_id: str
    message: str


def run_worker(pipe: Connection, spec: WorkerSpec) -> None:
    """Serve jobs until the pipe says None or its other end is gone."""
    for number in SERVERS_OWN:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SERVERS_OWN)
    try:
        denoiser = _load(spec)
    except StraightPCFError as error:
        pipe.send(Failed(None, error.code, error.message))
        return
    except OSError as error:  # no such weights
        pipe.send(Failed(None, InternalError.code, str(error)))
        return
    try:
        pipe.send(Ready(denoiser.device))
        while (job := pipe.recv()) is not None:
            if isinstance(job, FileJob):  # a Cancel that comes after its job has ended means nothing
                pipe.send(_answer(denoiser, job, pipe))
    except (EOFError, ConnectionError):
        return  # the server is gone, maybe before it read what was sent, and so is who would want the result


def _load(spec: WorkerSpec) -> Filter:
    import numpy as np

    try:
        from straightpcf.model.filter import load_filter
    except ImportError as exc:  # another process would meet it, too
        raise MissingDependency.of("model", exc) from exc
    denoiser = load_filter(spec.weights, device=spec.device, threads=spec.threads, tile_points=spec.tile_points)
    count, options = WARM_UP_POINTS, DenoiseOptions()
    if denoiser.device != "cpu":  # between passes points are spread, which is compiled there, too
        count, options = DEVICE_WARM_UP_POINTS, DenoiseOptions(iterations=2)
    # Spread evenly, on a spiral: points that lie by chance are not spread between passes.
    height = 1 - (2 * np.arange(count) + 1) / count
    angle, radius = math.pi * (3 - math.sqrt(5)) * np.arange(count), np.sqrt(1 - height**2)
    denoiser.denoise(np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1), options)
    return denoiser


def _answer(denoiser: Filter, job: FileJob, pipe: Connection) -> Done | Failed | Unusable:
    sent, last_iteration = 0.0, 0

    def heed() -> None:
        while pipe.poll():
            message = pipe.recv()
            if message is None:
                raise EOFError("the server ends this worker")
            if message == Cancel(job.id):
                raise JobCanceled(f"job {job.id} was canceled")

    def on_progress(fraction: float, iteration: int) -> None:
        nonlocal sent, last_iteration
        heed()
        if (now := time.monotonic()) - sent >= PROGRESS_INTERVAL_SECONDS or iteration != last_iteration:
            sent, last_iteration = now, iteration
            pipe.send(Progress(job.id, fraction, iteration))

    def on_preview(iteration: int, indices: list[int], xyz: list[list[float]]) -> None:
        pipe.send(Preview(job.id, iteration, indices, xyz))

    try:
        with full_disk_as_spool_full():
            report = denoise_file(denoiser, job, on_progress=on_progress, on_preview=on_preview, heed=heed)
            return Done(job.id, report)
    except (EOFError, BrokenPipeError):
        raise
    except StraightPCFError as error:
        return Failed(job.id, error.code, error.message)
    except OSError as error:  # its folder is read-only, or gone: where another server deletes the job, too
        return Unusable(job.id, f"job {job.id}: its files cannot be used: {error}")
    except Exception as error:
        from straightpcf.model.device import is_lost

        if is_lost(denoiser.device):
            raise  # this process is of no use any more: another one takes its place, and the job
        return _failure(job.id, error)


def _failure(job_id: str, error: Exception) -> Failed:
    logger.exception("the worker met an error of no kind of ours")
    if isinstance(error, MemoryError):
        return Failed(job_id, TooLarge.code, "the cloud does not fit in this server's memory")
    return Failed(job_id, InternalError.code, f"the worker failed with {type(error).__name__}")
