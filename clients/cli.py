"""The command line: validate, hand over, report. Everything heavy is imported by the command that needs it.

Exit codes: 0 done, 1 no result for a reason outside (the port is taken), 2 usage, 3 bad input, 4 a device or a
package is missing, 5 busy or unreachable, 70 our fault, 130 interrupted. Errors are one line on stderr.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import straightpcf
from straightpcf.points import errors

__all__ = ["EXIT_CODES", "app", "exit_code", "main"]

# The first class that matches counts: the narrow ones come before those that hold them.
EXIT_CODES: tuple[tuple[type[Exception], int], ...] = (
    (errors.InvalidOptions, 2),
    (errors.MissingDependency, 4),
    (errors.DeviceUnavailable, 4),
    (ModuleNotFoundError, 4),
    (errors.ServerBusy, 5),
    (errors.ConnectionFailed, 5),
    (errors.InvalidRequest, 3),
    (errors.TooLarge, 3),
    (errors.JobCanceled, 130),
    (OSError, 3),  # a file that is not there, or may not be written
    (Exception, 70),
)


class Device(StrEnum):
    """Name what to compute on."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Stage(StrEnum):
    """Name a stage of the training."""

    vm = "vm"
    cvm = "cvm"
    dm = "dm"


class _Commands(TyperGroup):
    """End every command's error in one line and its exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            if hasattr(error, "show") or ctx.params.get("traceback"):  # a usage error shows itself
                raise
            _complain(error)
            raise typer.Exit(exit_code(error)) from error


app = typer.Typer(
    cls=_Commands,
    help="Clean noisy point clouds: the same points, in the same order, on the surface.",
    epilog="Exit codes: 0 done, 2 usage, 3 bad input, 4 device or package missing, 5 busy, 70 internal.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main() -> None:
    """Run the command line; the console script `straightpcf`."""
    app(prog_name="straightpcf")


def exit_code(error: Exception) -> int:
    """Return the exit code of an error."""
    return next(code for kind, code in EXIT_CODES if isinstance(error, kind))


@app.callback()
def options(
    traceback: Annotated[bool, typer.Option("--traceback", help="Show where an error comes from.")] = False,
) -> None:
    """Take the options that stand before the command."""


@app.command()
def denoise(
    source: Annotated[Path, typer.Argument(metavar="IN", help="The noisy cloud.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="Where to write the result; its suffix says how.")],
    iterations: Annotated[str, typer.Option(metavar="auto|N", help="Passes of the filter.")] = "auto",
    device: Annotated[Device, typer.Option(help="What to compute on.")] = Device.auto,
    seed: Annotated[int, typer.Option(help="The same seed gives the same bytes.")] = 0,
    strength: Annotated[float, typer.Option(help="0..1, the share of the displacement to apply.")] = 1.0,
    weights: Annotated[Path | None, typer.Option(help="Other weights than the shipped ones.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads; by default torch's own choice.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Denoise one cloud in this process."""
    from straightpcf.points.formats import format_for
    from straightpcf.points.options import DenoiseOptions

    wanted = DenoiseOptions.parse(iterations=iterations, seed=str(seed), strength=str(strength))
    output_format = None if target.suffix.lower() == source.suffix.lower() else format_for(target.name).name
    if not source.is_file():
        raise FileNotFoundError(f"{source} is no file")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target.parent} is no folder to write {target.name} to")
    report = _denoise_in_process(source, target, output_format, wanted, device, weights, threads)
    if as_json:
        _print_json(report)
        return
    for warning in report.warnings:
        typer.echo(f"warning: {warning}", err=True)
    typer.echo(
        f"{target}: {report.points} points, {report.iterations} passes, estimated noise "
        f"{report.noise_before:.4g} -> {report.noise_after:.4g}, {report.seconds:.1f} s",
        err=True,
    )


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="The address to listen on.  [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="The port; 0 for any free one.  [default: 8000]")] = None,
    data_dir: Annotated[Path | None, typer.Option(help="Where requests are spooled.")] = None,
    device: Annotated[Device | None, typer.Option(help="What to compute on.  [default: auto]")] = None,
    weights: Annotated[Path | None, typer.Option(help="Other weights than the shipped ones.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads of the worker.")] = None,
    max_bytes: Annotated[int | None, typer.Option(help="Largest request body.")] = None,
    max_points: Annotated[int | None, typer.Option(help="Largest cloud.")] = None,
    max_jobs: Annotated[int | None, typer.Option(help="Requests held at once.")] = None,
) -> None:
    """Serve POST /denoise; every setting is also STRAIGHTPCF_<NAME> in the environment."""
    import os

    with _needs("service"):
        from straightpcf.service.app import serve as run_server
        from straightpcf.service.settings import Settings

    settings = Settings.from_environment(
        os.environ,
        host=host,
        port=port,
        data_dir=data_dir,
        device=None if device is None else device.value,
        weights=weights,
        threads=threads,
        max_bytes=max_bytes,
        max_points=max_points,
        max_jobs=max_jobs,
    )
    run_server(settings)


