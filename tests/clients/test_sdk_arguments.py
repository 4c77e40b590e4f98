"""Arguments of the SDK that are not of their kind are named, and nothing is sent."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from straightpcf.clients.sdk import AsyncClient, Client, Job
from straightpcf.points.errors import ConnectionFailed, InvalidRequest

NOBODY = "http://127.0.0.1:9"


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        *[("url", value) for value in (None, 5, b"http://127.0.0.1:9")],
        *[("api_key", value) for value in (5, b"key")],
        *[("timeout", value) for value in ("5", 0, -1, float("nan"), float("inf"))],
        *[("max_retries", value) for value in (None, "3", -1, 1.5)],
    ],
)
def test_a_client_names_the_argument_that_cannot_be(argument: str, value: Any) -> None:
    for kind in (Client, AsyncClient):
        with pytest.raises(InvalidRequest, match=f"^{argument} is "):
            kind(**{"url": NOBODY, argument: value})


@pytest.mark.parametrize("url", [NOBODY, NOBODY.replace("http", "grpc")])
def test_numbers_of_other_libraries_are_numbers(url: str) -> None:
    with Client(url, timeout=np.float32(1), max_retries=np.int64(0)) as client:  # type: ignore[arg-type]
        for timeout in (None, np.float32(5)):
            with pytest.raises(ConnectionFailed):
                client.denoise(np.zeros((40, 3)), timeout=timeout)  # type: ignore[arg-type]


def test_a_call_names_the_argument_that_is_of_another_kind() -> None:
    xyz: Any = np.zeros((40, 3))
    with Client(NOBODY) as client:
        job = Job(client._transport, SimpleNamespace(id="1", finished=True, report=None))  # type: ignore[arg-type]
        wrong: dict[str, Any] = {"format": 5, "name": b"a.xyz", "id": 5, "idempotency_key": b"key"}
        calls: list[tuple[str, Any]] = [
            *[(name, partial(client.jobs.create, xyz, **{name: value})) for name, value in wrong.items()],
            ("target", partial(client.denoise, xyz, 5)),
            ("target", partial(job.result, b"out.xyz")),
            ("timeout", partial(client.denoise, xyz, timeout="5")),
            ("timeout", partial(job.wait, timeout=float("nan"))),
            ("on_progress", partial(client.denoise, xyz, on_progress=5)),
            ("on_progress", partial(job.wait, on_progress=_told)),
            *[("after", lambda after=after: next(job.events(after=after))) for after in ("1", 1.0, 10**9, 10**99)],
            ("states", lambda: list(client.jobs.list(states=5))),  # type: ignore[arg-type]
            ("state", lambda: list(client.jobs.list(states=["queued", 5]))),  # type: ignore[list-item]
            ("page_size", lambda: list(client.jobs.list(page_size="5"))),  # type: ignore[arg-type]
        ]
        for argument, call in calls:
            with pytest.raises(InvalidRequest, match=f"^{argument} is "):
                call()


@pytest.mark.parametrize("key", [" key", "key ", " "])
def test_an_idempotency_key_that_no_header_carries_as_it_is_is_refused(key: str) -> None:
    with Client(NOBODY) as client, pytest.raises(InvalidRequest, match="begins or ends with a space"):
        client.jobs.create(np.zeros((40, 3)), idempotency_key=key)


async def _told(progress: float) -> None:
    raise AssertionError(progress)
