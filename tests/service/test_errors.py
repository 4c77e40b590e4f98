from __future__ import annotations

import re
from pathlib import Path

import pytest

from straightpcf.points.errors import ERRORS_BY_CODE, InvalidRequest
from straightpcf.service.api.errors import STATUS_BY_CODE


def test_every_code_has_a_status_and_no_status_is_left_over() -> None:
    assert set(STATUS_BY_CODE) == set(ERRORS_BY_CODE)


def test_the_docs_tell_the_status_of_every_code_that_is_sent() -> None:
    text = (Path(__file__).parents[2] / "docs" / "api.md").read_text()
    rows = re.findall(r"^\| (\d{3}) \| (`[a-z_]+`.*?) \|$", text, re.MULTILINE)
    told = {(code, int(status)) for status, codes in rows for code in re.findall(r"`([a-z_]+)`", codes)}
    sent = {(code, status) for code, status in STATUS_BY_CODE.items() if code not in ("error", "connection_failed")}
    assert told == sent | {("invalid_request", 422)}


@pytest.mark.parametrize("code", sorted(ERRORS_BY_CODE))
def test_what_the_caller_did_wrong_is_4xx_and_what_may_be_retried_is_408_429_or_5xx(code: str) -> None:
    kind, status = ERRORS_BY_CODE[code], STATUS_BY_CODE[code]
    if issubclass(kind, InvalidRequest):
        assert 400 <= status < 500
    if kind.retryable:
        assert status in (408, 429, 502, 503, 507)
