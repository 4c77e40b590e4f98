"""A server under a path of a proxy: what it says of its own places leads there."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urljoin

import httpx2
import numpy as np
import pytest

from straightpcf.clients.sdk import Client
from tests.clouds import noisy, torus
from tests.conftest import clean_environment, run_server
from tests.proxy import behind_proxy

XYZ = noisy(torus(400), 0.01)
CLOUD = "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in XYZ).encode()


class Place(NamedTuple):
    proxied: str
    direct: str


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = tmp_path_factory.mktemp("behind")
    with run_server(folder, environment={"STRAIGHTPCF_ROOT_PATH": "/lab/straightpcf"}) as server:
        server.wait_until_ready()
        with behind_proxy(server.url, "/lab/straightpcf") as url:
            yield Place(proxied=url, direct=server.url)


def test_every_place_that_an_answer_names_is_found_through_the_proxy(place: Place) -> None:
    made = httpx2.post(f"{place.proxied}/jobs?filename=a.xyz&iterations=1", content=CLOUD)
    assert made.status_code == 202
    job = httpx2.get(urljoin(place.proxied, made.headers["location"]), params={"wait": 60}).json()
    assert job["state"] == "succeeded"
    listed = httpx2.get(f"{place.proxied}/jobs").json()["jobs"]
    events = httpx2.get(urljoin(place.proxied, job["links"]["events"])).text
    told = json.loads(re.findall(r"event: completed\ndata: (.*)", events)[0])
    assert made.json()["links"] == job["links"] == told["links"] == listed[0]["links"]
    for part in ("self", "events", "result", "stream", "report"):
        assert httpx2.get(urljoin(place.proxied, job["links"][part])).status_code == 200, part
    assert httpx2.post(urljoin(place.proxied, job["links"]["cancel"])).status_code == 200

    headers = {"Accept": "text/event-stream"}
    followed = httpx2.put(f"{place.proxied}/denoise/a.xyz", content=CLOUD, headers=headers, timeout=60)
    assert httpx2.get(urljoin(place.proxied, followed.headers["location"])).json()["state"] == "succeeded"


def test_the_documentation_and_the_page_find_their_parts_and_the_api(place: Place) -> None:
    for page, parts in (("/docs", 3), ("/", 4)):
        html = httpx2.get(place.proxied + page).text
        named = [part for part in re.findall(r'(?:src|href)="([^"]+)"', html) if not part.startswith("data:")]
        assert len(named) >= parts
        for part in named:
            assert httpx2.get(urljoin(place.proxied + page, part)).status_code == 200, part
    described = re.findall(r"url: '([^']+)'", httpx2.get(f"{place.proxied}/docs").text)[0]
    document = httpx2.get(urljoin(place.proxied, described)).json()
    assert document["servers"] == [{"url": "/lab/straightpcf"}]


def test_the_sdk_and_the_command_line_take_an_address_with_a_path(place: Place, tmp_path: Path) -> None:
    for url in (place.proxied, f"{place.proxied}/"):
        with Client(url) as client:
            job = client.jobs.create(XYZ, iterations=1)
            assert job.wait().state == "succeeded"
            assert job.result().xyz.shape == XYZ.shape
    (cloud := tmp_path / "a.xyz").write_bytes(CLOUD)
    command = [sys.executable, "-m", "straightpcf.clients.cli", "denoise", cloud, tmp_path / "b.xyz"]
    command += ["--iterations", "1", "--url", place.proxied]
    subprocess.run(command, check=True, env=clean_environment())
    assert np.loadtxt(tmp_path / "b.xyz").shape == XYZ.shape


@pytest.mark.parametrize("path", ["/docs/", "/jobs/a%20b/"])
def test_a_slash_too_many_leads_to_the_right_path_of_the_right_host(place: Place, path: str) -> None:
    """Of the host, the scheme and the path that a proxy shows, this server knows only what it is told."""
    for url in (place.proxied, place.direct):
        answer = httpx2.put(f"{url}{path}?limit=1", headers={"Host": "localhost"})
        where = urljoin(f"{url}{path}?limit=1", answer.headers["location"])
        assert (answer.status_code, where) == (307, f"{url}{path.rstrip('/')}?limit=1")


def test_probes_that_pass_the_proxy_by_need_no_path(place: Place) -> None:
    assert httpx2.get(f"{place.direct}/readyz").status_code == 200
