"""The command line, as its users start it."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import straightpcf
from straightpcf.clients.cli import app
from straightpcf.clients.console import EXIT_CODES, exit_code
from straightpcf.clients.doctor import EXTRAS
from straightpcf.model.kernels import cpu
from straightpcf.points.errors import (
    ERRORS_BY_CODE,
    DeviceUnavailable,
    InternalError,
    InvalidOptions,
    MissingDependency,
    ServerBusy,
)
from straightpcf.service.backends import worker
from straightpcf.service.backends.worker import WorkerSpec
from tests.clouds import noisy, sphere, torus
from tests.conftest import clean_environment, serve
from tests.warm import run_warm

POINTS = 400


def cli(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    done = run_warm("straightpcf.clients.cli", *arguments, environment=clean_environment())
    return subprocess.CompletedProcess(done.args, done.returncode, done.stdout.decode(), done.stderr.decode())


def cold_cli(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "straightpcf.clients.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=clean_environment(), timeout=120)


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    np.save(path := tmp_path / "scan.npy", noisy(torus(POINTS), 0.01).astype(np.float32))
    return path


def test_denoise_writes_the_same_points_and_reports_as_json(scan: Path) -> None:
    target = scan.with_name("clean.npy")
    done = cli("denoise", scan, target, "--iterations", "1", "--device", "cpu", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["points"], report["iterations"], report["format"]) == (POINTS, 1, "npy")
    result = np.load(target)
    assert (result.shape, result.dtype) == ((POINTS, 3), np.dtype(np.float32))
    assert not np.array_equal(result, np.load(scan))
    assert sorted(path.name for path in scan.parent.iterdir()) == ["clean.npy", "scan.npy"]


def test_an_error_is_one_line_with_its_code_and_leaves_the_old_result(tmp_path: Path) -> None:
    np.save(few := tmp_path / "few.npy", sphere(5))
    (target := tmp_path / "clean.npy").write_bytes(b"of old")
    done = cli("denoise", few, target)
    assert done.returncode == 3
    assert done.stderr.startswith("error [too_few_points]: ")
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert target.read_bytes() == b"of old"
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["denoise", "IN", "OUT.npy", "--iterations", "0"], 2, "error [invalid_options]"),
        (["denoise", "IN", "OUT.npy", "--seed", "1_000"], 2, "seed is '1_000'"),
        (["watch", ".", "--once", "--strength", "0_1"], 2, "strength is '0_1'"),
        (["submit", "IN", "--seed", "1_000"], 2, "seed is '1_000'"),
        (["denoise", "IN", "OUT.npy", "--device", "tpu"], 2, "tpu"),
        (["denoise", "IN", "OUT.npy", "--device", "cuda:99"], 4, "cuda:99"),
        (["watch", ".", "--once", "--device", "cuda:99"], 4, "cuda:99"),
        (["denoise", "IN"], 2, "OUT"),
        (["denoise", "IN", "OUT.gif"], 3, "error [unknown_format]"),
        (["denoise", "missing.npy", "OUT.npy"], 3, "missing.npy"),
        (["denoise", "IN", "no/such/folder/OUT.npy"], 3, "no/such/folder"),
        (["denoise", "IN", "."], 3, "is no file"),
        (["info", "missing.npy"], 3, "missing.npy"),
        (["frobnicate"], 2, "frobnicate"),
    ],
)
def test_exit_codes(arguments: list[str], code: int, text: str, scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(scan.parent)
    done = CliRunner().invoke(app, [str(scan) if word == "IN" else word for word in arguments])
    assert done.exit_code == code, done.output
    assert text in done.stderr


def test_a_result_that_could_not_be_written_is_refused_before_anything_is_filtered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("straightpcf.model.objects.begin", lambda *_: pytest.fail("it is filtered"))
    np.save(cloud := tmp_path / "a.npy", np.vstack([noisy(torus(POINTS), 0.01), np.full((1, 3), np.nan)]))
    done = CliRunner().invoke(app, ["denoise", str(cloud), str(tmp_path / "b.las"), "--device", "cpu"])
    assert (done.exit_code, done.stderr.split(":")[0]) == (3, "error [unsupported_cloud]")
    assert f"point {POINTS} is" in done.stderr


def test_every_error_has_an_exit_code() -> None:
    codes = {exit_code(kind("x")) for kind in ERRORS_BY_CODE.values()}
    assert codes <= {2, 3, 4, 5, 70, 130}
    chosen = (InvalidOptions, DeviceUnavailable, ServerBusy, InternalError)
    assert [exit_code(kind("x")) for kind in chosen] == [2, 4, 5, 70]
    assert exit_code(ZeroDivisionError()) == EXIT_CODES[-1][1] == 70


def test_a_device_that_is_not_here_is_exit_4(scan: Path) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    done = CliRunner().invoke(app, ["denoise", str(scan), str(scan.with_name("o.npy")), "--device", "cuda"])
    assert done.exit_code == 4
    assert "device_unavailable" in done.stderr


def test_serve_ends_with_exit_4_where_its_device_is_missing(tmp_path: Path) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    done = serve("--device", "cuda", "--data-dir", tmp_path)
    assert done.returncode == 4
    assert "error [device_unavailable]" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "incoming").iterdir())


def test_serve_warns_when_others_can_reach_it(tmp_path: Path) -> None:
    (taken := tmp_path / "file").write_bytes(b"")  # no folder: the server ends as soon as it has warned
    done = serve("--host", "0.0.0.0", "--data-dir", taken / "data")
    assert "NO API KEYS ARE SET and this server listens on 0.0.0.0" in done.stderr
    assert (done.returncode, "Traceback" in done.stderr) == (2, False)
    assert "data_dir" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("option", ["--port", "--grpc-port"])
def test_serve_says_that_its_port_is_taken_before_it_starts_anything(option: str, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        done = serve(option, port, "--device", "cpu", "--data-dir", tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"error [invalid_options]: {option[2:].replace('-', '_')} is {port}")
    assert "Started server process" not in done.stderr


@pytest.mark.parametrize("host", ["no.such.host", "192.0.2.1", ".."])  # no name, another machine's, none at all
def test_serve_says_that_its_host_is_none_of_this_machine_before_it_starts_anything(host: str, tmp_path: Path) -> None:
    done = serve("--host", host, "--grpc-port", "0", "--data-dir", tmp_path)
    assert done.returncode == 2
    assert f"host is {host!r}, where this machine cannot listen: " in done.stderr.replace("\n", "")
    assert "Started server process" not in done.stderr


def test_info_describes_a_file(scan: Path) -> None:
    xyz = np.load(scan)
    xyz[7] = np.nan
    np.save(scan, xyz)
    done = CliRunner().invoke(app, ["info", str(scan), "--json"])
    facts = json.loads(done.stdout)
    assert (facts["format"], facts["points"], facts["invalid_rows"]) == ("npy", POINTS, 1)
    np.testing.assert_allclose(facts["min"], np.nanmin(xyz, axis=0))
    assert "npy" in CliRunner().invoke(app, ["info", str(scan)]).stdout


def test_version_starts_without_torch_or_a_server() -> None:
    done = cold_cli("version")
    assert done.stdout.strip() == straightpcf.__version__
    code = "import sys, straightpcf.clients.cli; print({'torch', 'fastapi', 'numpy', 'httpx2'} & set(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert loaded.stdout.strip() == "set()"


def test_doctor_tells_what_is_here() -> None:
    done = CliRunner().invoke(app, ["doctor", "--json"])
    findings = json.loads(done.stdout)
    assert {"python", "extras"} <= set(findings)
    assert done.exit_code == (4 if "problem" in findings else 0)


def test_doctor_says_why_there_are_no_kernels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    if cpu._SHIPPED.is_dir():
        pytest.skip("the kernels are shipped here")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))  # no compiler
    cpu.load.cache_clear()
    try:
        done = CliRunner().invoke(app, ["doctor", "--json"])
    finally:
        cpu.load.cache_clear()
    assert "no C++ compiler: install g++" in json.loads(done.stdout)["kernels"]


def test_a_torch_that_cannot_be_loaded_is_named_wherever_it_is_wanted(
    scan: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "torch.py").write_text("raise ImportError('libcudart.so.12: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    for module in ("torch", "straightpcf.model.filter"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    said = "what straightpcf[model] brings cannot be loaded: libcudart.so.12: cannot open shared object file"
    done = CliRunner().invoke(app, ["doctor", "--json"])
    assert (done.exit_code, json.loads(done.stdout)["problem"]) == (4, said)
    done = CliRunner().invoke(app, ["denoise", str(scan), str(tmp_path / "clean.npy")])
    assert (done.exit_code, done.stderr) == (4, f"error [missing_dependency]: {said}\n")
    with pytest.raises(MissingDependency) as caught:  # which ends the server, as a device that is not here does
        worker._load(WorkerSpec(device="cpu", weights=None, threads=1))
    assert caught.value.message == said
    monkeypatch.setitem(sys.modules, "torch", None)
    done = CliRunner().invoke(app, ["doctor", "--json"])
    assert json.loads(done.stdout)["problem"] == "torch is not installed; pip install 'straightpcf[model]' brings it"
    with pytest.raises(MissingDependency, match="torch is not installed"):
        worker._load(WorkerSpec(device="cpu", weights=None, threads=1))


def test_doctor_looks_for_what_pyproject_asks_for() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        names = [re.split(r"[<>=;\s\[]", text)[0] for text in extras[extra]]
        assert packages == tuple(name for name in names if name != "straightpcf")
    assert set(EXTRAS) == set(extras) - {"train", "benchmarks", "dev"}


def test_train_runs_a_stage_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    data, run = tmp_path / "shapes.npz", tmp_path / "run"
    np.savez(data, **{f"shape{i:02d}/1500": torus(1500, i).astype(np.float32) for i in range(11)})
    for iterations, said in (("1", ""), ("2", ""), ("1", f"nothing to do: {run} is at iteration 1 or beyond\n")):
        options = ("--iterations", iterations, "--batch-size", "2", "--rows", "16")
        done = cli("train", "vm", "--data", data, "--run-dir", run, *options)
        assert (done.returncode, done.stderr) == (0, said)
    rows = (run / "log.csv").read_text().splitlines()
    assert [row.split(",")[:2] for row in rows[1:]] == [["vm", "1"], ["vm", "2"]]


@pytest.mark.parametrize("processes", [1, 2])
def test_an_interrupted_training_saves_what_it_has_and_says_so(processes: int, tmp_path: Path) -> None:
    data, run = tmp_path / "shapes.npz", tmp_path / "run"
    np.savez(data, **{f"shape{i:02d}/1000": torus(1000, i).astype(np.float32) for i in range(6)})
    options = ("--batch-size", 2, "--rows", 16, "--threads", 1, "--processes", processes)
    done = run_warm(
        "tests.clients.interrupted_training", "train", "vm", "--data", data, "--run-dir", run, *options,
        environment=clean_environment(),
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (130, b""), done.stderr
    assert done.stderr == b"stopped after iteration 2 of 20000; the same command goes on from there\n"
    assert (run / "log.csv").read_text().splitlines()[1].startswith("vm,2,")
    assert (run / "state.safetensors").is_file()


@pytest.mark.parametrize(
    ("arrays", "arguments", "code", "text"),
    [
        ({"a": torus(1500)}, [], 3, "malformed_file"),
        ({"a/1": torus(500)}, [], 3, "too_few_points"),
        ({"a/1": torus(1500)}, ["--device", "cuda:99"], 4, "device_unavailable"),
        ({"a/1": torus(1500)}, ["--seed", "9223372036854775808"], 2, "--seed"),
    ],
)
def test_training_refuses_what_it_cannot_use_by_code(
    arrays: dict[str, np.ndarray], arguments: list[str], code: int, text: str, tmp_path: Path
) -> None:
    np.savez(data := tmp_path / "shapes.npz", **arrays)
    command = ["train", "vm", "--data", str(data), "--run-dir", str(tmp_path / "run"), *arguments]
    done = CliRunner().invoke(app, command)
    assert (done.exit_code, text in done.stderr) == (code, True), done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has /dev/full")
def test_a_log_that_finds_no_room_is_told_with_the_place(tmp_path: Path) -> None:
    np.savez(data := tmp_path / "shapes.npz", **{f"{name}/1500": torus(1500) for name in "abcdef"})  # type: ignore[arg-type]
    (run := tmp_path / "run").mkdir()
    (run / "log.csv").symlink_to("/dev/full")
    done = cli(
        "train", "vm", "--data", data, "--run-dir", run, "--iterations", "1", "--batch-size", "1", "--rows", "16"
    )
    assert done.returncode == 3
    assert done.stderr == f"error [invalid_request]: [Errno 28] No space left on device: '{run}'\n"


def test_a_stage_without_the_one_before_is_a_usage_error(tmp_path: Path) -> None:
    np.savez(data := tmp_path / "shapes.npz", **{"a/1500": torus(1500).astype(np.float32)})
    done = cli("train", "cvm", "--data", data, "--run-dir", tmp_path / "run")
    assert done.returncode == 2
    assert "init" in done.stderr
