"""What a computation asks of numpy, on the CPU, and of torch, on a device, under one name."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

__all__ = ["Array", "namespace", "on_host"]

Array = Any  # an array of numpy or a tensor of torch; functions that take several take all of one kind


def namespace(array: Array) -> ModuleType:
    """Return numpy or torch: what an array is of. They name most operations alike, and take their axes by position."""
    return torch if isinstance(array, torch.Tensor) else np


def on_host(array: Array) -> npt.NDArray[Any]:
    """Return an array of numpy, fetched where it is a tensor."""
    fetched: npt.NDArray[Any] = array.cpu().numpy() if isinstance(array, torch.Tensor) else array
    return fetched
