"""How much is done, which unlike the time that it takes is the same on a busy machine."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

__all__ = ["at_most_lines"]


@contextmanager
def at_most_lines(most: int) -> Iterator[None]:
    """Fail where the block's calls run more lines of Python, as soon as they do."""
    ran = 0

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal ran
        ran += event == "line"
        assert ran <= most, f"more than {most} lines"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)
    assert ran <= most, f"more than {most} lines"  # whatever became of the error above
