"""A CUDA device as torch's current one, its memory when it is full, and whether it answers at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch

from straightpcf.points.errors import TooLarge

__all__ = ["current", "enough_memory", "is_lost"]


def current(device: torch.device) -> AbstractContextManager[object]:
    """Make a device torch's current one: Triton launches, and graphs are captured, on no other."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


@contextmanager
def enough_memory(device: torch.device, points: int) -> Iterator[None]:
    """Raise TooLarge where a device runs out of memory for what is done with so many points at once."""
    try:
        yield
    except torch.OutOfMemoryError as exc:
        raise TooLarge(f"{device} has no memory for {points} points at once; a lower tile_points needs less") from exc


def is_lost(device: str) -> bool:
    """Say whether a device answers this process no more: after some errors only a new process can use it."""
    if device == "cpu":
        return False
    try:
        torch.cuda.synchronize(device)
    except (RuntimeError, AssertionError):  # AssertionError: of a torch without CUDA
        return True
    return False
