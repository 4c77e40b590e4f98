"""How long nothing has moved in a call, and its end when that is too long: gRPC has deadlines for whole calls alone."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Protocol

__all__ = ["Silence"]


class _Cancellable(Protocol):
    def cancel(self) -> object: ...


class Silence:
    """Count the seconds in which the other side neither sends nor takes anything; seconds: to bear, None for any.

    What this side does meanwhile, as on a slow disk, is not the other's silence: `ours` begins it, `theirs` ends it.
    was_too_long: the call was cancelled for it.
    """

    def __init__(self, seconds: float | None) -> None:
        self.seconds = math.inf if seconds is None else seconds
        self.was_too_long = False
        self._since = time.monotonic()

    def ours(self) -> None:
        """Something came or was taken, and this side is busy with it."""
        self._since = math.inf

    def theirs(self) -> None:
        """The other side is waited for from now on."""
        self._since = time.monotonic()

    @contextmanager
    def watched(self, call: _Cancellable) -> Iterator[None]:
        """Cancel a call of ordinary code when its silence is too long; one that is left early, too."""
        over = threading.Event()

        def watch() -> None:
            while not over.wait(self._look_again()):
                if self._is_too_long():
                    self.was_too_long = True
                    call.cancel()
                    return

        if self.seconds < math.inf:
            threading.Thread(target=watch, daemon=True, name="straightpcf-silence").start()
        try:
            yield
        finally:
            over.set()
            call.cancel()  # which nothing comes of where it has ended

    @asynccontextmanager
    async def watched_here(self, call: _Cancellable) -> AsyncIterator[None]:
        """Do as `watched`, in a coroutine."""

        async def watch() -> None:
            while not self._is_too_long():
                await asyncio.sleep(self._look_again())
            self.was_too_long = True
            call.cancel()

        watching = asyncio.ensure_future(watch()) if self.seconds < math.inf else None
        try:
            yield
        finally:
            if watching is not None:
                watching.cancel()
            call.cancel()

    def _is_too_long(self) -> bool:
        return time.monotonic() - self._since >= self.seconds

    def _look_again(self) -> float:
        return min(self.seconds, max(0.0, self._since + self.seconds - time.monotonic()))
