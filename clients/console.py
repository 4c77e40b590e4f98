"""What the command line shows and how it ends: progress on stderr, tables and JSON on stdout, one line for an error.

Exit codes: 0 done, 2 usage (a port that is taken, too), 3 refused (bad input, no such job), 4 a device or a package is
missing, 5 busy, unreachable or not finished, 70 our fault, 130 interrupted (by SIGTERM or SIGHUP, too) or canceled,
141 who read stdout is gone.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from types import FrameType
from typing import Any, TypeVar

import typer

from straightpcf.clients.atomic import place_named
from straightpcf.points import errors

__all__ = [
    "EXIT_CODES",
    "INTERRUPTED",
    "READER_GONE",
    "asked_to_stop",
    "complain",
    "ended_in_a_line",
    "exit_code",
    "for_each",
    "forgive",
    "interruptible",
    "needs",
    "print_json",
    "print_table",
    "progress_bar",
    "quiet_end",
    "say",
    "show_noise",
    "to_stdout",
]

INTERRUPTED = 130
TIDY_SECONDS = 1.0
_STDOUT = "stdout"
READER_GONE = 141  # as of a process that SIGPIPE ends
_T = TypeVar("_T")
_OF_ALL = (errors.InvalidOptions, errors.Unauthorized, errors.ServerBusy, errors.ConnectionFailed)

# The first class that matches counts: the narrow ones come before those that hold them.
EXIT_CODES: tuple[tuple[type[Exception], int], ...] = (
    (errors.InvalidOptions, 2),
    (errors.MissingDependency, 4),
    (errors.DeviceUnavailable, 4),
    (ModuleNotFoundError, 4),
    (errors.ServerBusy, 5),
    (errors.ConnectionFailed, 5),
    (errors.RequestTimeout, 5),
    (errors.JobNotFinished, 5),
    (errors.JobCanceled, INTERRUPTED),
    (errors.InternalError, 70),
    (errors.StraightPCFError, 3),
    (OSError, 3),  # a file that is not there, or may not be written
    (Exception, 70),
)


def exit_code(error: Exception) -> int:
    """Return the exit code of an error."""
    return next(code for kind, code in EXIT_CODES if isinstance(error, kind))


def for_each(items: Sequence[_T], act: Callable[[_T], object]) -> None:
    """Do the same with each; of several, one that fails is said with its name, and costs the others nothing.

    Exits with the code of the first failure. What would happen to all others, too, ends it at once.
    """
    code = 0
    for number, item in enumerate(items, 1):
        try:
            act(item)
        except (errors.StraightPCFError, OSError) as error:
            if len(items) == 1 or _is_of_stdout(error):
                raise
            complain(error, of=item)
            code = code or exit_code(error)
            if isinstance(error, _OF_ALL):
                typer.echo(f"the {len(items) - number} after it were not tried", err=True)
                break
    if code:
        raise typer.Exit(code)


def _is_of_stdout(error: Exception) -> bool:
    """Tell whether what is done could not be told: nothing more is to be done then."""
    return isinstance(error, BrokenPipeError) or getattr(error, "filename", None) == _STDOUT


def complain(error: Exception, *, of: object = None) -> None:
    """Say on stderr, in one line, what is wrong; of: with which of several files or jobs."""
    if isinstance(error, errors.StraightPCFError):
        code, text = error.code, error.message
    elif isinstance(error, OSError):
        code, text = errors.InvalidRequest.code, str(error)
    else:
        code, text = errors.InternalError.code, f"{type(error).__name__}: {error} (--traceback shows where)"
    where = "" if of is None else f"{of}: "
    typer.echo(f"{where}error [{code}]: {' '.join(text.split())}", err=True)


@contextmanager
def ended_in_a_line(options: Mapping[str, Any]) -> Iterator[None]:
    """End an error in one line and its exit code; options: with `traceback` it is raised as it is."""
    try:
        yield
    except (typer.Exit, typer.Abort):
        raise
    except BrokenPipeError as error:
        _forget_stdout()
        raise typer.Exit(READER_GONE) from error
    except Exception as error:
        if hasattr(error, "show") or options.get("traceback"):  # a usage error shows itself
            raise
        complain(error)
        raise typer.Exit(exit_code(error)) from error


def _forget_stdout() -> None:
    """Write nothing more to a stdout that nobody reads, so that what is left in its buffer is no error at the end."""
    import os

    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def forgive(name: str) -> None:
    """Let what stdout or stderr does not take be lost: a full disk under a log, a terminal or reader that is gone.

    It then changes nothing of what is done. name: as in `sys`.
    """
    import io

    class Forgiving(io.FileIO):
        def write(self, data: Any, /) -> int:
            written = None
            with suppress(OSError):
                written = super().write(data)  # None: it does not block, and is full
            return len(memoryview(data).cast("B")) if written is None else written

    if (stream := getattr(sys, name)) is None:
        return
    stream.flush()
    buffer = io.BufferedWriter(Forgiving(stream.fileno(), "w", closefd=False))
    setattr(sys, name, io.TextIOWrapper(buffer, stream.encoding, "backslashreplace", line_buffering=True))


@contextmanager
def needs(extra: str) -> Iterator[None]:
    """Name the extra that brings what an import inside misses, or cannot load."""
    try:
        yield
    except ImportError as exc:
        raise errors.MissingDependency.of(extra, exc) from exc


@contextmanager
def interruptible() -> Iterator[None]:
    """Take SIGTERM, and a terminal that is closed, for Ctrl-C, so that what was begun here and on a server is ended.

    Another one is heeded after a while: an impatient one would keep what is done at an end from being done.
    """

    def interrupt() -> None:
        raise KeyboardInterrupt

    with _interruptions(interrupt):
        yield


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Say whether an interruption, as of `interruptible`, wants work to end at its next good moment, where it asks.

    Before it has asked for the first time there is nothing to save: it ends at once, as with another interruption.
    """
    asking = asked = False

    def interrupt() -> None:
        nonlocal asked
        if asked or not asking:
            raise KeyboardInterrupt
        asked = True

    def stop() -> bool:
        nonlocal asking
        asking = True
        return asked

    with _interruptions(interrupt):
        yield stop


