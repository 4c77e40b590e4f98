"""Ranges and conditions on a result, over real sockets."""

from __future__ import annotations

import io
from collections.abc import Iterator

import httpx2
import numpy as np
import pytest

from tests.clouds import noisy, torus
from tests.conftest import RunningServer


def _cloud() -> bytes:
    np.save(buffer := io.BytesIO(), noisy(torus(200), 0.01))
    return buffer.getvalue()


@pytest.fixture
def http(server: RunningServer) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=server.url, timeout=60) as client:
        yield client


@pytest.fixture
def result(http: httpx2.Client) -> str:
    job = http.post("/jobs?iterations=1", content=_cloud()).json()
    assert http.get(f"/jobs/{job['id']}?wait=60").json()["state"] == "succeeded"
    return str(job["links"]["result"])


def test_a_range_out_of_reach_is_a_problem_that_tells_the_size(http: httpx2.Client, result: str) -> None:
    whole = http.get(result)
    size, etag = len(whole.content), whole.headers["etag"]
    for asked in (f"bytes={size}-", f"bytes={size}-{size + 9}", "bytes=-0", f"bytes={size}-,-0"):
        for condition in ({}, {"If-Range": etag}):
            answer = http.get(result, headers={"Range": asked, **condition})
            assert (answer.status_code, answer.json()["code"]) == (416, "range_not_satisfiable"), asked
            assert answer.headers["content-type"] == "application/problem+json"
            assert answer.headers["content-range"] == f"bytes */{size}"


def test_a_range_that_is_malformed_or_of_another_result_is_ignored(http: httpx2.Client, result: str) -> None:
    whole = http.get(result).content
    digits = "9" * 5000
    for asked in (
        "bytes=9-2", "bytes=0-1,9-2", f"bytes={digits}-", f"bytes=0-{digits}", f"bytes=-{digits}",
        "bytes=", "bytes=-", "bytes=x-", "bytes=1", "bytes", "lines=1-2",
    ):  # fmt: skip
        answer = http.get(result, headers={"Range": asked})
        assert (answer.status_code, answer.content) == (200, whole), asked[:40]
    for condition in ('"other"', f"W/{http.head(result).headers['etag']}"):
        for asked in ("bytes=5-9", "bytes=999999999-"):
            answer = http.get(result, headers={"Range": asked, "If-Range": condition})
            assert (answer.status_code, answer.content) == (200, whole)


def test_parts_out_of_reach_are_left_out_beside_parts_within(http: httpx2.Client, result: str) -> None:
    whole = http.get(result).content
    for asked, part in (("bytes=3-7, 999999999-", whole[3:8]), ("Bytes=-0,-5", whole[-5:])):
        answer = http.get(result, headers={"Range": asked})
        assert (answer.status_code, answer.content) == (206, part), asked
    both = http.get(result, headers={"Range": "bytes=0-1,10-12"})
    assert both.headers["content-type"].startswith("multipart/byteranges")


def test_if_match_sends_no_other_result_than_the_one_that_is_named(http: httpx2.Client, result: str) -> None:
    whole = http.get(result)
    etag = whole.headers["etag"]
    for named in (etag, f'"other", {etag}', "*"):
        answer = http.get(result, headers={"If-Match": named, "Range": "bytes=3-7"})
        assert (answer.status_code, answer.content) == (206, whole.content[3:8]), named
    for named in ('"other"', f"W/{etag}"):  # strongly compared: RFC 9110, 13.1.1
        answer = http.get(result, headers={"If-Match": named, "Range": "bytes=3-7"})
        assert (answer.status_code, answer.json()["code"]) == (412, "precondition_failed"), named
        assert http.head(result, headers={"If-Match": named}).status_code == 412


def test_conditions_on_several_lines_are_one_list(http: httpx2.Client, result: str) -> None:
    etag = http.get(result).headers["etag"]
    for name, status in (("If-Match", 200), ("If-None-Match", 304)):
        assert http.get(result, headers=[(name, '"other"'), (name, etag)]).status_code == status, name
    assert http.get(result, headers={"If-Match": ""}).status_code == 412


def test_an_answer_without_a_body_says_how_to_cache(http: httpx2.Client, result: str) -> None:
    whole = http.get(result)
    for named in (whole.headers["etag"], f"W/{whole.headers['etag']}", "*"):
        same = http.get(result, headers={"If-None-Match": named})
        assert (same.status_code, same.content) == (304, b""), named
        assert same.headers["cache-control"] == whole.headers["cache-control"]


def test_what_denoise_made_is_sent_whole_whatever_the_conditions(http: httpx2.Client) -> None:
    plain = http.post("/denoise?iterations=1", content=_cloud())
    for headers in (
        {"If-None-Match": "*"},
        {"If-Match": '"other"'},
        {"If-None-Match": plain.headers["etag"]},
        {"Range": "bytes=0-4"},
        {"Range": "bytes=99999999-"},
    ):
        for method in ("POST", "PUT"):
            answer = http.request(method, "/denoise?iterations=1", content=_cloud(), headers=headers)
            assert (answer.status_code, answer.content) == (200, plain.content), (method, headers)
