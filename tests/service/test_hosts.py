"""Whose names a server answers for, and whose pages: by DNS rebinding one would speak to it under its own name."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from straightpcf.service.engine import Engine
from tests.service.in_process import serving
from tests.service.test_races import play, willing

OWN = ["localhost", "localhost:8000", "LocalHost.", "a.localhost:1", "127.0.0.1:8000", "127.8.9.1", "[::1]:8000"]
OTHER = [
    "evil.example",
    "evil.example:8000",
    "localhost.evil.example",
    "127.0.0.1.evil.example",
    "192.168.1.5",
    "[::2]",
]


async def answer_for(host: str, port: int, header: str, path: str = "/v1/info") -> bytes:
    reader, writer = await asyncio.open_connection(host, port)
    writer.write(f"GET {path} HTTP/1.1\r\nConnection: close\r\nHost: {header}\r\n\r\n".encode())
    answer = await reader.read()
    writer.close()
    return answer


def asked(folder: Path, headers: list[str], path: str = "/v1/info", **settings: Any) -> dict[str, bytes]:
    answers = {}

    async def scenario() -> None:
        async with serving(folder, willing(), **settings) as (_, host, port):
            for header in headers:
                answers[header] = await answer_for(host, port, header, path)

    play(scenario)
    return answers


def refused(answers: dict[str, bytes]) -> list[str]:
    return [header for header, answer in answers.items() if answer.startswith(b"HTTP/1.1 421 ")]


def test_a_server_without_keys_on_loopback_answers_for_loopback_alone(tmp_path: Path) -> None:
    answers = asked(tmp_path, OWN + OTHER)
    assert refused(answers) == OTHER
    for header in OTHER:
        assert b"content-type: application/problem+json" in answers[header].lower()
        assert b'"code":"misdirected_request"' in answers[header]
        assert b"x-request-id: " in answers[header].lower()


@pytest.mark.parametrize("path", ["/", "/jobs", "/metrics", "/openapi.json"])
def test_nothing_of_it_is_shown_to_others(tmp_path: Path, path: str) -> None:
    assert refused(asked(tmp_path, ["localhost", "evil.example"], path)) == ["evil.example"]


def test_hosts_that_are_named_are_answered(tmp_path: Path) -> None:
    named = asked(tmp_path, OTHER, allowed_hosts="192.168.1.5, Evil.example")
    assert refused(named) == [
        host for host in OTHER if host not in ("evil.example", "evil.example:8000", "192.168.1.5")
    ]


def test_a_server_with_keys_or_on_another_address_answers_for_any(tmp_path: Path) -> None:
    assert not refused(asked(tmp_path / "keys", OTHER, api_keys="alpha"))
    assert not refused(asked(tmp_path / "open", OTHER, host="0.0.0.0"))


async def answer_to(line: str, host: str, port: int) -> bytes:
    reader, writer = await asyncio.open_connection(host, port)
    writer.write(f"{line} HTTP/1.1\r\nConnection: close\r\nHost: localhost\r\n\r\n".encode())
    answer = await reader.read()
    writer.close()
    return answer


@pytest.mark.parametrize("root", ["", "/lab"])
def test_a_request_line_may_name_the_host_and_that_counts(tmp_path: Path, root: str) -> None:
    """As in RFC 9112, 3.2.2, of clients that take this server for their proxy, and of proxies that pass it on so."""
    lines = {
        "GET http://localhost:8000/livez": b"200",
        "GET HTTP://me@127.0.0.1/jobs?limit=1": b"200",
        "GET http://localhost/jobs?limit=0": b"422",
        "GET http://localhost": b"200",
        "GET http://localhost/http://localhost/livez": b"404",
        "DELETE https://localhost/jobs/a%20b": b"404",
        "GET http://evil.example/livez": b"421",
        "GET //livez": b"200",  # of a proxy that takes /lab off a path, and puts / before what is left
        "GET livez": b"200",  # or /lab/ off, and puts nothing
        "DELETE ///jobs/a%20b": b"404",
        "OPTIONS *": b"404",
    }

    async def scenario() -> None:
        async with serving(tmp_path, willing(), root_path=root) as (_, host, port):
            for line, status in lines.items():
                answer = await answer_to(line, host, port)
                assert answer.split()[1] == status, line
                assert b"'a b'" in answer or "%20" not in line

    play(scenario)


OWN_PAGES = ["http://localhost:8000", "https://127.0.0.1", "http://[::1]:1", "http://a.localhost:3000"]
OTHER_PAGES = [
    "http://evil.example",
    "https://evil.example:8000",
    "http://localhost.evil.example",
    "null",
    "http://[::",
]


async def posted(host: str, port: int, origin: str, method: str = "POST", path: str = "/jobs") -> bytes:
    reader, writer = await asyncio.open_connection(host, port)
    head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nOrigin: {origin}\r\n"
    writer.write(f"{head}Content-Length: 6\r\nContent-Disposition: attachment; filename=a.xyz\r\n\r\n1 2 3\n".encode())
    answer = await reader.read()
    writer.close()
    return answer


def turned_away(folder: Path, *, method: str = "POST", path: str = "/jobs", **settings: Any) -> list[str]:
    """Return the pages for which a server does nothing."""
    answers = {}

    async def scenario() -> None:
        async with serving(folder, willing(), **settings) as (_, host, port):
            for origin in OWN_PAGES + OTHER_PAGES:
                answers[origin] = await posted(host, port, origin, method, path)

    play(scenario)
    refused = {origin: answer for origin, answer in answers.items() if answer.startswith(b"HTTP/1.1 403 ")}
    assert all(b'"code":"cross_origin"' in answer for answer in refused.values())
    return [*refused]


@pytest.mark.parametrize(("method", "path"), [("POST", "/jobs"), ("POST", "/denoise"), ("DELETE", "/jobs/a")])
def test_a_server_without_keys_on_loopback_does_nothing_for_other_hosts_pages(
    tmp_path: Path, method: str, path: str
) -> None:
    assert turned_away(tmp_path, method=method, path=path) == OTHER_PAGES


def test_pages_that_are_named_may_have_work_done(tmp_path: Path) -> None:
    named = turned_away(tmp_path / "named", cors_origins="http://evil.example", allowed_hosts="localhost.evil.example")
    assert named == [page for page in OTHER_PAGES if page not in ("http://evil.example", OTHER_PAGES[2])]
    assert not turned_away(tmp_path / "all", cors_origins="*")


def test_looking_is_left_to_the_browser_and_keys_keep_pages_out(tmp_path: Path) -> None:
    assert not turned_away(tmp_path / "get", method="GET", path="/v1/info")
    assert not turned_away(tmp_path / "keys", api_keys="alpha")


def test_a_named_page_can_read_an_unforeseen_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def fail(engine: Engine, id: str, *, owner: str = "") -> None:
        raise RuntimeError("nobody foresaw it")

    monkeypatch.setattr(Engine, "get", fail)
    answers = []

    async def scenario() -> None:
        async with serving(tmp_path, willing(), cors_origins="https://friend.example") as (_, host, port):
            for origin in ("https://friend.example", "https://stranger.example"):
                answers.append(await posted(host, port, origin, "GET", "/jobs/a"))

    play(scenario)
    for answer in answers:
        assert answer.startswith(b"HTTP/1.1 500 ")
        head, body = answer.lower().split(b"\r\n\r\n")
        assert json.loads(body)["code"] == "internal_error"
        assert f"x-request-id: {json.loads(body)['request_id']}".encode() in head
    seen = [b"access-control-allow-origin: https://friend.example\r\n" in answer for answer in answers]
    assert seen == [True, False]
