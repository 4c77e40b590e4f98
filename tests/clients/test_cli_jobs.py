"""The commands that talk to a server, and the folder that is watched, as their users start them."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.clouds import noisy, sphere, torus
from tests.conftest import RunningServer, clean_environment
from tests.service.in_process import serving
from tests.service.test_races import play, willing
from tests.waiting import wait_for
from tests.warm import MODEL, SDK, run_warm

POINTS = 400
LARGE = 12_000  # ten passes over so many points take many seconds


def cli(
    server: RunningServer | None,
    *arguments: object,
    stdin: bytes = b"",
    stdout: int | None = None,
    stderr: int | None = None,
) -> subprocess.CompletedProcess[bytes]:
    environment = clean_environment() | ({} if server is None else {"STRAIGHTPCF_URL": server.url})
    loaded = MODEL if {"denoise", "watch"} & {*arguments} and "--url" not in arguments else SDK
    return run_warm(
        "straightpcf.clients.cli", *arguments, environment=environment, stdin=stdin, stdout=stdout, stderr=stderr,
        loaded=loaded,
    )  # fmt: skip


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    np.save(path := tmp_path / "scan.npy", noisy(torus(POINTS), 0.01).astype(np.float32))
    return path


def test_submit_wait_status_result_jobs_cancel(server: RunningServer, scan: Path) -> None:
    done = cli(server, "submit", scan, "--iterations", "1")
    assert done.returncode == 0, done.stderr
    id = done.stdout.decode().strip()
    assert cli(server, "wait", id).returncode == 0
    assert b"succeeded" in cli(server, "status", id).stdout
    job = json.loads(cli(server, "status", id, "--json").stdout)
    assert (job["id"], job["state"], job["name"]) == (id, "succeeded", "scan.npy")
    done = cli(server, "result", id, scan.with_name("clean.npy"))
    assert b"estimated noise" in done.stderr
    assert np.load(scan.with_name("clean.npy")).shape == (POINTS, 3)
    assert cli(server, "result", id, "-").stdout == scan.with_name("clean.npy").read_bytes()
    assert id in cli(server, "jobs").stdout.decode().splitlines()[0]
    long = "a" * 64  # the longest id there is
    cli(server, "submit", scan, "--iterations", "1", "--id", long)
    assert cli(server, "jobs").stdout.decode().split()[0] == long
    assert cli(server, "wait", long).returncode == 0
    assert json.loads(cli(server, "jobs", "--json", "--limit", 1).stdout)[0]["id"] == long
    assert cli(server, "cancel", id).stdout.decode() == f"{id} succeeded\n"


def test_a_job_that_fails_gives_wait_the_exit_code_of_its_error(server: RunningServer, tmp_path: Path) -> None:
    np.save(tmp_path / "few.npy", sphere(5))
    id = cli(server, "submit", tmp_path / "few.npy", "--id", "few").stdout.decode().strip()
    assert id == "few"
    done = cli(server, "wait", id)
    assert done.returncode == 3
    assert b"error [too_few_points]" in done.stderr
    assert b"failed" in done.stdout
    assert cli(server, "result", id, tmp_path / "x.npy").returncode == 3
    assert not (tmp_path / "x.npy").exists()


def test_what_goes_wrong_between_is_one_line_and_a_code(server: RunningServer, tmp_path: Path) -> None:
    np.save(tmp_path / "large.npy", noisy(sphere(LARGE), 0.01))
    for arguments, code, text in (
        (("status", "no-such-job"), 3, "not_found"),
        (("status", ""), 3, "not_found"),  # an unset $ID
        (("result", "no-such-job", "/dev/null"), 3, "/dev/null"),
        (("jobs", "--url", "http://127.0.0.1:80a0"), 2, "no address"),
        (("jobs", "--state", "gone"), 2, "invalid_options"),
        (("jobs", "--url", "ftp://x"), 2, "invalid_options"),
        (("denoise", tmp_path / "large.npy", tmp_path / "c.npy", "--url", server.url, "--device", "cpu"), 2, "device"),
        (("watch", tmp_path, "--once", "--url", server.url, "--threads", "1"), 2, "--threads"),
    ):
        done = cli(server, *arguments)
        assert (done.returncode, done.stderr.count(b"\n")) == (code, 1), done.stderr
        assert text in done.stderr.decode()
    id = cli(server, "submit", tmp_path / "large.npy", "--iterations", 10).stdout.decode().strip()
    assert cli(server, "wait", id, "--timeout", 0.2).returncode == 5
    assert cli(server, "cancel", id).stdout.decode() == f"{id} canceled\n"
    assert cli(server, "wait", id).returncode == 130


def test_of_several_what_fails_is_named_and_costs_the_others_nothing(server: RunningServer, scan: Path) -> None:
    missing = scan.with_name("missing.npy")
    done = cli(server, "submit", scan, missing, scan, "--iterations", 1)
    ids = done.stdout.decode().split()
    assert (done.returncode, len(ids)) == (3, 2)
    assert done.stderr.decode().startswith(f"{missing}: error [invalid_request]")
    done = cli(server, "cancel", "gone", *ids)
    assert (done.returncode, done.stdout.count(b"\n")) == (3, 2)
    assert done.stderr.startswith(b"gone: error [not_found]")
    done = cli(server, "submit", scan, scan, scan, "--iterations", "many")
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 2)
    assert b"the 2 after it were not tried" in done.stderr


def test_a_reader_that_goes_away_and_a_name_that_stdout_cannot_show_are_no_errors(
    server: RunningServer, tmp_path: Path
) -> None:
    np.save(tmp_path / "x.npy", noisy(torus(POINTS), 0.01))
    id = cli(server, "submit", tmp_path / "x.npy", "--name", "wölkchen 云.npy").stdout.decode().strip()
    line = f"{{ {sys.executable} -m straightpcf.clients.cli jobs; echo $? >&2; }} | true"
    environment = clean_environment() | {"STRAIGHTPCF_URL": server.url, "PYTHONIOENCODING": "latin-1"}
    done = subprocess.run(["/bin/sh", "-c", line], stderr=subprocess.PIPE, env=environment, check=False)
    assert done.stderr.strip() in (b"141", b"0")  # 0: it was done before
    command = [sys.executable, "-m", "straightpcf.clients.cli", "jobs"]
    shown = subprocess.run(command, capture_output=True, env=environment, check=True).stdout
    assert f"{id} ".encode() in shown
    assert "wölkchen \\u4e91.npy".encode("latin-1") in shown


def test_a_full_stdout_is_named_and_ends_what_it_cannot_tell_of(server: RunningServer, scan: Path) -> None:
    kept = cli(server, "submit", scan, "--iterations", 1).stdout.decode().strip()
    assert cli(server, "wait", kept).returncode == 0
    before = len(cli(server, "jobs").stdout.splitlines())
    said = b"error [invalid_request]: [Errno 28] No space left on device: 'stdout'\n"
    for arguments in (["submit", scan, scan, scan], ["result", kept, "-"], ["jobs"], ["status", kept, "--json"]):
        with Path("/dev/full").open("wb") as full:
            done = cli(server, *arguments, stdout=full.fileno())
        assert (done.returncode, done.stderr) == (3, said), arguments
    assert len(cli(server, "jobs").stdout.splitlines()) == before + 1  # of three that were to be submitted


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has /dev/full")
def test_what_stderr_does_not_take_changes_no_exit_code(scan: Path) -> None:
    done = ("denoise", scan, scan.with_name("out.npy"), "--iterations", 1, "--device", "cpu")
    reader, unread = os.pipe()
    os.close(reader)  # one that has ended
    with Path("/dev/full").open("wb") as full, os.fdopen(unread, "wb") as pipe:
        for arguments, code in ((done, 0), (("info", "missing.npy"), 3), (("frobnicate",), 2)):
            for stderr in (full, pipe):
                ended = cli(None, *arguments, stderr=stderr.fileno())
                assert ended.returncode == code, (arguments, stderr)


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_what_cannot_be_printed_before_a_command_ends_as_in_one(option: str) -> None:
    line = f"{{ {sys.executable} -m straightpcf.clients.cli {option}; echo $? >&2; }} | sleep 0"
    done = subprocess.run(
        ["/bin/sh", "-c", line], stderr=subprocess.PIPE, env=clean_environment(), check=False, timeout=60
    )
    assert done.stderr.strip() == b"141"
    line = f"{sys.executable} -m straightpcf.clients.cli {option} >/dev/full"
    done = subprocess.run(["/bin/sh", "-c", line], stderr=subprocess.PIPE, env=clean_environment(), check=False)
    assert (done.returncode, done.stderr.count(b"\n")) == (3, 1), done.stderr


@pytest.mark.parametrize("package", ["straightpcf", "straightpcf.clients"])
def test_the_console_script_runs_the_same(server: RunningServer, package: str) -> None:
    command = [sys.executable, "-m", package, "version"]
    assert subprocess.run(command, capture_output=True, check=True).stdout == cli(None, "version").stdout


def test_denoise_on_a_server_gives_the_bytes_of_this_process(server: RunningServer, scan: Path) -> None:
    here, there = scan.with_name("here.npy"), scan.with_name("there.npy")
    assert cli(None, "denoise", scan, here, "--iterations", 1, "--device", "cpu").returncode == 0
    done = cli(None, "denoise", scan, there, "--iterations", 1, "--url", server.url, "--json")
    assert json.loads(done.stdout)["points"] == POINTS
    assert here.read_bytes() == there.read_bytes()


@pytest.mark.parametrize("remote", [False, True])
def test_a_dash_is_stdin_and_stdout(server: RunningServer, scan: Path, remote: bool) -> None:
    where = ("--url", server.url) if remote else ("--device", "cpu")
    piped = cli(None, "denoise", "-", "-", "--iterations", 1, *where, stdin=scan.read_bytes())
    assert piped.returncode == 0, piped.stderr
    target = scan.with_name("clean.npy")
    cli(None, "denoise", scan, target, "--iterations", 1, *where)
    assert piped.stdout == target.read_bytes()
    as_text = cli(None, "denoise", "-", "-", "--iterations", 1, "--format", "xyz", *where, stdin=scan.read_bytes())
    assert len(as_text.stdout.splitlines()) == POINTS


@pytest.mark.parametrize("remote", [False, True])
def test_text_on_stdin_is_known_by_the_name_that_is_given(server: RunningServer, tmp_path: Path, remote: bool) -> None:
    np.savetxt(scan := tmp_path / "scan.xyz", noisy(torus(POINTS), 0.01))
    where = ("--url", server.url) if remote else ("--device", "cpu")
    target, piped = tmp_path / "clean.csv", tmp_path / "piped.csv"
    assert cli(None, "denoise", scan, target, "--iterations", 1, *where).returncode == 0
    assert b"," in target.read_bytes().splitlines()[0]
    named = ("--name", "a.xyz", "--iterations", 1)
    done = cli(None, "denoise", "-", piped, *named, *where, stdin=scan.read_bytes())
    assert done.returncode == 0, done.stderr
    assert piped.read_bytes() == target.read_bytes()
    done = cli(None, "denoise", "-", "-", *named, *where, stdin=scan.read_bytes())
    assert len(done.stdout.splitlines()) == POINTS
    assert b"," not in done.stdout
    done = cli(None, "denoise", "-", piped, *where, stdin=scan.read_bytes())
    assert (done.returncode, done.stderr.count(b"\n")) == (3, 1)
    assert b"error [unknown_format]: the cloud begins with" in done.stderr


@pytest.mark.parametrize(("closed", "arguments"), [("<&-", "- OUT.npy --name a.npy"), (">&-", "IN - --iterations 1")])
def test_a_stream_that_is_closed_is_an_error_of_one_line(scan: Path, closed: str, arguments: str) -> None:
    words = arguments.replace("IN", str(scan)).replace("OUT", str(scan.with_name("out")))
    line = f"{sys.executable} -m straightpcf.clients.cli denoise {words} {closed}"
    done = subprocess.run(["/bin/sh", "-c", line], stderr=subprocess.PIPE, env=clean_environment(), check=False)
    assert (done.returncode, done.stderr.count(b"\n")) == (3, 1)
    assert b"error [invalid_request]: std" in done.stderr


def test_a_result_is_not_called_what_it_is_not(server: RunningServer, tmp_path: Path) -> None:
    np.savetxt(scan := tmp_path / "scan.xyz", noisy(torus(POINTS), 0.01))
    id = cli(server, "submit", scan, "--iterations", 1).stdout.decode().strip()
    done = cli(server, "result", id, tmp_path / "r.ply")
    assert (done.returncode, done.stderr.count(b"\n")) == (3, 1)
    assert b"the result is xyz, and r.ply is a name for ply" in done.stderr
    assert list(tmp_path.iterdir()) == [scan]
    assert cli(server, "result", id, tmp_path / "r.txt").returncode == 0
    for where in (("--url", server.url), ("--device", "cpu")):
        done = cli(None, "denoise", scan, tmp_path / "r.ply", "--format", "npy", "--iterations", 1, *where)
        assert (done.returncode, done.stderr.count(b"\n")) == (3, 1)
        assert b"the result is npy, and r.ply is a name for ply" in done.stderr
        piped = cli(None, "denoise", scan, "-", "--format", "npy", "--iterations", 1, *where)
        assert piped.stdout.startswith(b"\x93NUMPY")


@pytest.mark.parametrize("remote", [False, True])
def test_the_suffix_of_the_target_says_what_is_written(server: RunningServer, tmp_path: Path, remote: bool) -> None:
    where = ("--url", server.url) if remote else ("--device", "cpu")
    rows = "".join(f"{x:f},{y:f},{z:f},tree\n" for x, y, z in noisy(torus(POINTS), 0.01))
    (scan := tmp_path / "scan.csv").write_text("x,y,z,kind\n" + rows)
    done = cli(None, "denoise", scan, tmp_path / "a.pcd", "--iterations", 1, *where)
    assert b"warning: pcd has no place for what else the csv file holds: kind" in done.stderr
    (tmp_path / "a.pcd").rename(misnamed := tmp_path / "a.ply")
    assert cli(None, "denoise", misnamed, tmp_path / "b.ply", "--iterations", 1, *where).returncode == 0
    assert (tmp_path / "b.ply").read_bytes().startswith(b"ply\n")


def test_submit_takes_text_from_stdin_with_its_name(server: RunningServer) -> None:
    text = b"".join(b"%f %f %f\n" % tuple(point) for point in noisy(torus(POINTS), 0.01))
    id = cli(server, "submit", "-", "--name", "piped.txt", "--iterations", 1, stdin=text).stdout.decode().strip()
    assert cli(server, "wait", id).returncode == 0
    assert json.loads(cli(server, "status", id, "--json").stdout)["name"] == "piped.txt"
    assert cli(server, "submit", "-", stdin=text).returncode == 3
    as_file = cli(server, "submit", "/dev/stdin", "--name", "p.txt", "--iterations", 1, stdin=text).stdout.decode()
    assert cli(server, "wait", as_file.strip()).returncode == 0
    assert cli(server, "submit", "a.xyz", "b.xyz", "--name", "c.xyz").returncode == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_denoise_that_is_ended_takes_its_job_along(server: RunningServer, tmp_path: Path, number: int) -> None:
    np.save(large := tmp_path / "large.npy", noisy(sphere(LARGE), 0.01))
    command = [sys.executable, "-m", "straightpcf.clients.cli", "denoise", str(large), str(tmp_path / "clean.npy")]
    command += ["--iterations", "10", "--url", server.url]
    process = subprocess.Popen(command, env=clean_environment(), stderr=subprocess.DEVNULL)
    wait_for(lambda: b"processing" in cli(server, "jobs").stdout)
    process.send_signal(number)
    assert process.wait(timeout=20) == 130
    assert cli(server, "jobs").stdout == b""
    assert list(tmp_path.iterdir()) == [large]


@pytest.mark.parametrize("pause", [0.0, 0.02, 0.2])
def test_a_second_ctrl_c_is_as_quiet_as_the_first(tmp_path: Path, pause: float) -> None:
    np.save(large := tmp_path / "large.npy", noisy(sphere(LARGE), 0.01))
    command = [sys.executable, "-m", "straightpcf.clients.cli", "denoise", str(large), str(tmp_path / "clean.npy")]
    command += ["--device", "cpu", "--threads", "1", "--iterations", "10"]
    with subprocess.Popen(command, env=clean_environment(), stderr=subprocess.PIPE) as process:
        try:
            wait_for(lambda: list(tmp_path.glob(".clean.*.part.npy")), seconds=60)
            time.sleep(0.5)
            while process.poll() is None:
                process.send_signal(signal.SIGINT)
                time.sleep(pause or 0.001)
        finally:
            process.kill()
        assert process.stderr is not None
        assert (process.returncode, process.stderr.read()) == (130, b"")
    assert list(tmp_path.iterdir()) == [large]


def test_a_key_that_no_header_can_carry_is_a_usage_error(server: RunningServer) -> None:
    done = cli(server, "jobs", "--api-key", "ключ")
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)
    assert b"error [invalid_options]" in done.stderr


def test_watch_once_does_what_is_there_and_tells_what_failed(scan: Path) -> None:
    np.save(scan.with_name("few.npy"), sphere(5))
    (scan.parent / "notes.md").write_text("no cloud")
    done = cli(None, "watch", scan.parent, "--once", "--iterations", 1, "--device", "cpu")
    assert done.returncode == 3
    assert b"few.npy: error [too_few_points]" in done.stderr
    assert sorted(path.name for path in (scan.parent / "clean").iterdir()) == ["scan.npy"]
    assert cli(None, "watch", scan.parent, "--once", "--to", scan.parent).returncode == 2


def test_watch_takes_what_comes_later_from_a_server(server: RunningServer, scan: Path, tmp_path: Path) -> None:
    (folder := tmp_path / "in").mkdir()
    log = tmp_path / "log"
    command = [sys.executable, "-m", "straightpcf.clients.cli", "watch", str(folder), "--iterations", "1"]
    with log.open("wb") as stderr:
        process = subprocess.Popen([*command, "--url", server.url], env=clean_environment(), stderr=stderr)
    try:
        (folder / "late.npy").write_bytes(scan.read_bytes())
        wait_for(lambda: b"late.npy: 400 points" in log.read_bytes(), seconds=60)
        assert np.load(folder / "clean" / "late.npy").shape == (POINTS, 3)
    finally:
        os.kill(process.pid, signal.SIGINT)
        process.wait(timeout=20)
    assert process.returncode == 130


@pytest.mark.parametrize("key", [(), ("--api-key", "beta")])
def test_watch_ends_where_a_server_does_not_take_its_key(scan: Path, key: tuple[str, ...]) -> None:
    """In one line, as `submit` does: to every file it would say the same, and none would be tried again."""
    scan.with_name("second.npy").write_bytes(scan.read_bytes())

    async def scenario() -> None:
        async with serving(scan.parent / "server", willing(), api_keys="alpha") as (_, host, port):
            done = await asyncio.to_thread(cli, None, "watch", scan.parent, "--url", f"http://{host}:{port}", *key)
            assert (done.returncode, done.stderr.count(b"\n")) == (3, 1), done.stderr
            assert done.stderr.startswith(b"error [unauthorized]: ")

    play(scenario)
    assert not any((scan.parent / "clean").iterdir())


def test_the_readme_downloads_a_result_with_curl_and_goes_on_with_half_of_it(server: RunningServer, scan: Path) -> None:
    readme = (Path(__file__).parents[2] / "README.md").read_text()
    (line,) = (line for line in readme.splitlines() if line.startswith("curl -C -"))
    id = cli(server, "submit", scan, "--iterations", 1).stdout.decode().strip()
    assert cli(server, "wait", id).returncode == 0
    command = line.replace("http://127.0.0.1:8000", server.url).replace("curl", "curl -sf", 1)
    clean = scan.with_name("clean.ply")
    for _ in range(2):
        subprocess.run(command, shell=True, check=True, cwd=scan.parent, env={**os.environ, "ID": id}, timeout=20)
        assert np.load(clean).shape == (POINTS, 3)
        clean.write_bytes(clean.read_bytes()[:1000])
