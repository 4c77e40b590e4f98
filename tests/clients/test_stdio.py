"""Input that is no file: stdin, and pipes of every kind."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from straightpcf.clients.cli import app
from straightpcf.clients.stdio import STDIO, content_of, given_path, input_file, input_name, is_stream
from straightpcf.points.errors import UnknownFormat
from tests.clouds import torus

TABLE = b"1 2 3\n4 5 6\n" * 50_000  # more than a pipe holds


@contextmanager
def named_pipe(path: Path, content: bytes) -> Iterator[Path]:
    os.mkfifo(path)
    writer = threading.Thread(target=path.write_bytes, args=(content,))
    writer.start()
    yield path
    writer.join()


def test_a_named_pipe_is_read_once_from_its_beginning(tmp_path: Path) -> None:
    with named_pipe(tmp_path / "scan.xyz", TABLE) as pipe:
        assert (is_stream(pipe), input_name(pipe)) == (True, "scan.xyz")
        with input_file(pipe, "scan.xyz") as path:
            assert path.read_bytes() == TABLE
        assert not path.exists()
    with named_pipe(tmp_path / "again.xyz", TABLE) as pipe:
        assert content_of(pipe) == TABLE


def test_info_reads_pipes_and_stdin(tmp_path: Path) -> None:
    np.save(cloud := tmp_path / "cloud", torus(50))
    content = cloud.with_suffix(".npy").read_bytes()
    with named_pipe(tmp_path / "pipe", content) as pipe:
        piped = CliRunner().invoke(app, ["info", str(pipe), "--json"])
    given = CliRunner().invoke(app, ["info", "-", "--json"], input=content)
    for done in (piped, given):
        facts = json.loads(done.stdout)
        assert (facts["format"], facts["points"]) == ("npy", 50), done.stderr
    named = CliRunner().invoke(app, ["info", "-", "--name", "a.xyz", "--json"], input=TABLE)
    assert json.loads(named.stdout)["points"] == 100_000


def test_a_file_that_is_called_a_dash_is_read_and_written_by_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "cloud.npy", torus(50))
    (tmp_path / "cloud.npy").rename(tmp_path / "-")
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["info", "./-", "--json"], input=TABLE)
    assert json.loads(done.stdout)["points"] == 50, done.stderr
    assert [given_path(text) for text in ("-", "./-", "./a.ply")] == [STDIO, tmp_path / "-", Path("a.ply")]


def test_the_number_of_a_pipe_is_no_name(tmp_path: Path) -> None:
    """As of <(zcat scan.ply.gz), which a shell calls /dev/fd/63."""
    reading, writing = os.pipe()
    os.write(writing, b"1 2 3\n")
    os.close(writing)
    pipe = Path(f"/dev/fd/{reading}")
    assert (is_stream(pipe), input_name(pipe), input_name(STDIO)) == (True, None, None)
    with pytest.raises(UnknownFormat, match="so it needs a name"), input_file(pipe, input_name(pipe)):
        pass
    os.close(reading)


def test_a_folder_and_what_is_not_there_are_said_to_be_that(tmp_path: Path) -> None:
    for path, text in ((tmp_path, "is a folder"), (tmp_path / "no.ply", "is no file")):
        assert not is_stream(path)
        with pytest.raises(FileNotFoundError, match=text), input_file(path, None):
            pass
