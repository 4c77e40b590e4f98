"""Who is let in, and when again."""

from __future__ import annotations

import pytest

from straightpcf.points.errors import RateLimited
from straightpcf.service.api.auth import Gate


def test_who_asks_too_often_is_told_when_the_next_request_is_granted() -> None:
    gate = Gate((), rate_per_minute=2)
    gate.admit(None)
    gate.admit(None)
    with pytest.raises(RateLimited, match="2 requests a minute") as refused:
        gate.admit(None)
    assert refused.value.retry_after == 30
