"""The page when another job is shown before it is through with one."""

from __future__ import annotations

import io
import os
import signal
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.clouds import sphere
from tests.conftest import RunningServer
from tests.waiting import wait_for

HOLD_ONE = """() => {
  window.held = null;
  const post = Worker.prototype.postMessage;
  Worker.prototype.postMessage = function (...said) {
    Worker.prototype.postMessage = post;
    window.held = () => this.postMessage(...said);
  };
}"""
HIDE = """(isHidden) => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => isHidden });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


def test_what_is_left_for_another_job_is_seen_no_more(page: Any, scan: Path, tmp_path: Path) -> None:
    asked: list[str] = []

    def show(at: int, until: str) -> None:
        asked.clear()
        page.locator("#jobs-list li").nth(at).get_by_text("Show").click()
        wait_for(lambda: page.wait_for_timeout(20) or until in asked)

    page.on("request", lambda request: asked.append(request.url.rpartition("/")[2]))
    (other := tmp_path / "other.ply").write_bytes(scan.read_bytes())
    page.select_option("#iterations", "1")
    page.set_input_files("#file", scan)
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    page.evaluate(HOLD_ONE)
    page.set_input_files("#file", other)
    page.click("#submit")  # the server has it before the page has read it
    wait_for(lambda: page.wait_for_timeout(20) or page.locator("#jobs-list li").count() == 2)
    show(1, until="events")
    page.wait_for_selector("#cancel", state="hidden")
    asked.clear()
    with page.expect_request("**/jobs?*"):  # at the end of what was left
        page.evaluate("held()")
    assert "events" not in asked
    page.evaluate(HOLD_ONE)
    page.route("**/stream", lambda route: route.fulfill(status=410, body="{}"))  # so that the result is read
    show(1, until="result")
    wait_for(lambda: page.wait_for_timeout(20) or page.evaluate("held !== null"))
    page.route("**/events", lambda route: None)
    show(0, until="events")
    page.evaluate("held()")
    page.wait_for_timeout(50)
    assert page.is_hidden("#report")


def test_a_list_that_comes_late_takes_no_newer_ones_place(page: Any, scan: Path) -> None:
    held: list[Any] = []
    page.select_option("#iterations", "1")
    page.set_input_files("#file", scan)
    page.click("#submit")
    page.locator("#jobs-list li").get_by_text("Download").wait_for()
    page.route("**/jobs?*", lambda route: held.append((route, route.fetch())), times=1)
    page.click("#jobs-refresh")
    wait_for(lambda: page.wait_for_timeout(20) or held)
    page.locator("#jobs-list li").get_by_text("Delete").click()
    page.wait_for_selector("#jobs", state="hidden")
    route, answer = held[0]
    with page.expect_response("**/jobs?*"):
        route.fulfill(response=answer)
    page.wait_for_timeout(50)
    assert page.is_hidden("#jobs")


@pytest.mark.parametrize(
    ("others", "are_hidden"),
    [(3, False), pytest.param(6, True, marks=pytest.mark.slow)],  # seven pages
)
def test_tabs_whose_jobs_wait_leave_connections_to_others_and_to_cancel(
    page: Any, server: RunningServer, scan: Path, others: int, are_hidden: bool
) -> None:
    """Over HTTP/1.1 a browser has six to a server, for all of its tabs; those that are not seen need none."""
    worker = server.worker_pid()
    os.kill(worker, signal.SIGSTOP)
    try:
        url = f"{server.url}/jobs?iterations=1"
        np.savetxt(few := io.BytesIO(), sphere(100))  # soon done, once the worker goes on
        urllib.request.urlopen(urllib.request.Request(url, few.getvalue(), method="POST")).close()
        wait_for(lambda: b'"queued"' not in urllib.request.urlopen(f"{server.url}/jobs").read())  # it has the worker
        tabs: list[Any] = []
        for _ in range(1 + others):
            tabs.append(tab := page.context.new_page() if tabs else page)  # in front: one behind others draws rarely
            tab.goto(server.url)
            tab.select_option("#iterations", "1")
            tab.set_input_files("#file", scan)
            tab.click("#submit")
            tab.locator("#status", has_text="Waiting").wait_for()
            if are_hidden and len(tabs) <= others:
                tab.evaluate(HIDE, True)
        if are_hidden:
            with tabs[1].expect_request("**/events"):
                tabs[1].evaluate(HIDE, False)
        tabs[-1].click("#cancel")
        tabs[-1].locator("#note", has_text="The job was canceled.").wait_for()
    finally:
        os.kill(worker, signal.SIGCONT)
    page.wait_for_selector("#report:not([hidden])")
    assert page.is_visible("#legend")
