"""The commands that make training data refuse in one line what they cannot use, and lose nothing of what is there."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from straightpcf.model.filter import Filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.patches import PATCH_SIZE
from straightpcf.model.train import archive, chance, record, scanned, solids
from straightpcf.model.train.archive import fingerprint, write_archive
from straightpcf.model.train.data import PatchSource
from straightpcf.model.train.passed import PassedClouds
from straightpcf.model.train.record import write_passed
from straightpcf.points.errors import InvalidCloud, InvalidOptions, MalformedFile
from tests.clouds import sphere

Ended = Callable[..., str]


@pytest.fixture
def ended(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ended:
    """Run a command that ends in one line, and return that."""

    def run(module: Any, *arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            module._main()
        said = capsys.readouterr().err
        return str(end.value) if end.value.code != 2 else said.splitlines()[-1]

    return run


def test_data_that_cannot_be_recorded_is_named(ended: Ended, tmp_path: Path) -> None:
    clouds = [sphere(PATCH_SIZE)] * 6
    archives = {
        "no clouds called": {f"s{n}/1k": xyz for n, xyz in enumerate(clouds)},
        "'s0'; it must be <shape>/<resolution>": {f"s{n}": xyz for n, xyz in enumerate(clouds)},
        "has 999 points": {f"s{n}/999": xyz[1:] for n, xyz in enumerate(clouds)},
    }
    for said, arrays in archives.items():
        np.savez(data := tmp_path / "data.npz", **arrays)  # type: ignore[arg-type]
        assert f"{data}" in (line := ended(record, tmp_path / "out.npz", "--data", data))
        assert said in line
    data.write_bytes(data.read_bytes()[:1000])
    assert "no NPZ file, or not a whole one" in ended(record, tmp_path / "out.npz", "--data", data)
    assert "is no NPZ file" in ended(chance, tmp_path / "out.npz", "--data", data)
    assert "No such file" in ended(chance, tmp_path / "out.npz", "--data", tmp_path / "none.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["data.npz"]


def test_a_device_that_is_not_here_is_told_before_the_data_is_read(ended: Ended, tmp_path: Path) -> None:
    said = ended(record, tmp_path / "out.npz", "--data", tmp_path / "none.npz", "--device", "cuda:99")
    assert said.endswith(f"device cuda:99 was asked for, and torch sees {torch.cuda.device_count()} CUDA devices here")


@pytest.mark.parametrize("module", [record, chance, solids, scanned])
def test_what_cannot_be_written_is_said_before_the_work(module: Any, ended: Ended, tmp_path: Path) -> None:
    data = () if module in (solids, scanned) else ("--data", tmp_path / "data.npz")
    assert "is no folder to write out.npz to" in ended(module, tmp_path / "none" / "out.npz", *data)
    assert "ends in .npz" in ended(module, tmp_path / "out", *data)
    assert "-1 is no whole number of 0 or more" in ended(module, tmp_path / "out.npz", *data, "--seed", -1)


def test_an_archive_that_the_disk_has_no_room_for_leaves_the_old_one(tmp_path: Path) -> None:
    np.savez(path := tmp_path / "old.npz", a=np.ones(3))
    before = path.read_bytes()

    def full(scratch: Path, **arrays: np.ndarray) -> None:
        scratch.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match=r"No space left on device: '.*old\.npz'"):
        write_archive(path, {"a": np.zeros(3)}, save=full)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_part_of_another_recording_is_not_written_over(tmp_path: Path) -> None:
    np.savez(data := tmp_path / "data.npz", **{f"s{n}/1000": sphere(1000) for n in range(6)})  # type: ignore[arg-type]
    torch.manual_seed(0)
    denoiser = Filter(StraightPCF(width=128, distance_width=128).eval(), threads=1, coverage=2)
    part = tmp_path / "out.part.npz"
    of_these = [0, ["data"], record._digest(denoiser), [0.02]]
    record._keep(part, {"a": np.ones(3)}, of_these, {}, [fingerprint(data)])
    before = part.read_bytes()
    for other in ({"seed": 1}, {"levels": [0.03]}):
        with pytest.raises(InvalidOptions, match=r"out\.part\.npz is of another seed, other data, weights or noise"):
            write_passed(tmp_path / "out.npz", denoiser, [data], 1, **{"levels": [0.02], **other})  # type: ignore[arg-type]
    np.savez(data, **{f"s{n}/1000": 2 * sphere(1000) for n in range(6)})  # type: ignore[arg-type]
    with pytest.raises(InvalidOptions, match=r"out\.part\.npz is of archives of these names that held other arrays"):
        write_passed(tmp_path / "out.npz", denoiser, [data], 1, levels=[0.02])
    assert part.read_bytes() == before
    np.savez(part, a=np.ones(3))
    with pytest.raises(MalformedFile, match="is no part of a recording"):
        write_passed(tmp_path / "out.npz", denoiser, [data], 1)


def test_clouds_after_passes_that_cannot_be_trained_on_are_named(tmp_path: Path) -> None:
    np.savez(data := tmp_path / "data.npz", **{"s/1000": sphere(1000)})  # type: ignore[arg-type]
    frame, path = np.array([0.0, 0, 0, 1]), tmp_path / "passed.npz"
    cases: dict[str, dict[str, np.ndarray]] = {
        "'a/b/c'; it must be <archive>/<shape>/<number>/xyz": {"a/b/c": sphere(1000)},
        "and no data/s/0/frame": {"data/s/0/xyz": sphere(1000)},
        r"data/s/0/frame is float64 \(3,\); it must be \(4,\)": {
            "data/s/0/xyz": sphere(1000), "data/s/0/frame": frame[1:]
        },
        "data/s/0/xyz has 999 points": {"data/s/0/xyz": sphere(999), "data/s/0/frame": frame},
    }  # fmt: skip
    for said, arrays in cases.items():
        np.savez(path, **arrays)  # type: ignore[arg-type]
        with pytest.raises(InvalidCloud, match=f"passed.npz.*{said}"):
            PassedClouds([path], [data], torch.nn.Identity())
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(MalformedFile, match=r"passed\.npz is no NPZ file"):
        PassedClouds([path], [data], torch.nn.Identity())


def test_archives_of_one_name_are_refused_where_it_is_all_that_tells_them(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    for path in (paths := [tmp_path / "data.npz", tmp_path / "other" / "data.npz"]):
        np.savez(path, **{"s/1000": sphere(1000)})  # type: ignore[arg-type]
    with pytest.raises(InvalidOptions, match="have one name"):
        archive.by_stem(paths)
    with pytest.raises(InvalidOptions, match="have one name"):
        PassedClouds([], paths, torch.nn.Identity())
    assert archive.by_stem([paths[0], paths[0].parent / "other" / ".." / "data.npz"]) == {"data": paths[0]}


def test_too_few_shapes_to_hold_one_out_are_called_that(tmp_path: Path) -> None:
    np.savez(data := tmp_path / "data.npz", **{f"s{n}/1000": sphere(1000) for n in range(5)})  # type: ignore[arg-type]
    assert len(PatchSource.read(data).clouds) == 5
    with pytest.raises(InvalidOptions, match=r"no shape of .*data\.npz is held out to validate with; an archive of 6"):
        PatchSource.read(data, validation=True)
