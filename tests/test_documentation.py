"""Commands that the documentation tells people to type."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer.main
from typer.core import TyperGroup

from straightpcf.clients.cli import app

ROOT = Path(__file__).parents[1]
GUIDES = ("README.md", "CONTRIBUTING.md", "benchmarks/RESULTS.md", "model/weights/README.md", *sorted(
    str(path.relative_to(ROOT)) for path in (ROOT / "docs").glob("*.md")
))  # fmt: skip
# What is between backticks or on a line of its own, without a remark behind it.
OURS = re.compile(r"(?:^|[`/]|; )straightpcf ([a-z][^`\n#;]*)", re.MULTILINE)
BENCHMARKS = re.compile(r"python -m benchmarks\.(\w+)([^`\n#]*)")


def of_guides(pattern: re.Pattern[str], guides: tuple[str, ...]) -> list[tuple[str, ...]]:
    found = {match for guide in guides for match in pattern.findall((ROOT / guide).read_text())}
    return sorted(match if isinstance(match, tuple) else (match,) for match in found)


@pytest.mark.parametrize("command", [command for (command,) in of_guides(OURS, GUIDES[:2] + GUIDES[3:])])
def test_the_command_line_takes_what_the_guides_say(command: str) -> None:
    name, *arguments = ["1" if word == "N" else word for word in shlex.split(command)]
    group = typer.main.get_command(app)
    assert isinstance(group, TyperGroup)
    one = group.commands[name]
    if "|" in command or not arguments:  # a sketch
        return
    with one.make_context(name, arguments, parent=group.make_context("straightpcf", [name])) as context:
        assert context.params


@pytest.mark.parametrize(("name", "arguments"), of_guides(BENCHMARKS, GUIDES))
def test_a_benchmark_has_the_options_that_the_guides_say(name: str, arguments: str) -> None:
    source = (ROOT / "benchmarks" / f"{name}.py").read_text()
    for option in re.findall(r"--[a-z][a-z-]*", arguments):
        assert f'"{option}"' in source, option
