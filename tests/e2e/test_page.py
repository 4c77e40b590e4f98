"""The page at / in headless Chromium, as a user has it."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from straightpcf.points.formats import read_cloud
from tests.clouds import noisy, sphere
from tests.conftest import RunningServer
from tests.e2e.conftest import POINTS, picture
from tests.proxy import behind_proxy
from tests.waiting import wait_for


def test_a_file_is_denoised_shown_and_downloaded(page: Any, scan: Path, tmp_path: Path) -> None:
    page.set_input_files("#file", scan)
    page.wait_for_selector("#empty", state="hidden")
    before = picture(page)
    page.select_option("#iterations", "1")
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    figures = page.inner_text("#figures")
    assert f"{POINTS:,}" in figures
    assert page.is_visible("#legend")
    page.wait_for_timeout(500)  # a frame or two of the viewer
    after = picture(page)
    assert (before != after).any(axis=2).mean() > 0.02, "the viewer still shows the noisy cloud"
    with page.expect_download() as download:
        page.click("#download")
    download.value.save_as(tmp_path / "clean.ply")
    clean, _ = read_cloud(tmp_path / "clean.ply")
    noisy_, _ = read_cloud(scan)
    assert clean.xyz.shape == (POINTS, 3)
    assert 0 < np.abs(clean.xyz - noisy_.xyz).max() < 0.2


def test_the_page_works_under_a_path_of_a_proxy(page: Any, scan: Path, server: RunningServer, tmp_path: Path) -> None:
    with behind_proxy(server.url, "/lab/straightpcf") as url:
        page.goto(f"{url}/")
        page.set_input_files("#file", scan)
        page.select_option("#iterations", "1")
        page.click("#submit")
        page.wait_for_selector("#report:not([hidden])")
        with page.expect_download() as download:
            page.click("#download")
        download.value.save_as(tmp_path / "clean.ply")
        page.goto("about:blank")
    assert len(read_cloud(tmp_path / "clean.ply")[0]) == POINTS


def test_the_api_is_documented_without_a_way_out(page: Any, server: RunningServer) -> None:
    elsewhere: list[str] = []
    page.on(
        "request",
        lambda asked: None if asked.url.startswith((server.url, "data:", "blob:")) else elsewhere.append(asked.url),
    )
    page.goto(f"{server.url}/docs")
    page.wait_for_selector("text=/denoise >> nth=0")
    assert not elsewhere


def test_a_broken_file_is_explained_and_the_page_goes_on(page: Any, scan: Path, tmp_path: Path) -> None:
    (broken := tmp_path / "broken.ply").write_bytes(scan.read_bytes()[:-50])
    page.set_input_files("#file", broken)
    page.click("#submit")
    page.wait_for_selector("#error:not([hidden])")
    assert "vert" in page.inner_text("#error")
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    assert page.is_hidden("#error")


def test_a_file_that_has_changed_is_named_and_can_be_chosen_again(page: Any, scan: Path) -> None:
    page.set_input_files("#file", scan)
    page.wait_for_selector("#empty", state="hidden")
    os.utime(scan, (0, 0))
    page.select_option("#iterations", "1")
    page.click("#submit")
    page.wait_for_selector("#error:not([hidden])")
    assert page.inner_text("#error") == "scan.ply has changed or is gone since it was chosen; choose it again."
    with page.expect_file_chooser() as chooser:
        page.click("#file")
    assert page.input_value("#file") == "", "the same file again would be no change"
    chooser.value.set_files(scan)
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")


def test_what_is_dropped_is_taken_or_explained(page: Any, scan: Path, tmp_path: Path) -> None:
    (folder := tmp_path / "scans").mkdir()
    _drop(page, "#drop", files=[str(folder)])
    assert page.inner_text("#error").strip() == "scans is a folder; drop the files in it, one at a time."
    assert page.inner_text("#chosen") == "Choose a file"
    _drop(page, "#drop", files=[str(scan), str(folder.parent / "scan.ply")])
    assert page.inner_text("#chosen") == "scan.ply"
    assert "the first of 2 files, which go one at a time" in page.inner_text("#chosen-note")
    assert page.is_hidden("#error")
    page.fill("#seed", "")
    _drop(page, "#seed", items=[{"mimeType": "text/plain", "data": "7"}])
    assert page.input_value("#seed") == "7"
    page.fill("#seed", "1e3")
    page.click("#submit")
    assert page.inner_text("#error").strip().startswith("The seed is 1e3; it must be a whole number in 0..4294967295")


def test_a_browser_that_keeps_nothing_for_a_page_denoises_all_the_same(page: Any, scan: Path) -> None:
    denied = "get() { throw new DOMException('denied', 'SecurityError') }"
    page.add_init_script(f"Object.defineProperty(window, 'sessionStorage', {{ {denied} }})")
    page.reload()
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    assert "scan.ply" in page.inner_text("#jobs-list")


def test_points_that_are_nan_are_no_error_to_the_console(page: Any, tmp_path: Path) -> None:
    xyz = noisy(sphere(500), 0.01)
    xyz[::3] = np.nan
    np.save(path := tmp_path / "depth.npy", xyz)
    page.set_input_files("#file", path)
    page.wait_for_selector("#empty", state="hidden")
    page.wait_for_timeout(300)  # a frame or two; the fixture looks at the console


def test_a_canceled_job_is_no_error_and_the_next_one_is_shown_as_it_came_out(
    page: Any, scan: Path, tmp_path: Path
) -> None:
    np.save(large := tmp_path / "large.npy", noisy(sphere(40_000), 0.01))
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    page.click("#before")
    wait_for(lambda: page.input_value("#blend") == "0")
    page.set_input_files("#file", large)
    page.click("#submit")
    page.wait_for_selector("#status:has-text('Pass')")
    assert page.input_value("#blend") == "1"
    page.click("#cancel")
    page.wait_for_selector("#cancel", state="hidden")
    assert page.is_hidden("#error")
    assert "canceled" in page.inner_text("#note")


@pytest.mark.parametrize("how", ["canceled", "cut off"])
def test_no_job_is_left_of_what_was_sent_without_an_answer(
    page: Any, scan: Path, server: RunningServer, how: str
) -> None:
    held: list[Any] = []
    deleted: list[int] = []
    page.route("**/jobs/*?*", lambda route: held.append(route))
    page.on("response", lambda answer: deleted.append(answer.status) if answer.request.method == "DELETE" else None)
    page.set_input_files("#file", scan)
    page.click("#submit")
    wait_for(lambda: page.wait_for_timeout(50) or held)
    if how == "canceled":
        page.click("#cancel")
    else:
        held[0].abort()
    page.wait_for_selector("#cancel", state="hidden")
    wait_for(lambda: page.wait_for_timeout(50) or deleted)
    # The server was still reading it.
    assert httpx2.put(held[0].request.url, content=scan.read_bytes()).status_code == 202
    wait_for(lambda: page.wait_for_timeout(50) or deleted[-1] == 204)
    assert httpx2.get(f"{server.url}/jobs").json()["jobs"] == []
    assert ("does not answer" in page.inner_text("#error")) == (how == "cut off")


def test_the_keyboard_alone_does_it_and_the_focus_is_never_lost(page: Any, scan: Path, tmp_path: Path) -> None:
    focused = "document.activeElement.id"
    np.save(large := tmp_path / "large.npy", noisy(sphere(40_000), 0.01))
    page.set_input_files("#file", large)
    page.focus("#submit")
    page.keyboard.press("Enter")
    page.wait_for_selector("#status:has-text('Pass')")
    assert page.evaluate(focused) == "submit"
    page.keyboard.press("Enter")  # another time sends nothing
    page.keyboard.press("Tab")
    assert page.evaluate(focused) == "cancel"
    page.keyboard.press("Enter")
    page.wait_for_selector("#cancel", state="hidden")
    assert page.evaluate(focused) == "submit"
    assert page.locator("#jobs-list li").count() == 1
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    for at, then in ("submit", "report-title"), ("canvas", "canvas"):
        page.focus("#submit")
        page.keyboard.press("Enter")
        page.focus(f"#{at}")
        page.wait_for_selector("#cancel:not([hidden])")
        page.wait_for_selector("#cancel", state="hidden")
        assert page.is_visible("#report")
        assert page.evaluate(focused) == then


def test_what_is_shown_before_a_result_is_of_the_file_that_was_sent(page: Any, scan: Path, tmp_path: Path) -> None:
    np.save(other := tmp_path / "other.npy", 3 + noisy(sphere(POINTS), 0.01))  # as many points, elsewhere
    page.select_option("#iterations", "1")
    page.set_input_files("#file", scan)
    page.click("#submit")
    page.set_input_files("#file", other)  # while the first one runs
    page.wait_for_selector("#report:not([hidden])")
    page.click("#submit")
    page.wait_for_selector("#report", state="hidden")
    page.wait_for_selector("#report:not([hidden])")
    assert float(page.inner_text("#legend-top").split()[0].replace(",", "")) < 0.5


def test_a_result_is_shown_though_its_patches_never_come(page: Any, scan: Path) -> None:
    page.evaluate("() => { const on = setTimeout; window.setTimeout = (act, ms) => on(act, ms === 10000 ? 300 : ms); }")
    held: list[Any] = []
    page.route("**/stream", lambda route: held.append(route))
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    assert held
    assert page.is_visible("#legend"), "the viewer has only the noisy cloud"


def test_what_was_said_of_a_job_on_its_way_is_gone_from_below_its_result(
    page: Any, server: RunningServer, tmp_path: Path
) -> None:
    np.save(large := tmp_path / "large.npy", noisy(sphere(6000), 0.01))
    page.set_input_files("#file", large)
    page.click("#submit")
    page.wait_for_selector("#status:has-text('Pass')")
    os.kill(server.worker_pid(), signal.SIGKILL)
    page.wait_for_selector("#note:has-text('starts again')")
    page.wait_for_selector("#report:not([hidden])", timeout=60_000)
    assert page.inner_text("#note") == ""


def test_deleting_what_is_shown_takes_it_away_and_keeps_the_focus(page: Any, scan: Path) -> None:
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    for _ in range(2):
        page.click("#submit")
        page.wait_for_selector("#cancel:not([hidden])")
        page.wait_for_selector("#cancel", state="hidden")
    assert page.is_visible("#report")
    page.locator("#jobs-list li").nth(1).wait_for()
    page.locator("#jobs-list li").nth(0).get_by_text("Delete").click()
    page.wait_for_selector("#report", state="hidden")
    wait_for(lambda: page.locator("#jobs-list li").count() == 1)
    assert page.is_hidden("#error")
    assert "deleted" in page.inner_text("#note")
    wait_for(lambda: page.evaluate("document.activeElement.closest('#jobs-list') !== null"))


def test_ones_jobs_are_listed_however_many_came_after_them(page: Any, scan: Path) -> None:
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    page.route("**/jobs?limit=*", lambda route: route.fulfill(json={"jobs": [], "next_cursor": "more"}))
    page.reload()
    page.locator("#jobs-list li").get_by_text("Show").wait_for()
    assert page.locator("#jobs-list li").count() == 1


def test_two_jobs_of_one_file_are_told_apart_by_name(page: Any, scan: Path) -> None:
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    for made in (1, 2):
        page.click("#submit")
        page.locator("#jobs-list a").nth(made - 1).wait_for()
    names = page.locator("#jobs-list li .name").all_inner_texts()
    assert names == [f"{scan.name} (2)", scan.name]
    labels = [each.get_attribute("aria-label") for each in page.locator("#jobs-list [aria-label]").all()]
    assert len(set(labels)) == len(labels) == 6


def test_an_upload_is_not_lost_to_a_look_at_another_job(page: Any, scan: Path, tmp_path: Path) -> None:
    np.save(large := tmp_path / "large.npy", noisy(sphere(40_000), 0.01))
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    held: list[Any] = []
    page.route("**/jobs/*?*filename=large*", lambda route: held.append(route))
    page.set_input_files("#file", large)
    page.click("#submit")
    wait_for(lambda: bool(page.wait_for_timeout(50) or held))
    page.locator("#jobs-list li").get_by_text("Show").click()
    assert "being sent" in page.inner_text("#error")
    held[0].continue_()
    page.wait_for_selector("#status:has-text('Pass')")
    page.click("#cancel")
    page.wait_for_selector("#cancel", state="hidden")


def test_a_key_is_kept_through_a_reload(page: Any) -> None:
    page.evaluate("sessionStorage.setItem('straightpcf.key', 'secret')")
    page.reload()
    page.wait_for_selector("#server:has-text('version')")
    assert page.input_value("#key") == "secret"
    assert page.is_visible("#key")


def test_enter_in_the_field_of_the_key_takes_it_and_sends_nothing(page: Any) -> None:
    page.evaluate("sessionStorage.setItem('straightpcf.key', 'secret')")
    page.reload()
    page.wait_for_selector("#server:has-text('version')")
    page.fill("#key", "other")
    with page.expect_response("**/v1/info"):
        page.press("#key", "Enter")
    assert page.evaluate("sessionStorage.getItem('straightpcf.key')") == "other"
    assert page.is_hidden("#error")


def test_an_answer_of_a_proxy_that_wants_a_login_is_explained(page: Any, scan: Path) -> None:
    for path in ("**/jobs/*?*", "**/jobs?*"):
        page.route(path, lambda route: route.fulfill(body="<html>Log in</html>", content_type="text/html"))
    page.set_input_files("#file", scan)
    page.click("#submit")
    page.wait_for_selector("#error:not([hidden])")
    assert "log in" in page.inner_text("#error")
    assert page.is_hidden("#cancel")
    page.evaluate("sessionStorage.setItem('straightpcf.jobs', '[\"a\"]')")
    page.reload()
    page.wait_for_selector("#error:has-text('log in')")


@pytest.mark.parametrize(("status", "said"), [(413, "proxy.*no file of this size"), (403, "proxy.*403")])
def test_an_error_of_a_proxy_is_not_taken_for_the_servers(page: Any, scan: Path, status: int, said: str) -> None:
    html = {"body": "<html>nginx</html>", "content_type": "text/html"}
    page.route("**/jobs/*?*", lambda route: route.fulfill(status=status, **html))
    page.set_input_files("#file", scan)
    page.click("#submit")
    page.wait_for_selector("#error:not([hidden])")
    assert re.search(said, page.inner_text("#error"))


def test_lengths_are_written_as_people_read_them(page: Any) -> None:
    values = [0, 2.5e-16, 0.00012345, 0.5, 9.996, 12.345, 999.7, 1234.4, -98765.4, 5.4e6, None]
    said = ["0", "2.50e-16", "0.000123", "0.5", "10", "12.3", "1,000", "1,234", "-98,765", "5.40e+6", "unknown"]
    asked = (
        "async (values) => { const { length } = await import('/static/text.js'); return values.map((v) => length(v)) }"
    )
    assert page.evaluate(asked, values) == said


def test_the_ends_of_a_legend_differ_where_they_do(page: Any) -> None:
    asked = "async (two) => (await import('/static/text.js')).ends(...two)"
    for two, said in (
        ([0, 0.01234], ["0", "0.0123"]),
        ([100.01, 100.0234], ["100.01", "100.02"]),
        ([1234.56, 1234.58], ["1,234.56", "1,234.58"]),
        ([5400000.25, 5400000.75], ["5.400000e+6", "5.400001e+6"]),
        ([7, 7], ["7", "7"]),
    ):
        assert page.evaluate(asked, two) == said


def test_where_nothing_moved_the_legend_says_so(page: Any, scan: Path) -> None:
    page.set_input_files("#file", scan)
    page.select_option("#iterations", "1")
    page.fill("#strength", "0")
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    assert (page.inner_text("#legend-low"), page.inner_text("#legend-top")) == ("0", "0")


def test_points_of_one_height_are_shown(page: Any, tmp_path: Path) -> None:
    """The page cannot read NPZ, and so colours the result by height."""
    flat = np.c_[np.random.default_rng(0).uniform(0, 50, (POINTS, 2)), np.full(POINTS, 1000.0)]
    np.savez(tmp_path / "flat.npz", points=flat)
    page.set_input_files("#file", tmp_path / "flat.npz")
    page.wait_for_selector("#note:has-text('does not read .npz files: only')")  # whatever their size
    page.select_option("#iterations", "1")
    page.fill("#strength", "0")
    page.click("#submit")
    page.wait_for_selector("#report:not([hidden])")
    assert (page.inner_text("#legend-low"), page.inner_text("#legend-top")) == ("1,000", "1,000")
    page.wait_for_timeout(500)  # a frame or two of the viewer
    lowest = (0x44 / 255, 0x01 / 255, 0x54 / 255)  # which fades with depth
    assert (np.abs(picture(page) / 255 - lowest).max(axis=2) < 0.25).mean() > 0.02


def _drop(page: Any, where: str, *, files: list[str] | None = None, items: list[dict[str, str]] | None = None) -> None:
    box = page.locator(where).bounding_box()
    at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    data = {"items": items or [], "files": files or [], "dragOperationsMask": 1}
    chromium = page.context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        chromium.send("Input.dispatchDragEvent", {"type": kind, **at, "data": data})
    page.wait_for_timeout(300)
