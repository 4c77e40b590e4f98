"""The command line: validate, hand over, report. Everything heavy is imported by the command that needs it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer
from typer.core import TyperGroup

import straightpcf
from straightpcf.clients import job_commands
from straightpcf.clients.atomic import check_target, place_named, replaced_when_complete
from straightpcf.clients.console import (
    INTERRUPTED,
    asked_to_stop,
    complain,
    ended_in_a_line,
    forgive,
    interruptible,
    needs,
    print_json,
    print_table,
    progress_bar,
    quiet_end,
    say,
    show_noise,
)
from straightpcf.clients.job_commands import Format, Iterations, Key, Name, Normals, Seed, Strength
from straightpcf.clients.stdio import STDIO, given_path, input_file, input_name, output_file
from straightpcf.points import errors
from straightpcf.points.device import DEVICE_NAME

__all__ = ["app", "main"]


class Stage(StrEnum):
    """Name a stage of the training."""

    vm = "vm"
    cvm = "cvm"
    dm = "dm"


class _Commands(TyperGroup):
    """End every command's error in one line and its exit code."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read what stands before the command: --help and --version print."""
        with ended_in_a_line(ctx.params):
            return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        with ended_in_a_line(ctx.params):
            return super().invoke(ctx)


def _device(text: str) -> str:
    """Refuse what is the name of no device, without the seconds that it takes to look for one."""
    if not DEVICE_NAME.fullmatch(text):
        raise typer.BadParameter(f"{text!r} is none of auto, cpu, cuda and cuda:N.")
    return text


_DEVICES = "auto|cpu|cuda|cuda:N"
Device: TypeAlias = Annotated[str, typer.Option(parser=_device, metavar=_DEVICES, help="What to compute on.")]
_TRAINING_DATA = "Clean clouds: an NPZ of (N, 3) floats, N >= 1000, called <shape>/<resolution>; may be given again."

app = typer.Typer(
    cls=_Commands,
    help="Clean noisy point clouds: the same points, in the same order, on the surface.",
    epilog="Exit codes: 0 done, 2 usage, 3 refused, 4 device or package missing, 5 busy or unreachable, 70 internal, "
    "130 interrupted or canceled, 141 nobody reads stdout.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def main() -> None:
    """Run the command line."""
    if sys.stdout is not None:  # a name that its encoding does not have is no error
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    forgive("stderr")
    with quiet_end():
        app(prog_name="straightpcf")


def _show_version(wanted: bool) -> None:
    if wanted:
        version()
        raise typer.Exit


@app.callback()
def options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
    traceback: Annotated[bool, typer.Option("--traceback", help="Show where an error comes from.")] = False,
) -> None:
    """Take the options that stand before the command."""


