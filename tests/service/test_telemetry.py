"""What /metrics tells of requests."""

from __future__ import annotations

import httpx2

from tests.conftest import RunningServer


def test_made_up_methods_make_no_labels(server: RunningServer) -> None:
    with httpx2.Client(base_url=server.url) as http:
        for number in range(3):
            assert http.request(f"MADE{number}", "/livez").status_code == 405
        text = http.get("/metrics").text
    assert "MADE" not in text
    assert 'straightpcf_http_requests_total{method="other",route="/livez",status="405"} 3.0' in text
