"""The page when it is come back to, and when the server or a job was gone meanwhile."""

from __future__ import annotations

from typing import Any

from tests.conftest import RunningServer


def test_the_strength_that_is_said_is_the_one_that_a_browser_brings_back(page: Any, server: RunningServer) -> None:
    page.fill("#strength", "0.5")
    page.goto(f"{server.url}/livez")
    page.go_back()
    page.wait_for_selector("#server:has-text('version')")
    assert (page.input_value("#strength"), page.inner_text("#strength-value")) == ("0.5", "50 %")
