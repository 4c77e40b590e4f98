"""Processes that begin while signals to the group are kept from them: their parent heeds those, and ends them."""

from __future__ import annotations

import signal
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker

__all__ = ["signals_kept"]


@contextmanager
def signals_kept(numbers: Collection[signal.Signals]) -> Iterator[None]:
    """Keep these signals from processes that begin meanwhile, until they let them through again themselves."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # which else begins here, and lets them through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
