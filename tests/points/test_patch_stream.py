"""The patch stream survives any chunking and refuses what is none."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightpcf.points.errors import MalformedFile
from straightpcf.points.wire.patches import PatchFrame, PatchReader, encode_end, encode_frame, encode_header


def stream() -> bytes:
    rng = np.random.default_rng(0)
    frames = [
        encode_frame(np.arange(n), rng.normal(size=(n, 3)) + 5e6, iteration=i, final=i == 2, progress=n / 10)
        for i, n in ((1, 3), (1, 0), (2, 7))
    ]
    return b"".join([encode_header(10), *frames, encode_end(2)])


@given(cuts=st.lists(st.integers(0, len(stream())), max_size=20))
def test_any_chunking_gives_the_same_frames(cuts: list[int]) -> None:
    data, reader = stream(), PatchReader()
    edges = [0, *sorted(cuts), len(data)]
    frames: list[PatchFrame] = []
    for a, b in itertools.pairwise(edges):
        frames += reader.feed(data[a:b])
    assert reader.points == 10
    assert [(len(f.indices), f.iteration, f.final, f.end) for f in frames] == [
        (3, 1, False, False), (0, 1, False, False), (7, 2, True, False), (0, 2, True, True)
    ]  # fmt: skip
    rng = np.random.default_rng(0)
    assert np.array_equal(frames[0].xyz, rng.normal(size=(3, 3)) + 5e6)  # float64, to the bit
    assert np.array_equal(frames[2].indices, np.arange(7))


@pytest.mark.parametrize("data", [b"PK\x03\x04" + bytes(12), encode_header(3) + b"\xff" * 20])
def test_what_is_no_patch_stream_is_refused(data: bytes) -> None:
    with pytest.raises(MalformedFile):
        PatchReader().feed(data)
