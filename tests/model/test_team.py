"""A process that shares a run's batches and is ended is named as that, wherever the run meets it."""

from __future__ import annotations

from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.train import loop, train
from straightpcf.model.train.losses import velocity_loss
from straightpcf.model.train.team import Team
from straightpcf.points.errors import InvalidOptions


def with_a_member(exit_code: int) -> tuple[Team, Connection]:
    """Return a team, and the end of the pipe that its only member has."""
    network = StraightPCF(couplings=1, width=64, distance_width=64)
    team = Team(0, network, network.velocity_modules, lambda network, batch: velocity_loss(network, batch, 1), [], 1, 0)
    ours, theirs = Pipe()
    process: Any = SimpleNamespace(join=lambda seconds: None, exitcode=exit_code)
    team._members.append((ours, torch.zeros(0)))
    team._processes.append(process)
    return team, theirs


def test_a_member_that_ended_between_two_iterations_is_no_stdout_without_a_reader() -> None:
    team, theirs = with_a_member(-9)
    theirs.close()
    with pytest.raises(RuntimeError, match="a process that shared the batch has ended, by signal 9"):
        team.start(training=True)


@pytest.mark.parametrize("read", [True, False])
def test_a_member_that_ended_at_work_is_no_file_that_cannot_be_read(read: bool) -> None:
    team, theirs = with_a_member(1)
    team.start(training=True)
    if read:
        theirs.recv()
    theirs.close()  # a reset connection, where what was sent has not been read
    with pytest.raises(RuntimeError, match="has ended, its error is above; the last state that was saved is kept"):
        team.join(torch.tensor(0.0))


def test_processes_share_batches_on_the_device_that_auto_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = partial(train, "vm", data=[], run_dir=tmp_path, iterations=1, device="auto", processes=2, passed=[tmp_path])
    monkeypatch.setattr(loop, "device_named", lambda name: "cpu")
    with pytest.raises(InvalidOptions, match="clouds after passes"):  # what is looked at next
        run(batch_size=2)
    with pytest.raises(InvalidOptions, match="2 processes cannot share batches of 3: give a multiple of them"):
        run(batch_size=3)
    monkeypatch.setattr(loop, "device_named", lambda name: "cuda:1")
    with pytest.raises(InvalidOptions, match="2 processes cannot share batches on cuda:1: they do so on a CPU"):
        run(batch_size=2)
