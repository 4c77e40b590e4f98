"""The page at / in headless Chromium, and a scan to send."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.clouds import noisy, torus
from tests.conftest import RunningServer

__all__ = ["POINTS", "picture"]

POINTS = 1000
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_UNANSWERED = "Failed to load resource: net::ERR_"
FLAGS = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync",
    "--disable-component-update", "--use-gl=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip


@pytest.fixture(scope="module")  # not longer: while Playwright runs, asyncio.run in other tests is refused
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    with playwright.sync_playwright() as browsers:
        browser = browsers.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def page(browser: Any, server: RunningServer) -> Iterator[Any]:
    """The page, loaded, in a profile of its own; fails the test on any error in its console."""
    with browser.new_context(viewport={"width": 1200, "height": 800}) as profile:
        page = profile.new_page()
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        # A refused request is an error to the console, and what this page is there to explain.
        page.on("console", lambda said: errors.append(said.text) if _is_fault(said) else None)
        page.goto(server.url)
        yield page
    assert not errors


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    xyz = noisy(torus(POINTS), 0.01).astype("<f4")
    kinds = "".join(f"property float {name}\n" for name in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {POINTS}\n{kinds}end_header\n"
    (path := tmp_path / "scan.ply").write_bytes(head.encode() + xyz.tobytes())
    return path


def picture(page: Any) -> np.ndarray:
    """Return the viewer's picture, (height, width, 3) uint8."""
    from matplotlib.image import imread

    png = page.locator("#canvas").screenshot()
    return (imread(io.BytesIO(png), format="png")[..., :3] * 255).astype(np.uint8)


def _is_fault(said: Any) -> bool:
    if said.type != "error" or "/static/" in said.location.get("url", ""):
        return bool(said.type == "error")
    return not said.text.startswith(("Failed to load resource: the server responded with a status of 4", _UNANSWERED))
