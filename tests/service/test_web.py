"""The page's files as they are sent."""

from __future__ import annotations

import httpx2
import pytest

from tests.conftest import RunningServer


@pytest.mark.parametrize(
    ("accepted", "coding"),
    [
        ("gzip", "gzip"),
        ("br, GZIP;q=0.001", "gzip"),
        ("deflate, gzip; q=1.0", "gzip"),
        ("gzip;q=0", None),
        ("br, gzip ; Q=0.000", None),
        ("notgzip", None),
        ("", None),
    ],
)
def test_the_page_is_packed_for_whom_it_suits(server: RunningServer, accepted: str, coding: str | None) -> None:
    answer = httpx2.get(f"{server.url}/", headers={"Accept-Encoding": accepted})
    assert answer.headers.get("content-encoding") == coding
    assert answer.headers["vary"] == "Accept-Encoding"
    assert "<title>" in answer.text