@contextmanager
def _interruptions(obey: Callable[[], None]) -> Iterator[None]:
    import signal
    import time

    obeyed = -math.inf

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal obeyed
        if time.monotonic() - obeyed > TIDY_SECONDS:
            obeyed = time.monotonic()
            obey()

    ends = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # Windows has none; nohup
        ends.append(signal.SIGHUP)
    before = {number: signal.signal(number, interrupt) for number in ends}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def quiet_end() -> Iterator[None]:
    """Let a Ctrl-C, while one before it was obeyed or after the command, end the process without a traceback."""
    import atexit
    import os
    import signal

    # At the very end: Python then gives signals back to the system, which would end this with another code.
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    finally:
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(INTERRUPTED))


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[..., None]]:
    """Draw on stderr, where that is a terminal; show(fraction, note) moves the bar."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(title, total=1.0, note="")

        def show(fraction: float, note: str = "") -> None:
            progress.update(task, completed=fraction, note=note)

        yield show


def to_stdout() -> AbstractContextManager[None]:
    """Name stdout in the error of a write to it that finds no room."""
    return place_named(_STDOUT)


def say(text: str) -> None:
    """Print a line on stdout."""
    with to_stdout():
        typer.echo(text)


def print_json(value: Any) -> None:
    """Print a value, or a dataclass, on stdout."""
    facts = dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
    say(json.dumps(facts, indent=2, default=str))


def print_table(facts: dict[str, Any]) -> None:
    """Print names and values, a line each, on stdout."""
    for name, value in facts.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key} ({text})" for key, text in value.items()) or "none"
        say(f"{name.replace('_', ' '):<14}{value}")


def show_noise(target: object, report: Any) -> None:
    """Sum up on stderr what was done; report: of the SDK or of a worker, they have the same names."""
    for warning in report.warnings:
        typer.echo(f"warning: {warning}", err=True)
    passes = "1 pass" if report.iterations == 1 else f"{report.iterations} passes"
    typer.echo(
        f"{target}: {report.points} points, {passes}, estimated noise "
        f"{report.noise_before:.4g} -> {report.noise_after:.4g}, {report.seconds:.1f} s",
        err=True,
    )
