"""Whose names a server answers for: by DNS rebinding a web page would speak to it under its own."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

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
