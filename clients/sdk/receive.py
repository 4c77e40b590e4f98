"""What takes the answer to one request, over as many connections as it needs; touches no network."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from straightpcf.clients.sdk.arguments import check_count
from straightpcf.clients.sdk.events import Completed, Event, parse_event
from straightpcf.clients.sdk.retry import Failure
from straightpcf.points.errors import ConnectionFailed, InvalidRequest, MalformedFile
from straightpcf.points.wire.jobs import MAX_EVENT_ID
from straightpcf.points.wire.patches import PatchFrame, PatchReader

__all__ = ["Body", "Events", "Patches", "Receiver"]


class Receiver(Protocol):
    """Take what comes back; `furthest` grows with what arrived, and then attempts are counted anew."""

    furthest: int
    value: Any

    def headers(self) -> Mapping[str, str]:
        """Return what the next attempt has to say beside the request."""

    def begin(self, status: int, headers: Mapping[str, str]) -> None:
        """Take the head of a successful response."""

    def write(self, item: Any) -> None:
        """Take the next bytes, or the next server-sent event."""

    def finish(self) -> Failure | None:
        """Say what is missing when a connection has ended, None if `value` is there."""


class Body:
    """Hold a whole JSON body, read by `parse`; without it none is expected (204)."""

    furthest = 0

    def __init__(self, parse: Callable[[Any], Any] | None = None) -> None:
        self._parse = parse
        self._bytes = bytearray()
        self.value: Any = None

    def headers(self) -> Mapping[str, str]:
        """Return nothing: a body has no middle to begin from."""
        return {}

    def begin(self, status: int, headers: Mapping[str, str]) -> None:
        """Begin anew."""
        self._bytes.clear()

    def write(self, item: bytes) -> None:
        """Take bytes."""
        self._bytes += item

    def finish(self) -> Failure | None:
        """Read them."""
        if self._parse is not None:
            try:
                self.value = self._parse(json.loads(self._bytes))
            except (ValueError, KeyError, TypeError) as exc:
                start = bytes(self._bytes[:80])
                error = ConnectionFailed(f"this is no StraightPCF server: {start!r} ({type(exc).__name__}: {exc})")
                return Failure(error=error, retryable=False, cause=exc)
        return None


class Events:
    """Follow a job; `take` hands out what came since it was last called. value: the job when it is finished."""

    def __init__(self, *, after: int = 0) -> None:
        """Begin behind event `after`; raises InvalidRequest where no event can have that number."""
        check_count("after", after)
        if after > MAX_EVENT_ID:
            raise InvalidRequest(f"after is {after!r:.80}; it must be the id of an event, {MAX_EVENT_ID} at most")
        self.furthest = int(after)
        self.value: Any = None
        self._came: list[Event] = []
        self._is_over = False

    def headers(self) -> Mapping[str, str]:
        """Go on behind the last event that arrived."""
        return {"Last-Event-ID": str(self.furthest)} if self.furthest else {}

    def begin(self, status: int, headers: Mapping[str, str]) -> None:
        """Take the head of a response: 204 says that `completed` was the last event that arrived."""
        self._is_over = status == 204

    def write(self, item: Any) -> None:
        """Take one server-sent event; raises ConnectionFailed for one that is no server's of ours."""
        try:
            event = parse_event(item.event, item.id or "", item.data)
        except (ValueError, KeyError, TypeError) as exc:
            told = f"{item.event[:20]!r} {item.data[:80]!r} ({type(exc).__name__}: {exc})"
            raise ConnectionFailed(f"this is no event of a StraightPCF server: {told}") from exc
        if event is None:
            return
        self.furthest = max(self.furthest, event.id)
        self._came.append(event)
        if isinstance(event, Completed):
            self.value = event.job

    def take(self) -> list[Event]:
        """Return the events that arrived."""
        came, self._came = self._came, []
        return came

    def finish(self) -> Failure | None:
        """Miss the `completed` event, if it did not come."""
        if self.value is not None or self._is_over:
            return None
        return Failure(error=ConnectionFailed("the events broke off before the job was finished"), retryable=True)


class Patches:
    """Take a patch stream; `take` hands out the frames that came since, each once."""

    def __init__(self) -> None:
        self.furthest = 0
        self.value: Any = None
        self._came: list[PatchFrame] = []
        self._reader = PatchReader()
        self._skip = 0
        self._ended = False

    def headers(self) -> Mapping[str, str]:
        """Return nothing: the server sends every frame again."""
        return {}

    def begin(self, status: int, headers: Mapping[str, str]) -> None:
        """Begin anew, without the frames that were handed out."""
        self._reader, self._skip = PatchReader(), self.furthest

    def write(self, item: bytes) -> None:
        """Take bytes; raises ConnectionFailed for what is no server's of ours."""
        try:
            frames = self._reader.feed(item)
        except MalformedFile as exc:
            raise ConnectionFailed(f"these are no patches of a StraightPCF server: {exc.message}") from exc
        for frame in frames:
            self._ended = self._ended or frame.end
            if self._skip > 0:
                self._skip -= 1
            elif not frame.end:
                self._came.append(frame)
                self.furthest += 1

    def take(self) -> list[PatchFrame]:
        """Return the frames that arrived."""
        came, self._came = self._came, []
        return came

    def finish(self) -> Failure | None:
        """Miss the end, if it did not come: the next attempt hears why."""
        if self._ended:
            return None
        return Failure(error=ConnectionFailed("the patches broke off before the job was finished"), retryable=True)