@app.command()
def info(
    file: Annotated[Path, typer.Argument(metavar="FILE")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Say what is in a file: format, points, fields, bounds, rows that are NaN or infinite."""
    import numpy as np

    from straightpcf.points.formats import read_cloud

    cloud, format = read_cloud(file)
    valid = np.isfinite(cloud.xyz).all(axis=1)
    has_bounds = bool(valid.any())
    facts: dict[str, Any] = {
        "file": str(file),
        "format": format.name,
        "points": len(cloud),
        "invalid_rows": int((~valid).sum()),
        "min": cloud.xyz[valid].min(axis=0).tolist() if has_bounds else None,
        "max": cloud.xyz[valid].max(axis=0).tolist() if has_bounds else None,
        "fields": {name: _describe(values) for name, values in cloud.attributes.items()},
    }
    _print_json(facts) if as_json else _print_table(facts)


@app.command()
def version() -> None:
    """Print the version."""
    typer.echo(straightpcf.__version__)


@app.command()
def train(
    stage: Annotated[Stage, typer.Argument(help="vm: one velocity module; cvm: the coupled stack; dm: the distance.")],
    data: Annotated[Path, typer.Option(help="Clean clouds, one NPZ.")],
    run_dir: Annotated[Path, typer.Option(help="Checkpoints and log; a run that is found there is resumed.")],
    iterations: Annotated[int, typer.Option(min=1)] = 20_000,
    batch_size: Annotated[int, typer.Option(min=1)] = 16,
    learning_rate: Annotated[float, typer.Option(min=0.0, help="Adam's, at its peak.")] = 1e-3,
    rows: Annotated[int, typer.Option(min=1, max=1000, help="Points of a patch in the loss.")] = 256,
    couplings: Annotated[int, typer.Option(min=1, max=8, help="K, the velocity modules of the stack.")] = 2,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    device: Annotated[str, typer.Option(metavar="cpu|cuda")] = "cpu",
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads.")] = None,
    init: Annotated[Path | None, typer.Option(help="The state of the stage before.")] = None,
) -> None:
    """Train one stage; resumable, logged as CSV."""
    with _needs("train"):
        from straightpcf.model.train import train as run_training

    with _progress_bar(f"training {stage.value}", unit="it") as show:
        run_training(
            stage.value,
            data=data,
            run_dir=run_dir,
            iterations=iterations,
            batch_size=batch_size,
            learning_rate=learning_rate,
            rows=rows,
            couplings=couplings,
            seed=seed,
            device=device,
            threads=threads,
            init=init,
            on_step=lambda step: show(step.iteration / step.iterations, f"loss {step.loss:.3e}"),
        )


@app.command()
def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Check what this machine has: Python, torch, devices, weights, extras. Exits 4 if denoising cannot work."""
    from straightpcf.clients.doctor import examine

    findings, healthy = examine()
    _print_json(findings) if as_json else _print_table(findings)
    if not healthy:
        raise typer.Exit(4)


def _denoise_in_process(
    source: Path,
    target: Path,
    output_format: str | None,
    wanted: Any,
    device: Device,
    weights: Path | None,
    threads: int | None,
) -> Any:
    from straightpcf.clients.atomic import replaced_when_complete

    with _needs("model"):
        from straightpcf.model.filter import load_filter
        from straightpcf.service.backends.base import FileJob
        from straightpcf.service.backends.denoise_file import denoise_file

    denoiser = load_filter(weights, device=device.value, threads=threads)
    with replaced_when_complete(target) as unfinished, _progress_bar(f"denoising {source.name}") as show:
        job = FileJob(
            id="cli",
            source=source,
            target=unfinished,
            options=wanted,
            max_points=sys.maxsize,
            name=source.name,
            format=output_format,
        )
        return denoise_file(denoiser, job, on_progress=lambda done, _: show(done))


@contextmanager
def _needs(extra: str) -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as exc:
        raise errors.MissingDependency(
            f"{exc.name} is not installed; pip install 'straightpcf[{extra}]' brings it"
        ) from exc


@contextmanager
def _progress_bar(title: str, *, unit: str = "%") -> Iterator[Callable[..., None]]:
    """Draw on stderr, where that is a terminal; show(fraction, note) moves the bar."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(title, total=1.0, note="")

        def show(fraction: float, note: str = "") -> None:
            progress.update(task, completed=fraction, note=note)

        yield show


def _print_json(value: Any) -> None:
    facts = dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
    typer.echo(json.dumps(facts, indent=2, default=str))


def _print_table(facts: dict[str, Any]) -> None:
    for name, value in facts.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key} ({text})" for key, text in value.items()) or "none"
        typer.echo(f"{name.replace('_', ' '):<14}{value}")


def _describe(values: Any) -> str:
    return f"{values.dtype}" if values.ndim == 1 else f"{values.dtype} x {values.shape[1]}"


def _complain(error: Exception) -> None:
    if isinstance(error, errors.StraightPCFError):
        code, text = error.code, error.message
    elif isinstance(error, OSError):
        code, text = errors.InvalidRequest.code, str(error)
    else:
        code, text = errors.InternalError.code, f"{type(error).__name__}: {error} (--traceback shows where)"
    typer.echo(f"error [{code}]: {' '.join(text.split())}", err=True)


if __name__ == "__main__":
    main()
