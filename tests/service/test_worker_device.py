"""An error ends a job; one after which a device answers no more ends its worker, so that another takes its place."""

from __future__ import annotations

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
from straightpcf.service.backends.worker import Failed

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
