"""One HTTP connection: closed where nothing comes on it and nothing is to be answered, so that no peer keeps it."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

__all__ = ["connection_class"]


def connection_class(*, idle_seconds: float) -> type[H11Protocol]:
    """Return uvicorn's protocol with patience for what comes in, whole requests or not, from the beginning on.

    uvicorn's own begins with an answer and ends with the next byte, be it of half a request or of a body that was
    refused. A peer that then vanishes (a laptop that is closed, a NAT that forgets) would keep its descriptor.
    """

    class Connection(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            self._be_patient()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._be_patient()

        def _be_patient(self) -> None:
            is_answering = self.cycle is not None and not self.cycle.response_complete
            if self.timeout_keep_alive_task is None and not is_answering:
                self.timeout_keep_alive_task = self.loop.call_later(idle_seconds, self.transport.close)

    return Connection
