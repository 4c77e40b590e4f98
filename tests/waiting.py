"""Wait for what a server does in its own time."""

from __future__ import annotations

import time
from collections.abc import Callable

__all__ = ["wait_for"]


def wait_for(look: Callable[[], object], *, seconds: float = 20.0) -> None:
    """Look again and again until something true is seen; fail after so many seconds."""
    deadline = time.monotonic() + seconds
    while not look():
        assert time.monotonic() < deadline, f"not within {seconds:g} s"
        time.sleep(0.02)
