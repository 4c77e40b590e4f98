from __future__ import annotations

import pytest

from straightpcf.service.api.negotiate import asks_for
from straightpcf.service.api.prefer import parse_prefer


@pytest.mark.parametrize(
    ("prefer", "finished", "applied"),
    [
        ("respond-async", False, "respond-async"),
        ("wait=10", True, "wait=10"),
        ("wait=10", False, "wait=10"),
        ("wait=90", True, "wait=90"),
        ("wait=90", False, None),  # the server waited for 60
        ("respond-async, wait=10", True, "wait=10"),
        ("respond-async, wait=10", False, "respond-async, wait=10"),
        ("respond-async, wait=90", False, "respond-async"),
        ("handling=strict", True, None),
    ],
)
def test_only_what_was_heeded_is_said_to_be_applied(prefer: str, finished: bool, applied: str | None) -> None:
    said = parse_prefer([prefer]).applied(finished=finished, longest=60)
    assert said.get("Preference-Applied") == applied


@pytest.mark.parametrize(
    ("lines", "respond_async", "wait"),
    [
        (["respond-async=false"], False, None),  # it has no value
        (["respond-async=true", "Respond-Async = 0"], False, None),
        (["respond-async=, wait=5"], True, 5.0),  # an empty value is none
        (['RESPOND-ASYNC = "" ; why=x, WAIT = "5"'], True, 5.0),
        (["respond-async; wait=5"], True, None),  # a parameter is no preference
        (["respond-async=false, respond-async", "wait=7, wait=8"], False, 7.0),  # the first one counts
        (["wait=soon, wait=8", "wait=9"], False, None),
        (['note="a, respond-async, wait=5, b", wait=6'], False, 6.0),  # commas in quotes
        (['note="an \\", respond-async, \\"", wait=6'], False, 6.0),
        (['note="open, respond-async', "wait=6"], False, 6.0),
        (['wait="5;6"', "respond-async"], True, None),
        (['wait="\\5"', "respond-async x", '"respond-async"', "=", ",,"], False, 5.0),
        (["wait=-1", "wait=²"], False, None),
        (["wait=5 6", "respond-async"], True, None),
    ],
)
def test_a_preference_is_read_as_rfc_7240_has_it(lines: list[str], respond_async: bool, wait: float | None) -> None:
    said = parse_prefer(lines)
    assert (said.respond_async, said.wait) == (respond_async, wait)


@pytest.mark.parametrize(
    ("header", "asked"),
    [
        ("text/event-stream", True), ("TEXT/Event-Stream; q=0.5, */*", True), ("*/*, text/event-stream;q=0", False),
        ("text/event-stream;q=0.000", False), ("text/event-streams", False), ("", False),
    ],
)  # fmt: skip
def test_what_a_client_asks_for_is_read_as_rfc_9110_has_it(header: str, asked: bool) -> None:
    assert asks_for(header, "text/event-stream") is asked


@pytest.mark.parametrize(
    ("header", "asked"),
    [
        ("a/json, b/patches", True),
        ("a/json;q=0.9, */*;q=0.1", True),
        ("a/json;q=0.5, B/patches", False),
        ("b/patches;q=0.4, a/json;q=0.5", True),
        ("b/patches", False),
        ("a/json;q=0, b/patches;q=0", False),
        ("a/json;q=0.1, */*", False),
        ("a/json, */*", True),
        ("a/json;q=0.5, b/*;q=0.4, */*", True),  # the narrowest that fits counts
        ("b/patches;q=0.4, a/json;q=0.5, B/*, */*", True),
        ("a/json;q=0.5, a/*;q=0.9", True),
    ],
)
def test_of_two_forms_the_one_with_more_weight_is_sent(header: str, asked: bool) -> None:
    assert asks_for(header, "a/json", over="b/patches") is asked
