"""The CPUs of this process, and how it uses them where it was forked."""

from __future__ import annotations

import os

__all__ = ["usable_cpus", "use_one_thread_if_forked"]

_IMPORTED_IN = os.getpid()


def usable_cpus() -> int:
    """Count the CPUs that this process may run on: under taskset, or in a container's set, fewer than there are."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def use_one_thread_if_forked() -> None:
    """Keep torch, in a process forked after the import, from waiting for OpenMP's threads: a fork has none of them."""
    if os.getpid() != _IMPORTED_IN:
        import torch

        torch.set_num_threads(1)
