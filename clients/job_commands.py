"""The commands that talk to a server about jobs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from straightpcf.clients.atomic import check_target
from straightpcf.clients.console import (
    for_each,
    interruptible,
    print_json,
    print_table,
    progress_bar,
    say,
    show_noise,
    to_stdout,
)
from straightpcf.clients.stdio import STDIO, content_of, given_path, input_name, is_stream, stdout
from straightpcf.points.errors import InvalidOptions

if TYPE_CHECKING:
    from straightpcf.clients.sdk import Client, JobInfo

__all__ = ["Format", "Iterations", "Key", "Name", "Normals", "Seed", "Strength", "connect", "install"]

DEFAULT_URL = "http://127.0.0.1:8000"

Url = Annotated[str, typer.Option("--url", envvar="STRAIGHTPCF_URL", metavar="URL", help="Where the server is.")]
Key = Annotated[str | None, typer.Option("--api-key", envvar="STRAIGHTPCF_KEY", help="A key of the server.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Id = Annotated[str, typer.Argument(metavar="ID", help="The job.")]
Iterations = Annotated[str, typer.Option(metavar="auto|N", help="Passes of the filter.")]
Seed = Annotated[str, typer.Option(metavar="INTEGER", help="The same seed gives the same bytes.")]
Strength = Annotated[str, typer.Option(metavar="FLOAT", help="0..1, the share of the displacement to apply.")]
Normals = Annotated[str, typer.Option(metavar="keep|recompute", help="Of a PLY, PCD or E57 file that has some.")]
Format = Annotated[str | None, typer.Option("--format", help="Of the result (ply, xyz, ...); else the input's.")]
Name = Annotated[str | None, typer.Option("--name", help="What the input is called; text on stdin needs a suffix.")]


def install(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    for command in (submit, status, wait, cancel, jobs, result):
        app.command()(command)


@contextmanager
def connect(url: str, api_key: str | None) -> Iterator[Client]:
    """Open a client."""
    from straightpcf.clients.sdk import Client

    with interruptible(), Client(url, api_key=api_key) as client:
        yield client


def submit(
    sources: Annotated[
        list[Path], typer.Argument(metavar="FILE", parser=given_path, help="The noisy clouds; - for stdin.")
    ],
    iterations: Iterations = "auto",
    seed: Seed = "0",
    strength: Strength = "1.0",
    normals: Normals = "keep",
    format: Format = None,
    name: Name = None,
    id: Annotated[str | None, typer.Option(help="A name for the job, to make it only once.")] = None,
    url: Url = DEFAULT_URL,
    api_key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Hand clouds to a server and print their jobs' ids; the jobs outlive this command."""
    from straightpcf.points.options import DenoiseOptions

    if id is not None and len(sources) > 1:
        raise InvalidOptions(f"--id names one job, and there are {len(sources)} files")
    if name is not None and len(sources) > 1:
        raise InvalidOptions(f"--name is of one file, and there are {len(sources)}")
    with connect(url, api_key) as client:

        def hand_over(source: Path) -> None:
            wanted = DenoiseOptions.parse(iterations=iterations, seed=seed, strength=strength, normals=normals)
            content: Any = content_of(source) if is_stream(source) else source
            job = client.jobs.create(content, **asdict(wanted), format=format, name=name or input_name(source), id=id)
            print_json(job.info.json) if as_json else say(job.id)

        for_each(sources, hand_over)


def status(id: Id, url: Url = DEFAULT_URL, api_key: Key = None, as_json: AsJson = False) -> None:
    """Show a job."""
    with connect(url, api_key) as client:
        _show(client.jobs.get(id).info, as_json)


def wait(
    id: Id,
    timeout: Annotated[float | None, typer.Option(min=0, help="Seconds; exit 5 when they are over.")] = None,
    url: Url = DEFAULT_URL,
    api_key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Wait for a job's end; the exit code tells how it ended."""
    with connect(url, api_key) as client, progress_bar(id) as show:
        info = client.jobs.get(id).wait(timeout=timeout, on_progress=show)
    _show(info, as_json)
    if info.failure is not None:
        raise info.failure


def cancel(
    ids: Annotated[list[str], typer.Argument(metavar="ID")],
    url: Url = DEFAULT_URL,
    api_key: Key = None,
) -> None:
    """End jobs that wait or run."""
    with connect(url, api_key) as client:
        for_each(ids, lambda id: say(f"{id} {client.jobs.get(id).cancel().state}"))


def jobs(
    state: Annotated[list[str] | None, typer.Option(help="Only these; may be repeated.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="How many, newest first.")] = 20,
    url: Url = DEFAULT_URL,
    api_key: Key = None,
    as_json: AsJson = False,
) -> None:
    """List jobs, newest first."""
    from straightpcf.clients.sdk.job_info import STATES

    if unknown := set(state or ()) - set(STATES):
        raise InvalidOptions(f"--state is {min(unknown)!r}; it must be one of {', '.join(STATES)}")
    with connect(url, api_key) as client:
        found = client.jobs.list(states=state or (), page_size=min(limit, 200))  # type: ignore[arg-type]
        infos = [job.info for _, job in zip(range(limit), found, strict=False)]
    if as_json:
        print_json([info.json for info in infos])
        return
    for info in infos:
        points = "" if info.points is None else f"{info.points:,} points"
        when = info.created_at.astimezone().strftime("%Y-%m-%d %H:%M:%S")
        say(f"{info.id:<32}  {info.state:<12}{info.progress:>5.0%}  {when}  {info.name or '-'}  {points}".rstrip())


def result(
    id: Id,
    target: Annotated[Path, typer.Argument(metavar="OUT", parser=given_path, help="Where to write it; - for stdout.")],
    url: Url = DEFAULT_URL,
    api_key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Wait for a job and download its result, whole and checked."""
    out = stdout() if target == STDIO else None
    if out is None:
        check_target(target)
    with connect(url, api_key) as client, progress_bar(id) as show:
        job = client.jobs.get(id)
        if not job.info.finished:
            job.wait(on_progress=show)
        found = job.result(target if out is None else None)
        if out is not None:
            with to_stdout():
                out.write(found.read())
                out.flush()  # before it is said to be done
    if as_json and out is None:
        print_json(found.job.json["report"])
    else:
        show_noise(target, found.report)


def _show(info: JobInfo, as_json: bool) -> None:
    if as_json:
        print_json(info.json)
        return
    facts: dict[str, Any] = {"job": info.id, "state": info.state, "progress": f"{info.progress:.0%}"}
    facts |= {"name": info.name, "points": info.points, "position": info.position, "attempts": info.attempts}
    if info.report is not None:
        facts |= {
            "passes": info.report.iterations,
            "noise": f"{info.report.noise_before:.4g} -> {info.report.noise_after:.4g}",
            "seconds": f"{info.report.seconds:.1f}",
        }
    if info.failure is not None:
        facts["error"] = f"[{info.failure.code}] {info.failure.message}"
    print_table({name: value for name, value in facts.items() if value is not None})
