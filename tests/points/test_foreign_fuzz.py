"""Broken files of other programs end in one of our errors or in a cloud, never in anything else."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from straightpcf.points.errors import StraightPCFError
from straightpcf.points.formats import read_cloud, write_cloud
from tests.points.foreign_samples import OTHER_SAMPLES


@cache
def _sample(name: str) -> tuple[bytes, str]:
    with tempfile.TemporaryDirectory() as folder:
        path = OTHER_SAMPLES[name](Path(folder))
        return path.read_bytes(), path.suffix


def _read_and_write(data: bytes, suffix: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"broken{suffix}"
        path.write_bytes(data)
        try:
            cloud, format = read_cloud(path, max_points=1_000_000)
            with np.errstate(all="ignore"):
                moved = np.where(np.abs(cloud.xyz) < 1e30, cloud.xyz + 0.125, cloud.xyz)
            write_cloud(cloud.with_xyz(moved), path, format)
            again, _ = read_cloud(path, max_points=1_000_000)
        except StraightPCFError:
            return
        assert len(again) == len(cloud)


@pytest.mark.parametrize("name", OTHER_SAMPLES)
@settings(max_examples=80, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(choices=st.data())
def test_any_broken_file_ends_in_our_error_or_a_cloud(name: str, choices: st.DataObject) -> None:
    if name.startswith("la"):
        pytest.importorskip("laspy", reason="the extra straightpcf[las] is not installed")
    data, suffix = _sample(name)
    broken = bytearray(data)
    head = min(len(data), 450)  # most of what can go wrong stands in front
    place = st.one_of(st.integers(0, head - 1), st.integers(0, len(data) - 1))
    for at in choices.draw(st.lists(place, max_size=4)):
        broken[at] = choices.draw(st.integers(0, 255))
    if choices.draw(st.booleans()):
        del broken[choices.draw(place) :]
    if choices.draw(st.integers(0, 4)) == 0:
        at = choices.draw(place)
        broken[at:at] = choices.draw(st.sampled_from([b"\xff\xff\xff\xff", b"9999999999", b"-1", b"\n", b"\r", b"nan"]))
    _read_and_write(bytes(broken), suffix)