@app.command()
def denoise(
    source: Annotated[Path, typer.Argument(metavar="IN", parser=given_path, help="The noisy cloud; - for stdin.")],
    target: Annotated[
        Path, typer.Argument(metavar="OUT", parser=given_path, help="Where it goes; its suffix says how; - for stdout.")
    ],
    iterations: Iterations = "auto",
    device: Device = "auto",
    seed: Seed = "0",
    strength: Strength = "1.0",
    normals: Normals = "keep",
    format: Format = None,
    name: Name = None,
    weights: Annotated[Path | None, typer.Option(help="Other weights than the shipped ones.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads; by default one for each CPU.")] = None,
    url: Annotated[str | None, typer.Option(metavar="URL", help="Let this server do it, not this process.")] = None,
    api_key: Key = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Denoise one cloud, in this process or on a server."""
    from straightpcf.clients.sdk.request import check_suffix
    from straightpcf.points.formats import format_by_suffix, format_named, format_wanted
    from straightpcf.points.options import DenoiseOptions

    wanted = DenoiseOptions.parse(iterations=iterations, seed=seed, strength=strength, normals=normals)
    name = name or input_name(source)
    suffix = Path(name or "").suffix
    if target != STDIO:
        check_target(target)
    if format is not None:
        wanted_format = format_named(format)
        format = wanted_format.name
        if format_by_suffix(name or "") is not wanted_format:
            suffix = wanted_format.suffixes[0]
        if target != STDIO:
            check_suffix(target, format)
    elif target != STDIO:
        format = format_wanted(target.name, name)
    _check_where(url, device, weights, threads)
    with interruptible(), input_file(source, name) as path, output_file(target, suffix) as out:
        if url is not None:
            with job_commands.connect(url, api_key) as client, progress_bar(f"denoising {source.name}") as show:
                done = client.denoise(
                    path if name else path.read_bytes(), out, iterations=wanted.iterations, seed=wanted.seed,
                    strength=wanted.strength, normals=wanted.normals, format=format, name=name, on_progress=show,
                )  # fmt: skip
            report: Any = done.report
        else:
            report = _in_process(device, weights, threads)(path, out, name, format, wanted)
    if as_json and target != STDIO:
        print_json(report)
    else:
        show_noise(target, report)


@app.command()
def watch(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where clouds are put.")],
    target: Annotated[Path | None, typer.Option("--to", help="Where results go.  [default: DIR/clean]")] = None,
    once: Annotated[bool, typer.Option("--once", help="End when nothing is left to do; exit 3 if one failed.")] = False,
    iterations: Iterations = "auto",
    seed: Seed = "0",
    strength: Strength = "1.0",
    normals: Normals = "keep",
    device: Device = "auto",
    weights: Annotated[Path | None, typer.Option(help="Other weights than the shipped ones.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads; by default one for each CPU.")] = None,
    url: Annotated[str | None, typer.Option(metavar="URL", help="Let this server do it, not this process.")] = None,
    api_key: Key = None,
) -> None:
    """Denoise every cloud that is put into a folder, until it is interrupted."""
    from straightpcf.clients.watch import watch_folder
    from straightpcf.points.options import DenoiseOptions

    wanted = DenoiseOptions.parse(iterations=iterations, seed=seed, strength=strength, normals=normals)
    _check_where(url, device, weights, threads)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder")
    target = folder / "clean" if target is None else target
    target.mkdir(parents=True, exist_ok=True)
    if target.resolve() == folder.resolve():
        raise errors.InvalidOptions(f"--to is {target}, the folder that is watched; results would be taken for input")
    failures = 0
    with interruptible(), _one_by_one(url, api_key, device, weights, threads, wanted) as run:
        for path, outcome in watch_folder(folder, target, run, once=once):
            if isinstance(outcome, Exception):
                failures += 1
                complain(outcome, of=path)
            else:
                show_noise(target / path.name, outcome)
    if failures:
        raise typer.Exit(3)


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="The address to listen on.  [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="The port; 0 for any free one.  [default: 8000]")] = None,
    grpc_port: Annotated[int | None, typer.Option(help="Serve gRPC too, on this port.  [default: no gRPC]")] = None,
    data_dir: Annotated[Path | None, typer.Option(help="Where jobs are kept.")] = None,
    device: Annotated[
        str | None, typer.Option(help="auto, cpu, cuda, cuda:N; several with commas.  [default: auto]")
    ] = None,
    weights: Annotated[Path | None, typer.Option(help="Other weights than the shipped ones.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads of the worker.")] = None,
    max_bytes: Annotated[int | None, typer.Option(help="Largest request body.")] = None,
    max_points: Annotated[int | None, typer.Option(help="Largest cloud.")] = None,
    max_jobs: Annotated[int | None, typer.Option(help="Jobs held at once, waiting or running.")] = None,
) -> None:
    """Serve the API and the page; every setting is also STRAIGHTPCF_<NAME> in the environment (docs/settings.md)."""
    import os

    with needs("service"):
        from straightpcf.service.app import serve as run_server
        from straightpcf.service.settings import Settings

    settings = Settings.from_environment(
        os.environ,
        host=host,
        port=port,
        grpc_port=grpc_port,
        data_dir=data_dir,
        device=device,
        weights=weights,
        threads=threads,
        max_bytes=max_bytes,
        max_points=max_points,
        max_jobs=max_jobs,
    )
    forgive("stdout")  # it has the log of requests alone
    run_server(settings)


@app.command()
def info(
    file: Annotated[Path, typer.Argument(metavar="FILE", parser=given_path, help="The cloud; - for stdin.")],
    name: Name = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Say what is in a file: format, points, fields, bounds, rows that are NaN or infinite."""
    import numpy as np

    from straightpcf.points.formats import read_cloud

    name = name or input_name(file)
    with input_file(file, name) as path:
        cloud, format = read_cloud(path, name=name or "the cloud")
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
    print_json(facts) if as_json else print_table(facts)


@app.command()
def version() -> None:
    """Print the version."""
    say(straightpcf.__version__)


@app.command()
def train(
    stage: Annotated[Stage, typer.Argument(help="vm: one velocity module; cvm: the coupled stack; dm: the distance.")],
    data: Annotated[list[Path], typer.Option(help=_TRAINING_DATA)],
    run_dir: Annotated[Path, typer.Option(help="Checkpoints and log; a run that ended there is resumed.")],
    iterations: Annotated[int, typer.Option(min=1)] = 20_000,
    batch_size: Annotated[int, typer.Option(min=1)] = 16,
    learning_rate: Annotated[float, typer.Option(min=0.0, help="At its peak.")] = 1e-3,
    rows: Annotated[int, typer.Option(min=1, max=1000, help="Points of a patch in the loss.")] = 256,
    couplings: Annotated[int, typer.Option(min=1, max=8, help="K, the velocity modules of the stack.")] = 2,
    euler_steps: Annotated[int, typer.Option(min=1, max=8, help="N of the pass that cvm is trained on.")] = 1,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1)] = 0,
    device: Annotated[str, typer.Option(metavar=_DEVICES)] = "cpu",
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads.")] = None,
    processes: Annotated[int, typer.Option(min=1, help="On a CPU, to share each batch.")] = 1,
    init: Annotated[Path | None, typer.Option(help="The state to start from.")] = None,
    distance: Annotated[Path | None, typer.Option(help="A state whose DistanceModule to start from instead.")] = None,
    passed: Annotated[list[Path] | None, typer.Option(help="Clouds after passes, for cvm; may be given again.")] = None,
    settled: Annotated[bool, typer.Option("--settled", help="No dropout, BatchNorm as it is: to train on.")] = False,
    minutes: Annotated[float | None, typer.Option(min=0.0, help="Stop after these, with the state saved.")] = None,
) -> None:
    """Train one stage; resumable, logged as CSV. Ctrl-C ends it after the iteration at hand, with the state saved."""
    with needs("train"):
        from straightpcf.model.train import train as run_training

    done = 0

    def on_step(step: Any) -> None:
        nonlocal done
        done = step.iteration
        show(done / iterations, f"loss {step.loss:.3e}")

    with asked_to_stop() as stop, progress_bar(f"training {stage.value}") as show, place_named(run_dir):
        run_training(
            stage.value,
            data=data,
            run_dir=run_dir,
            iterations=iterations,
            batch_size=batch_size,
            learning_rate=learning_rate,
            rows=rows,
            couplings=couplings,
            euler_steps=euler_steps,
            seed=seed,
            device=device,
            threads=threads,
            processes=processes,
            init=init,
            distance=distance,
            passed=passed or (),
            settled=settled,
            minutes=minutes,
            on_step=on_step,
            stop=stop,
        )
        if stop() and done < iterations:
            typer.echo(f"stopped after iteration {done} of {iterations}; the same command goes on from there", err=True)
            raise typer.Exit(INTERRUPTED)
        if not done:
            typer.echo(f"nothing to do: {run_dir} is at iteration {iterations} or beyond", err=True)


