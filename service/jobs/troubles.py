"""What goes wrong again and again, as while a disk is not mounted: said once, and again only when it changes."""

from __future__ import annotations

import logging

__all__ = ["Troubles"]

logger = logging.getLogger("uvicorn.error")  # the log that `straightpcf serve` shows


class Troubles:
    """Say troubles, each under what they keep from being done."""

    def __init__(self) -> None:
        self._said: dict[str, str] = {}

    def say(self, what: str, fault: BaseException) -> None:
        """Warn of it, if that was not the last that was said of this."""
        if self._said.get(what) != repr(fault):
            self._said[what] = repr(fault)
            logger.warning("%s: %r", what, fault)

    def over(self, what: str) -> None:
        """Tell that it was done; so that the next trouble is said, also the same."""
        if self._said.pop(what, None) is not None:
            logger.info("over: %s", what)
