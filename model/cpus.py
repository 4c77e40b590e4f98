"""The CPUs of this process, and how it uses them where it was forked."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

__all__ = ["usable_cpus", "use_one_thread_if_forked"]

_IMPORTED_IN = os.getpid()
_CGROUP, _CGROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def usable_cpus() -> int:
    """Count the CPUs that this process may use: under taskset or in a container's set, or by its share of their time,
    fewer than there are.
    """
    return min([_cpus(), *map(math.ceil, _shares())])


def _cpus() -> int:
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _shares() -> Iterator[float]:
    """Yield how many CPUs' time each control group around this process grants (`docker run --cpus`, Kubernetes' limits,
    systemd's CPUQuota). Threads beyond that use it up early and then all stand still.
    """
    with suppress(OSError):  # not Linux
        for line in _CGROUP.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if not controllers:  # version 2
                yield from _shares_in(_CGROUPS, path, "cpu.max")
            elif "cpu" in controllers.split(","):
                yield from _shares_in(_CGROUPS / "cpu", path, "cpu.cfs_quota_us", "cpu.cfs_period_us")


def _shares_in(root: Path, path: str, *names: str) -> Iterator[float]:
    """Yield what a control group and those above it say; in a container the path may be the host's: its own is root."""
    group = root / path.lstrip("/")
    for folder in (group, *group.parents):
        with suppress(OSError, ValueError):  # no such file, or "max": no limit
            quota, period = map(int, " ".join((folder / name).read_text() for name in names).split())
            if quota > 0 and period > 0:
                yield quota / period
        if folder == root:
            return


def use_one_thread_if_forked() -> None:
    """Keep torch, in a process forked after the import, from waiting for OpenMP's threads: a fork has none of them."""
    if os.getpid() != _IMPORTED_IN:
        import torch

        torch.set_num_threads(1)
