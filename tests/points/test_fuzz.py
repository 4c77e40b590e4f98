"""Broken files of every format: only our own errors come out, and quickly."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from straightpcf.points.errors import InvalidRequest, MissingDependency, TooLarge
from straightpcf.points.formats import read_cloud, write_cloud
from tests.points.samples import SAMPLES

SECONDS = 5.0  # a file of a few kilobytes; generous, for a busy machine


@pytest.fixture(params=SAMPLES)
def content(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, bytes]:
    try:
        path = SAMPLES[request.param](tmp_path)
    except MissingDependency as missing:
        pytest.skip(missing.message)
    return path.name, path.read_bytes()


def _read(folder: Path, name: str, raw: bytes) -> None:
    (path := folder / f"broken_{name}").write_bytes(raw)
    began = time.monotonic()
    with suppress(InvalidRequest, TooLarge):
        cloud, format = read_cloud(path, max_points=10_000)
        with np.errstate(invalid="ignore"):  # a flipped bit may make a signalling NaN
            moved = cloud.xyz + 0.25
        write_cloud(cloud.with_xyz(moved), folder / "again", format)
    assert time.monotonic() - began < SECONDS


@given(data=st.data())
@settings(
    max_examples=50,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
def test_flipped_bytes_give_a_cloud_or_an_error_of_ours(content: tuple[str, bytes], tmp_path: Path, data: Any) -> None:
    name, raw = content
    broken = bytearray(raw)
    # Half of the flips in the first 400 bytes: headers break in more ways than numbers do.
    spots = st.one_of(st.integers(0, min(400, len(raw)) - 1), st.integers(0, len(raw) - 1))
    for at, value in data.draw(st.lists(st.tuples(spots, st.integers(0, 255)), max_size=6)):
        broken[at] = value
    _read(tmp_path, name, bytes(broken[: data.draw(st.integers(1, len(raw)))]))


@given(data=st.data())
@settings(
    max_examples=25,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
def test_other_digits_give_a_cloud_or_an_error_of_ours(content: tuple[str, bytes], tmp_path: Path, data: Any) -> None:
    """Counts, sizes and versions that are wrong in a file that is otherwise whole."""
    name, raw = content
    digits = [at for at, byte in enumerate(raw[:400]) if byte in b"0123456789"] or [0]
    broken = bytearray(raw)
    for at in data.draw(st.lists(st.sampled_from(digits), min_size=1, max_size=4)):
        broken[at : at + 1] = data.draw(st.sampled_from([b"0", b"9", b"-", b".", b" ", b"99999999", b"x", b"nan", b""]))
    _read(tmp_path, name, bytes(broken))


def test_any_cut_is_a_cloud_or_an_error_of_ours(content: tuple[str, bytes], tmp_path: Path) -> None:
    name, raw = content
    for length in np.unique(np.linspace(1, len(raw) - 1, 40).astype(int)):
        _read(tmp_path, name, raw[:length])
