"""The page when it is come back to, and when the server or a job was gone meanwhile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.conftest import RunningServer


def test_the_strength_that_is_said_is_the_one_that_a_browser_brings_back(page: Any, server: RunningServer) -> None:
    page.fill("#strength", "0.5")
    page.goto(f"{server.url}/livez")
    page.go_back()
    page.wait_for_selector("#server:has-text('version')")
    assert (page.input_value("#strength"), page.inner_text("#strength-value")) == ("0.5", "50 %")


def test_a_server_that_is_back_is_not_said_to_be_away(page: Any, scan: Path) -> None:
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.route("**/jobs/*/events", lambda route: route.abort())
    page.click("#submit")
    page.wait_for_selector("#status:has-text('The connection is lost')")
    page.route("**/jobs?*", lambda route: route.abort())
    page.click("#jobs-refresh")
    page.wait_for_selector("#error:has-text('does not answer')")
    page.unroute("**/jobs/*/events")
    page.unroute("**/jobs?*")
    page.wait_for_selector("#report:not([hidden])")
    assert page.is_hidden("#error")


def test_a_job_that_another_deleted_can_be_deleted(page: Any, scan: Path, server: RunningServer) -> None:
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.click("#submit")
    page.locator("#jobs-list li").get_by_text("Download").wait_for()
    server.delete_jobs()
    page.locator("#jobs-list li").get_by_text("Delete").click()
    page.wait_for_selector("#jobs", state="hidden")
    assert page.is_hidden("#report")
    assert page.is_hidden("#error")


def test_a_result_that_the_page_cannot_show_can_be_downloaded(page: Any, scan: Path) -> None:
    """Its job is done; the page said that it met an error of its own, and nothing of the report."""
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.route("**/stream", lambda route: route.fulfill(status=404, body="{}"))
    page.route("**/result", lambda route: route.fulfill(status=200, body="ply\nbut no more of it"))
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    told = "This page could not show scan_clean.ply (no PLY header); download it to see it."
    assert page.inner_text("#note") == told
    assert page.is_hidden("#error")
    assert page.get_attribute("#download", "download") == "scan_clean.ply"


def test_a_result_that_is_gone_is_said_to_be(page: Any, scan: Path) -> None:
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    gone = '{"code": "not_found", "detail": "no such job"}'
    page.route("**/stream", lambda route: route.fulfill(status=404, body=gone))
    page.route("**/result", lambda route: route.fulfill(status=404, body=gone))
    page.click("#submit")
    page.wait_for_selector("#error:has-text('no such job')")
    assert page.is_hidden("#report")