@app.command()
def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Check what this machine has: Python, torch, devices, kernels, weights, extras. Exits 4 if it cannot denoise."""
    from straightpcf.clients.doctor import examine

    findings, healthy = examine()
    print_json(findings) if as_json else print_table(findings)
    if not healthy:
        raise typer.Exit(4)


job_commands.install(app)


def _check_where(url: str | None, device: str, weights: Path | None, threads: int | None) -> None:
    if url is not None and (device != "auto" or weights is not None or threads is not None):
        raise errors.InvalidOptions("--device, --weights and --threads are for this process; the server has its own")


def _in_process(device: str, weights: Path | None, threads: int | None) -> Callable[..., Any]:
    """Load the filter and return what denoises one file with it."""
    with needs("model"):
        from straightpcf.model.filter import load_filter
        from straightpcf.service.backends.base import FileJob
        from straightpcf.service.backends.denoise_file import denoise_file

    denoiser = load_filter(weights, device=device, threads=threads)

    def run(source: Path, target: Path, name: str | None, format: str | None, wanted: Any) -> Any:
        with replaced_when_complete(target) as unfinished, progress_bar(f"denoising {name or 'stdin'}") as show:
            job = FileJob(
                id="cli", source=source, target=unfinished, options=wanted, max_points=sys.maxsize, name=name,
                format=format,
            )  # fmt: skip
            return denoise_file(denoiser, job, on_progress=lambda done, _: show(done))

    return run


@contextmanager
def _one_by_one(
    url: str | None, api_key: str | None, device: str, weights: Path | None, threads: int | None, wanted: Any
) -> Iterator[Callable[[Path, Path], Any]]:
    """Lend what denoises one file into another and returns the report."""
    if url is None:
        run = _in_process(device, weights, threads)
        yield lambda source, target: run(source, target, source.name, None, wanted)
        return
    asked = asdict(wanted)
    with job_commands.connect(url, api_key) as client:
        yield lambda source, target: client.denoise(source, target, **asked).report


def _describe(values: Any) -> str:
    return f"{values.dtype}" if values.ndim == 1 else f"{values.dtype} x {values.shape[1]}"


if __name__ == "__main__":
    main()
