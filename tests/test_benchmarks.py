"""The benchmarks' commands run: their figures are asserted where they are taken, here only that they are."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from benchmarks import scenes
from benchmarks.command import noise_level
from straightpcf.model.checkpoint import read_checkpoint
from straightpcf.model.filter import DEFAULT_WEIGHTS
from straightpcf.model.kernels import cpu
from tests.clouds import sphere
from tests.warm import run_warm

Refused = Callable[..., tuple[int, str]]


def printed(name: str, *arguments: object) -> str:
    ended = _run(name, *arguments)
    assert ended.returncode == 0, ended.stderr.decode()
    return ended.stdout.decode()


def _run(name: str, *arguments: object) -> subprocess.CompletedProcess[bytes]:
    return run_warm(f"benchmarks.{name}", *arguments, environment=os.environ)


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
    """Run a command that ends before its work, here; return its exit code and what it says on stderr."""

    def run(name: str, *arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            import_module(f"benchmarks.{name}").main()
        said, code = capsys.readouterr(), ended.value.code
        if isinstance(code, str):  # which Python prints, and exits with 1
            return 1, said.err + code
        return int(code or 0), said.err

    return run


def test_quality(tmp_path: Path) -> None:
    options = ("--split", "validation", "--shapes", "sphere", "--resolution", 1000, "--noise", 0.02, "--iterations", 1)
    said = printed("quality", *options, "--threads", 1, "--model", "noisy", "ours", "--json", tmp_path / "rows.json")
    noisy, row = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert 0 < row["cd"] < row["noisy_cd"] == noisy["cd"]
    table = [line.split() for line in said.splitlines()[-2:]]
    for line, of in zip(table, (noisy, row), strict=True):
        assert line == [of["model"], f"{of['cd']:.3f}", "/", f"{of['p2m']:.3f}"]


def test_quality_of_every_pass(tmp_path: Path) -> None:
    options = ("--split", "validation", "--shapes", "sphere", "--resolution", 500, "--noise", 0.02, "--threads", 1)
    rows = []
    for more in ((), ("--every-pass",)):
        printed("quality", *options, *more, "--json", tmp_path / "rows.json")
        rows += json.loads((tmp_path / "rows.json").read_text())["rows"]
    auto, cut = rows
    assert (cut["iterations"], cut["cd"], cut["p2m"]) == (auto["iterations"], auto["cd"], auto["p2m"])
    assert cut["every"][auto["iterations"] - 1] == [auto["cd"], auto["p2m"]]
    assert len(cut["every"]) == 5


def test_conditions() -> None:
    said = printed("conditions", "half-1-3", "cut", "--shapes", "sphere", "--resolution", 1500, "--threads", 1)
    half, _, cut, mean = said.splitlines()
    assert "louder" in half
    assert cut.split(maxsplit=4)[-1] == mean.split(maxsplit=2)[-1]
    assert "WORSE" not in said


def test_views(tmp_path: Path) -> None:
    across = np.linspace(-0.6, 0.6, 50)
    x, y = (each.ravel() for each in np.meshgrid(across, across))
    clean = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=1)
    ball = {"points": clean, "surface": sphere(20_000), "eye": np.array([0.0, 0.0, 9.0])}
    ball["normals"] = ball["surface"] / np.linalg.norm(ball["surface"], axis=1, keepdims=True)
    np.savez(tmp_path / "scans.npz", **{f"ball/{name.replace('points', '2500')}": each for name, each in ball.items()})
    said = printed("views", tmp_path / "scans.npz", "--noise", 0.02, "--threads", 1)
    row, mean = said.splitlines()
    assert row.split(maxsplit=2)[2] == mean.split(maxsplit=2)[2]  # no NO VIEW
    before, after = (float(value) for value in mean.split("truth")[1].split(",")[0].split("->"))
    assert after < 0.5 * before
    assert before == pytest.approx(200, rel=0.1)


def test_views_of_an_archive_without_an_eye_are_refused(refused: Refused, tmp_path: Path) -> None:
    np.savez(tmp_path / "solids.npz", **{"solid000/2500": sphere(2500)})
    code, said = refused("views", tmp_path / "solids.npz")
    assert (code, "no scan with an eye" in said) == (1, True)


def test_speed() -> None:
    said = printed("speed", "--shape", "sphere", "--resolution", 1000, "--patches", 1, "--threads", 1)
    ours, theirs = (
        next(line for line in said.splitlines() if line.startswith(name)).split()
        for name in ("this project", "authors' scheme")
    )
    assert 0 < float(ours[2]) < float(theirs[2])
    assert float(said.split("ratio")[1]) > 1


def test_picture(tmp_path: Path) -> None:
    said = printed("picture", tmp_path / "picture.png", "--points", 2000, "--every", 50, "--threads", 1)
    body, filtered, room, filtered_room = (float(line.split(": ")[1].split()[0]) for line in said.splitlines())
    assert filtered < body / 2
    assert filtered_room < room
    drawn = imread(tmp_path / "picture.png")[..., :3]
    assert 0.05 < (drawn.min(axis=2) < 0.9).mean() < 0.9


def test_scaling() -> None:
    rows = [line.split() for line in printed("scaling", "--points", 500, 1000, "--threads", 1).splitlines()[2:]]
    assert [row[0] for row in rows] == ["500", "1000"]


def test_passes(tmp_path: Path) -> None:
    clouds = {f"{name}/1000": sphere(1000) for name in "abcde"}
    # The one held out, of fewer points than it is named by.
    clouds |= {"f/10000": sphere(2500), "f/50000": sphere(12_500)}
    np.savez(tmp_path / "shapes.npz", **clouds)
    options = ("--noise", 0.02, "--passes", 1, "--threads", 1, "--data", tmp_path / "shapes.npz")
    _, row = printed("passes", DEFAULT_WEIGHTS, *options).splitlines()
    noise, number, chamfer, across, sunk = map(float, row.split()[1:])
    assert (noise, number) == (0.02, 1)
    assert chamfer > across > sunk
    assert 0 < across < 4  # the noise's own is 4


@pytest.mark.parametrize("name", ["quality", "speed", "kernels", "held_out"])
def test_a_device_is_named_as_the_filter_takes_it(refused: Refused, name: str) -> None:
    for device, why in (("cuda:99", "cuda:99 was asked for, and torch sees"), ("tpu", "'tpu'; it must be")):
        code, said = refused(name, "--device", device)
        assert code == 2
        assert why in said.splitlines()[-1]


def test_kernels_that_cannot_be_compiled_are_not_timed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    if cpu._SHIPPED.is_dir():
        pytest.skip("the kernels are shipped here")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))  # no compiler
    _, *rows = printed("kernels", "--every-set").splitlines()
    assert [row.split(maxsplit=1) for row in rows] == [[name, "not compiled"] for name in cpu.instruction_sets()]


def test_scenes(tmp_path: Path) -> None:
    printed("scenes", "depth", "--every", 80, "--iterations", 1, "--threads", 1, "--json", tmp_path / "rows.json")
    whole, *parts = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert whole["points"] > 1000
    assert {"ground", "wall"} <= {row["part"] for row in parts}
    assert 0 < whole["after"] < 2 * whole["before"]


def test_a_raster_of_hills_has_its_noise_in_height_alone() -> None:
    scan = scenes.SCANNERS["raster"](1.0)
    assert len(scan.clean) == 10_000
    assert np.ptp(scan.clean[:, 2]) > 20
    off = scan.noisy - scan.clean
    assert np.abs(off[:, :2]).max() == 0
    assert off[:, 2].std() == pytest.approx(0.6, rel=0.05)
    assert np.abs(scenes.distance_to(scan.parts, scan.clean)).max() < 1e-9
    # Across the slope, by looking: the nearest of many points of the ground.
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-4, 4, 0.02), np.arange(-4, 4, 0.02)))
    ground = np.stack([x, y, scenes.Hills.height(x, y)[0]], axis=1)
    some = np.array([[0, 0, 0.5], [1, -2, 1.0], [-2, 1, -2.5]])
    nearest = np.linalg.norm(ground[:, None] - some, axis=2).min(axis=0)
    assert scenes.distance_to(scan.parts, some) == pytest.approx(nearest, rel=0.02)


def test_a_depth_camera_tells_depths_apart_by_disparities() -> None:
    scan = scenes.SCANNERS["disparity"](1.0)
    assert np.abs(scenes.distance_to(scan.parts, scan.clean)).max() < 1e-9
    assert len(np.unique(scan.noisy[:, 1])) < 200
    np.testing.assert_allclose(scan.noisy / scan.noisy[:, 1:2], scan.clean / scan.clean[:, 1:2])  # on its beam
    far = np.abs(scan.clean[:, 1] - 3) < 0.1
    step = 0.00285 * 9
    off = (scan.noisy - scan.clean)[far, 1]
    assert off.std() == pytest.approx(np.hypot(step / 2, step / np.sqrt(12)), rel=0.1)


def test_weights_of_a_state_keep_what_ships_beside_their_velocities(tmp_path: Path) -> None:
    shipped, made = DEFAULT_WEIGHTS, tmp_path / "weights.safetensors"
    printed("calibrate", "--state", shipped, "--mean", shipped, "--keep", shipped, "--out", made)
    (before, about), (after, says) = (read_checkpoint(path) for path in (shipped, made))
    assert all(torch.equal(before[name], tensor) for name, tensor in after.items())
    assert says["calibration"] == about["calibration"]
    assert says["training"]["mean_with"] == about["training"]


@pytest.mark.parametrize("share", ["nan", "1.5", "-0.1"])
def test_a_share_that_makes_no_mean_is_a_usage_error(refused: Refused, share: str) -> None:
    # NaN made weights of NaN, which --out put in the place of those that ship.
    options = ("--state", DEFAULT_WEIGHTS, "--keep", DEFAULT_WEIGHTS)
    code, said = refused("calibrate", *options, "--mean", DEFAULT_WEIGHTS, f"--share={share}")
    assert code == 2
    assert f"{share} is no share, which is 0 to 1" in said.splitlines()[-1]
    code, said = refused("calibrate", *options, "--share", 0.75)
    assert (code, said.splitlines()[-1]) == (2, f"{said.split()[1]}: error: --share is of a mean: give --mean with it")


def test_what_is_no_trace_is_named_by_its_line_before_the_work(refused: Refused, tmp_path: Path) -> None:
    trace = json.dumps({"cloud": "a/1000", "noise_std": 0.01, "distances": [0.5], "chamfer": [1e-4]})
    for broken in (trace[:20], "{}", "[1]"):  # the first as a full disk leaves it
        (traces := tmp_path / "traces.jsonl").write_text(f"{trace}\n{broken}\n")
        code, said = refused("calibrate", "--state", DEFAULT_WEIGHTS, "--traces", traces)
        assert code == 1
        assert f"{traces}: line 2 is no trace" in said


def test_scans_are_traced_with_noise_along_their_beams(refused: Refused, tmp_path: Path) -> None:
    xyz = sphere(1000)
    np.savez(tmp_path / "scans.npz", **{"a/470": xyz[xyz[:, 2] > 0.06], "a/90": xyz[:90], "a/eye": [0.0, 0, 30]})
    np.savez(tmp_path / "whole.npz", **{"a/500": xyz[:500]})
    traces = tmp_path / "traces.jsonl"
    options = ("--state", DEFAULT_WEIGHTS, "--table", DEFAULT_WEIGHTS, "--clouds", "a/500", "--noise-type", "beams")
    noise = ("--noise", 0.01, "--threads", 1, "--traces", traces)
    assert "a/500" in printed("calibrate", *options, *noise, "--data", tmp_path / "scans.npz")
    recorded = json.loads(traces.read_text())
    assert (recorded["cloud"], recorded["noise_type"]) == ("a/500", "beams")
    assert recorded["chamfer"][0] < 2 * 0.01**2  # in all three directions it is up to three times as much
    code, said = refused("calibrate", *options, *noise[:4], "--data", tmp_path / "whole.npz")
    assert (code, "no <shape>/eye" in said) == (1, True)


@pytest.mark.parametrize("points", [("--resolution", 1000), ("--random", "--resolution", 700)])
def test_candidates_are_compared_on_what_is_held_out(points: tuple[object, ...], tmp_path: Path) -> None:
    clouds = {f"{name}/1000": sphere(1000) for name in "abcdefghijkl"}
    # Surfaces of fewer points than they are named by.
    clouds |= {f"{name}/50000": sphere(12_500) for name in "fz"} | {"z/1000": sphere(1000)}
    np.savez(tmp_path / "trained.npz", **{name: xyz for name, xyz in clouds.items() if name[0] != "z"})
    np.savez(tmp_path / "unseen.npz", **{name: xyz for name, xyz in clouds.items() if name[0] == "z"})
    printout = printed(
        "held_out", DEFAULT_WEIGHTS, "--data", tmp_path / "trained.npz", "--unseen", tmp_path / "unseen.npz",
        *points, "--noise", 0.02, "--seeds", 0, "--iterations", 1, "--threads", 1,
    )  # fmt: skip
    first, row, mean = printout.splitlines()
    assert first.split(" of ")[1] == "f | z"
    assert row.split("seed 0")[1].count(" | ") == 1
    said = mean.split("geometric")[1].split(", arithmetic")
    geometric, arithmetic = ([float(figure) for figure in part.split(" / ")] for part in said)
    for chamfer, height in (geometric, arithmetic):
        assert 0 < height < 4  # the noise's own is 4
        assert chamfer > height
    assert all(more >= less - 0.001 for less, more in zip(geometric, arithmetic, strict=True))


def test_points_that_an_archive_lacks_are_named_in_one_line(tmp_path: Path) -> None:
    np.savez(tmp_path / "trained.npz", **{f"{name}/50000": sphere(50_000) for name in "abcdef"})
    for points in (("--resolution", 700), ("--random", "--resolution", 60_000)):
        ended = _run("held_out", DEFAULT_WEIGHTS, "--data", tmp_path / "trained.npz", *points)
        assert ended.returncode == 1
        (line,) = ended.stderr.decode().splitlines()
        assert f"f/{points[-1]}" in line


def test_two_archives_with_a_shape_of_one_name_are_refused(refused: Refused, tmp_path: Path) -> None:
    # Of the two one was measured, and the other left out without a word.
    clouds = {f"{name}/{count}": sphere(200) for name in "abcdef" for count in (1000, 50_000)}
    for archive in ("trained", "unseen"):
        np.savez(tmp_path / f"{archive}.npz", **clouds)  # type: ignore[arg-type]
    trained, unseen = ("--data", tmp_path / "trained.npz"), ("--unseen", tmp_path / "unseen.npz")
    code, said = refused("held_out", DEFAULT_WEIGHTS, *trained, *unseen, "--resolution", 1000)
    assert (code, said) == (1, "two of the archives have a shape f, by which figures are named")


@pytest.mark.parametrize("name", ["passes", "velocities"])
def test_of_several_states_one_that_is_none_is_found_out_before_the_work(
    refused: Refused, name: str, tmp_path: Path
) -> None:
    (junk := tmp_path / "junk.safetensors").write_text("junk")
    code, said = refused(name, DEFAULT_WEIGHTS, junk, "--data", tmp_path)
    assert (code, said.split(" is ")[0]) == (1, str(junk))


@pytest.mark.parametrize("name", ["held_out", "passes", "velocities", "quality", "calibrate"])
def test_a_file_that_is_missing_is_named_in_one_line(refused: Refused, name: str, tmp_path: Path) -> None:
    gone = tmp_path / "gone.safetensors"
    options: dict[str, tuple[object, ...]] = {
        "calibrate": ("--state", gone),
        "quality": ("--split", "validation", "--weights", gone),
    }
    code, said = refused(name, *options.get(name, (gone, "--data", tmp_path / "gone.npz")))
    assert code == 1
    (line,) = said.splitlines()
    assert str(tmp_path) in line


def test_an_archive_or_weights_that_cannot_be_read_are_named_in_one_line(refused: Refused, tmp_path: Path) -> None:
    (junk := tmp_path / "junk.npz").write_text("junk")
    np.savez(tmp_path / "punet_test.npz", **{"a/10000": np.zeros((3, 3))})
    for name, *arguments in (
        ("held_out", DEFAULT_WEIGHTS, "--data", junk),
        ("passes", DEFAULT_WEIGHTS, "--data", junk),
        ("quality", "--split", "validation", "--weights", junk),
        ("quality", "--split", "validation", "--weights", tmp_path),
        ("quality", "--split", "punet", "--data", tmp_path, "--resolution", 7),
    ):
        code, said = refused(str(name), *arguments)
        assert code == 1
        (line,) = said.splitlines()
        assert str(tmp_path) in line


@pytest.mark.parametrize("arguments", ["speed --patches 0", "speed --threads 0", "quality --resolution 0"])
def test_a_count_of_nothing_is_a_usage_error(refused: Refused, arguments: str) -> None:
    code, said = refused(*arguments.split())
    assert code == 2
    assert "0 is no whole number of 1 or more" in said.splitlines()[-1]


@pytest.mark.parametrize(
    "arguments",
    ["calibrate --state none --out", "calibrate --state none --traces", "scenes --json", "scaling --plot", "picture"],
)
def test_what_cannot_be_written_is_said_before_it_is_made(refused: Refused, arguments: str, tmp_path: Path) -> None:
    code, said = refused(*arguments.split(), tmp_path / "gone" / "figures")
    assert code == 2
    assert "is no folder to write figures to" in said.splitlines()[-1]


def test_figures_that_have_no_place_are_refused_before_they_are_made(refused: Refused, tmp_path: Path) -> None:
    options = ("--split", "validation", "--shapes", "sphere", "--resolution", 500, "--model", "noisy")
    assert refused("quality", *options, "--json", tmp_path) == (1, f"[Errno 21] Is a directory: '{tmp_path}'")


@pytest.mark.parametrize("coverage", ["0", "0.5", "nan", "inf"])
def test_a_coverage_that_the_filter_does_not_take_is_a_usage_error(refused: Refused, coverage: str) -> None:
    code, said = refused("quality", "--split", "validation", "--coverage", coverage)
    assert code == 2
    assert f"{coverage} is no coverage, which is 1 or more" in said.splitlines()[-1]


@pytest.mark.parametrize("name", ["quality --split validation --model noisy", "conditions cut"])
def test_an_analytic_shape_of_fewer_points_than_can_be_filtered_is_refused(refused: Refused, name: str) -> None:
    assert refused(*name.split(), "--resolution", 20) == (1, "20 points; at least 33 can be filtered")


def test_a_cloud_too_small_to_filter_is_a_usage_error(refused: Refused) -> None:
    code, said = refused("scaling", "--points", 1000, 32)
    assert code == 2
    assert "32 points; at least 33" in said.splitlines()[-1]


def test_noise_that_is_no_number_is_a_usage_error() -> None:
    for text in ("nan", "inf", "-0.01"):
        with pytest.raises(argparse.ArgumentTypeError, match=text):
            noise_level(text)
    assert noise_level("0.02") == 0.02
