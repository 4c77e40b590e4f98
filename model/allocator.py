"""Keep glibc from handing large buffers back to the system after every tensor operation."""

from __future__ import annotations

import ctypes
import functools

__all__ = ["keep_large_buffers"]

# From malloc.h; the values are those of MALLOC_MMAP_THRESHOLD_, MALLOC_TRIM_THRESHOLD_ and MALLOC_TOP_PAD_.
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3
_LARGEST_THRESHOLD = 32 << 20  # glibc refuses more for M_MMAP_THRESHOLD
_KEPT = 1 << 30
_PAD = 64 << 20


@functools.cache
def keep_large_buffers() -> bool:
    """Set glibc's thresholds for this process; return False where the C library has none (musl, macOS)."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    settings = {_M_MMAP_THRESHOLD: _LARGEST_THRESHOLD, _M_TRIM_THRESHOLD: _KEPT, _M_TOP_PAD: _PAD}
    return all([mallopt(name, value) for name, value in settings.items()])
