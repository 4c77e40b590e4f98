"""One HTTP connection: closed where nothing comes or is taken for long, and where what comes is no HTTP."""

from __future__ import annotations

import asyncio
import logging
import math
import resource
import socket
import sys
from collections.abc import Callable
from typing import Any

import h11
from starlette.requests import Request
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from straightpcf.points.errors import InvalidRequest
from straightpcf.service.api.errors import OUT_OF_DESCRIPTORS, problem_response
from straightpcf.service.api.request_id import usable_id
from straightpcf.service.settings import Settings

__all__ = ["connection_class", "tell_briefly"]

_TWO_LENGTHS = frozenset({b"content-length", b"transfer-encoding"})
_CLOSE = (b"connection", b"close")
_AHEAD_BYTES = 2**16  # of further requests, held while one is answered; where it is more, TCP holds the rest
_LONGEST_USER_TIMEOUT = 2**31 - 1  # ms, what Linux takes
_TOLD_AGAIN_SECONDS = 10.0

logger = logging.getLogger("uvicorn.error")  # the log that `straightpcf serve` shows


def tell_briefly(loop: asyncio.AbstractEventLoop) -> None:
    """Let an event loop say in a line, and seldom, that connections wait for a file descriptor.

    asyncio itself tries each second as often as a listener may have connections wait, with a traceback each time:
    megabytes of log.
    """
    told = -math.inf

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        nonlocal told
        fault = context.get("exception")
        if not (isinstance(fault, OSError) and fault.errno in OUT_OF_DESCRIPTORS and "socket" in context):
            loop.default_exception_handler(context)
        elif loop.time() - told >= _TOLD_AGAIN_SECONDS:
            told = loop.time()
            most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            logger.warning("connections wait: %s (this process may have %d: ulimit -n)", fault.strerror, most)

    loop.set_exception_handler(handle)


def connection_class(settings: Settings) -> type[H11Protocol]:
    """Return uvicorn's protocol with patience for what comes in, whole requests or not, from the beginning on.

    uvicorn's own begins with an answer and ends with the next byte, be it of half a request or of a body that was
    refused. A peer that then vanishes (a laptop that is closed, a NAT that forgets) would keep its descriptor.
    """
    return type("Connection", (_Connection,), {"_settings": settings})


class _Connection(H11Protocol):
    _settings: Settings  # of its server
    _lingers = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; RFC 5482, of a closed window, too
            longest = min(round(self._settings.download_idle_seconds * 1000) or 1, _LONGEST_USER_TIMEOUT)
            own: socket.socket = transport.get_extra_info("socket")
            own.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, longest)
        self._be_patient()

    def data_received(self, data: bytes) -> None:
        if self._lingers:
            self._unset_keepalive_if_required()
        elif self.conn.their_state is not h11.MUST_CLOSE:  # behind its last request nothing counts (RFC 9112, 9.6)
            super().data_received(data)
            self._look_on()
        self._be_patient()

    def handle_events(self) -> None:
        """Answer a request with two lengths as one that asks to close: a proxy may have heeded the other.

        What that took for the rest of the body would else be a request of its own (RFC 9112, 6.1).
        """
        before = self.cycle
        super().handle_events()
        if self.cycle is before:
            return
        if _TWO_LENGTHS.issubset(name for name, _ in self.headers):
            self.headers.append(_CLOSE)
        self.cycle.default_headers = _AsItBegins(self.server_state, self.conn)  # type: ignore[assignment]
        self.cycle.transport = _Answering(self.transport, close=self._close_behind)  # type: ignore[assignment]

    def _close_behind(self) -> None:
        """Close behind an answer; where the body still comes, our half only, and let it come (RFC 9112, 9.6).

        A closed socket answers what comes with a reset, which takes the answer away from who has not read it yet.
        """
        if self.conn.their_state is h11.SEND_BODY and self.cycle.response_complete:
            self._lingers = True
            self.transport.write_eof()
        else:
            self.transport.close()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP, where no answer has begun, and close."""
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            if self.cycle is not None:
                self.cycle.disconnected = True  # of a body that broke off: the app's answer would be one more
            asked = Request({"type": "http", "request_id": usable_id(None)})
            problem = problem_response(asked, InvalidRequest(f"this is no HTTP/1.1: {sys.exc_info()[1]}"), 400)
            headers = [*self.server_state.default_headers, *problem.raw_headers, _CLOSE]  # Date is one of them
            head = h11.Response(status_code=400, headers=headers)
            for event in (head, h11.Data(data=bytes(problem.body)), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def _unsupported_upgrade_warning(self) -> None:
        """Warn of nothing: what would rather have HTTP/2 is answered all the same (RFC 9110, 7.8).

        Java's client asks for it with every request, and the warning says to install WebSockets.
        """

    def _look_on(self) -> None:
        """Read on where further requests wait for an answer to the first: else its client is not seen to go.

        uvicorn reads no more then, and what the client asked for would be worked on to its end, for nobody.
        """
        if self.conn.their_state is h11.DONE and len(self.conn.trailing_data[0]) <= _AHEAD_BYTES:
            self.flow.resume_reading()

    def _be_patient(self) -> None:
        is_answering = self.cycle is not None and not self.cycle.response_complete
        if self.timeout_keep_alive_task is None and not is_answering:
            self.timeout_keep_alive_task = self.loop.call_later(
                self._settings.upload_idle_seconds, self.transport.close
            )


class _AsItBegins:
    """The headers of every answer, when it begins: uvicorn takes its Date when the request came, minutes before.

    Whose client waits to be asked for its body (`Expect: 100-continue`), and is refused, is told that no other request
    is taken: it may leave the body out, and then the next one would be read as that (RFC 9110, 10.1.1).
    """

    def __init__(self, state: ServerState, conn: h11.Connection) -> None:
        self._state, self._conn = state, conn

    def __add__(self, own: list[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
        close = [_CLOSE] if self._conn.they_are_waiting_for_100_continue else []
        return self._state.default_headers + own + close


class _Answering:
    """A connection's transport, as one answer has it: closed in another way."""

    def __init__(self, transport: asyncio.Transport, *, close: Callable[[], None]) -> None:
        self._transport, self.close = transport, close

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)
