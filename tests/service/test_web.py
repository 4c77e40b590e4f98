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


@pytest.mark.parametrize("path", ["/", "/static/main.js"])
@pytest.mark.parametrize("coding", ["gzip", "identity"])
def test_who_has_the_page_is_told_so(server: RunningServer, path: str, coding: str) -> None:
    accepted = ("Accept-Encoding", coding)
    whole = httpx2.get(server.url + path, headers=[accepted])
    etag = whole.headers["etag"]
    for lines in (["*"], [etag], [f"W/{etag}"], [f'"other", {etag}'], ['"other"', etag]):  # RFC 9110, 13.1.2
        for method in ("GET", "HEAD"):
            headers = [accepted, *(("If-None-Match", line) for line in lines)]
            same = httpx2.request(method, server.url + path, headers=headers)
            assert (same.status_code, same.content, same.headers["etag"]) == (304, b"", etag), lines
    for line in ('"other"', '"*"', ""):
        other = httpx2.get(server.url + path, headers=[accepted, ("If-None-Match", line)])
        assert (other.status_code, other.content) == (200, whole.content), line
    absent = httpx2.get(f"{server.url}/static/no.js", headers=[("If-None-Match", "*")])
    assert absent.status_code == 404
