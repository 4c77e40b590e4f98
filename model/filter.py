"""The filter: the network and what it is run with; `run` has the passes over a cloud."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path

import numpy.typing as npt
import torch

from straightpcf.model.allocator import keep_large_buffers
from straightpcf.model.calibration import Calibration
from straightpcf.model.checkpoint import load_checkpoint, read_checkpoint
from straightpcf.model.cpus import usable_cpus, use_one_thread_if_forked
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.objects import begin
from straightpcf.model.on_device import OnDevice
from straightpcf.model.on_host import OnHost
from straightpcf.model.processor import First, Processor
from straightpcf.model.result import DenoiseResult, FinishedPatch
from straightpcf.model.run import MIN_POINTS, Run
from straightpcf.model.turns import turns
from straightpcf.points.device import DEVICE_NAME
from straightpcf.points.errors import DeviceUnavailable, InvalidOptions
from straightpcf.points.options import MIN_TILE_POINTS, DenoiseOptions, check_threads

__all__ = [
    "DEFAULT_WEIGHTS",
    "MIN_POINTS",
    "DenoiseResult",
    "Filter",
    "FinishedPatch",
    "Run",
    "denoise",
    "device_named",
    "load_filter",
]

DEFAULT_WEIGHTS = Path(__file__).with_name("weights") / "straightpcf.safetensors"
EULER_STEPS = 3
COVERAGE = 3.0  # patches per point; the published scheme takes 6 (benchmarks/RESULTS.md compares)
FULL_EVALUATIONS = 1  # of a patch's evaluations, made for all of its points; the others for those that it owns
TILE_POINTS = 1_000_000  # cut at once; docs/kernels.md has what that costs
_TURNS = 6  # positions in which a patch is shown: one an evaluation, for N = 3 and K = 2


def load_filter(
    weights: str | Path | None = None,
    *,
    device: str = "auto",
    threads: int | None = None,
    tile_points: int | None = None,
) -> Filter:
    """Load a network, the shipped one by default, onto "cpu", "cuda" or the better one present ("auto").

    threads: CPU threads, by default one for each CPU that is usable here; the result does not depend on it.
    tile_points: see Filter. Raises DeviceUnavailable for a device that is not here, MalformedFile for weights that do
    not fit, InvalidOptions.
    """
    use_one_thread_if_forked()
    chosen = device_named(device)
    path = DEFAULT_WEIGHTS if weights is None else Path(weights)
    network = load_checkpoint(path, device=chosen)
    calibration = Calibration.from_metadata(read_checkpoint(path)[1])
    return Filter(network, calibration=calibration, device=chosen, threads=threads, tile_points=tile_points)


def device_named(name: str) -> str:
    """Return "cpu", "cuda" or "cuda:N" for that or "auto"; raises DeviceUnavailable for what is not here."""
    if not DEVICE_NAME.fullmatch(name):
        raise DeviceUnavailable(f'device is {name[:40]!r}; it must be "auto", "cpu", "cuda" or "cuda:N"')
    here = torch.cuda.device_count() if name != "cpu" and torch.cuda.is_available() else 0  # too old drivers count, too
    if name == "auto":
        return "cuda" if here else "cpu"
    number = int(name.partition(":")[2] or 0)
    if name != "cpu" and number >= here:
        raise DeviceUnavailable(f"device {name} was asked for, and torch sees {here} CUDA devices here")
    return name


def denoise(
    xyz: npt.ArrayLike, *, iterations: int | str = "auto", seed: int = 0, device: str = "auto"
) -> DenoiseResult:
    """Filter (N, 3) points with the shipped weights: `load_filter` and `Filter.denoise` in one call."""
    options = DenoiseOptions.parse(iterations=str(iterations), seed=str(seed))
    return load_filter(device=device).denoise(xyz, options)


class Filter:
    """A loaded network with the stages around it; safe to use again, from one thread at a time.

    On a CPU it can be handed to other processes, also as what `multiprocessing.Pool.map` is to call.
    """

    def __init__(
        self,
        network: StraightPCF,
        *,
        calibration: Calibration | None = None,
        device: str = "cpu",
        threads: int | None = None,
        coverage: float = COVERAGE,
        euler_steps: int = EULER_STEPS,
        full_evaluations: int = FULL_EVALUATIONS,
        agree: bool = True,
        even: bool = True,
        zoom: bool = True,
        tile_points: int | None = None,
    ) -> None:
        """Put a network between the stages.

        agree: what overlapping patches say of a point first is joined (`Agreement`).
        even: between passes, points are spread along the surface (`spread`). zoom: passes show an object in the size of
        its noise, and in parts where that fills the patches (`NoiseReader`), and less than what the network asks for is
        made of steps that are more than the noise (`restraint`).
        tile_points: how many points are cut into patches at once: what memory a filter needs beside the cloud itself.
        Raises InvalidOptions where they are fewer than MIN_TILE_POINTS, threads are not in 1..MAX_THREADS, one of
        coverage, euler_steps and full_evaluations is below 1, or one of all these but coverage is no whole number.
        """
        check_threads(threads)
        counts = {"euler_steps": euler_steps, "full_evaluations": full_evaluations}
        for name, count in {**counts, "tile_points": tile_points}.items():
            if not isinstance(count, Integral | None):
                raise InvalidOptions(f"{name} is {count!r}; it must be a whole number")
        for name, value in {**counts, "coverage": coverage}.items():
            if value is not None and not value >= 1:
                raise InvalidOptions(f"{name} is {value}; it must be at least 1")
        self.tile_points = TILE_POINTS if tile_points is None else tile_points
        if self.tile_points < MIN_TILE_POINTS:
            raise InvalidOptions(f"tile_points is {tile_points}; it must be at least {MIN_TILE_POINTS}")
        self.network = network.eval().requires_grad_(requires_grad=False)
        self.calibration = calibration or Calibration()
        self.device = device
        self.threads = threads or usable_cpus()
        self.coverage = coverage
        self.euler_steps = euler_steps
        self.full_evaluations = full_evaluations
        self.agree = agree
        self.even = even
        self.zoom = zoom
        self.turns = turns(_TURNS).to(device)
        self.processor: Processor
        if device == "cpu":
            self.processor = OnHost(self, self.threads)
        else:
            self.processor = OnDevice(self, device, threads=self.threads)
        keep_large_buffers()

    @contextmanager
    def heeding(self, heed: Callable[[], None]) -> Iterator[None]:
        """Call `heed` again and again in here, also before a first patch is settled; what it raises ends the work.

        On a CPU, where a cloud's noise takes a second to read; on a device it is never called.
        """
        host = self.processor if isinstance(self.processor, OnHost) else None
        if host is None:
            yield
            return
        host.heed = heed
        try:
            yield
        finally:
            host.heed = None

    def begin(self, x: torch.Tensor) -> torch.Tensor:
        """Return the velocities (B, P, 3) of a pass's first evaluation of patches (B, P, 3) float32."""
        return self.network.first_velocities(x, self.turns)

    def forward(
        self, x: torch.Tensor, owned: torch.Tensor, distance: torch.Tensor | None, first: First | None, rows: int
    ) -> torch.Tensor:
        """Return how far the first `rows` points of patches (B, P, 3) float32 move in a pass, (B, rows, 3).

        owned: (B,), of how many only that is asked; distance: (B, 1), where the DistanceModule has been asked before;
        first: the velocities of the first evaluation, where that was made, and what takes their place.
        """
        moved: torch.Tensor = self.network(
            x,
            euler_steps=self.euler_steps,
            rows=rows,
            owned=owned,
            full_evaluations=self.full_evaluations,
            distance=distance,
            turns=self.turns,
            first=first,
        )[0]
        return moved - x[:, :rows]

    def distance(self, x: torch.Tensor) -> torch.Tensor:
        """Return what the DistanceModule says of patches (B, P, 3) float32: (B, 1)."""
        distance: torch.Tensor = self.network.distance_module(x)
        return distance

    def denoise(
        self,
        xyz: npt.ArrayLike,
        options: DenoiseOptions | None = None,
        *,
        on_progress: Callable[[float], None] | None = None,
    ) -> DenoiseResult:
        """Move (N, 3) points to the surface; an exception raised by on_progress (0..1, at the end 1) ends the work.

        Numbers of other types become float64. Raises TooFewPoints below MIN_POINTS finite rows, InvalidCloud.
        """
        run = begin(self, xyz, options or DenoiseOptions())
        began = time.monotonic()
        for patch in run.patches():
            if on_progress is not None:
                on_progress(patch.progress)
        if on_progress is not None:
            on_progress(1.0)
        return run.result(time.monotonic() - began)

    def patches(self, xyz: npt.ArrayLike, options: DenoiseOptions | None = None) -> Iterator[FinishedPatch]:
        """Yield patches of (N, 3) points as they are settled; the last position given for a point is its result.

        Rows that are not finite belong to no patch. Order and batching never change a position.
        """
        return begin(self, xyz, options or DenoiseOptions()).patches()
