"""An error ends a job; one after which a device answers no more ends its worker, and so does the end of its server."""

from __future__ import annotations

import threading
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from straightpcf.model import device
from straightpcf.points.errors import TooLarge
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.backends import worker
from straightpcf.service.backends.base import FileJob
from straightpcf.service.backends.worker import Failed, WorkerSpec

JOB = FileJob(id="1", source=Path("cloud"), target=Path("result"), options=DenoiseOptions(), max_points=1000)


def answer(error: Exception, monkeypatch: pytest.MonkeyPatch, *, lost: bool) -> Any:
    def fail(*given: Any, **how: Any) -> None:
        raise error

    monkeypatch.setattr(worker, "denoise_file", fail)
    monkeypatch.setattr(device, "is_lost", lambda name: lost)
    ours, theirs = Pipe()
    with ours, theirs:
        return worker._answer(SimpleNamespace(device="cuda"), JOB, theirs)  # type: ignore[arg-type]


def test_a_worker_goes_on_while_its_device_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = Failed("1", "internal_error", "the worker failed with RuntimeError")
    assert answer(RuntimeError("of a kernel"), monkeypatch, lost=False) == expected
    assert answer(TooLarge("cuda has no memory"), monkeypatch, lost=True).code == "too_large"


def test_a_worker_whose_device_is_lost_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RuntimeError, match="illegal"):
        answer(RuntimeError("an illegal memory access was encountered"), monkeypatch, lost=True)


def test_a_cpu_is_never_lost() -> None:
    assert not device.is_lost("cpu")


@pytest.mark.parametrize("told", [False, True], ids=["while it loads", "before it reads that it is ready"])
def test_a_worker_whose_server_is_killed_ends_without_a_traceback(told: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = Pipe()

    def load(spec: WorkerSpec) -> Any:
        if not told:
            ours.close()
        return SimpleNamespace(device="cpu")

    def die() -> None:
        if ours.poll(20):
            ours.close()

    monkeypatch.setattr(worker, "_load", load)
    monkeypatch.setattr(worker, "SERVERS_OWN", ())  # they are those of the tests
    server = threading.Thread(target=die if told else lambda: None)
    server.start()
    with theirs:
        worker.run_worker(theirs, WorkerSpec(device="cpu", weights=None, threads=None))
    server.join()
