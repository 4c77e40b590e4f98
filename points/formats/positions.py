"""Which positions moved, and how new ones are stored in the place of the old."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import UnsupportedCloud

__all__ = ["AXES", "gathered", "moved", "narrowed", "number_text", "put_positions", "scattered", "widened"]

AXES = "xyz"


def moved(new: npt.NDArray[np.float64], old: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return (N, 3) bool: which coordinates differ; NaN equals NaN, so that what is stored keeps its bits."""
    changed: npt.NDArray[np.bool_] = new != old
    changed &= ~(np.isnan(new) & np.isnan(old))
    return changed


def widened(columns: Sequence[npt.NDArray[Any]]) -> npt.NDArray[np.float64]:
    """Stack a file's x, y and z, three (N,) float columns, to (N, 3) float64; a signalling NaN is no warning."""
    with np.errstate(invalid="ignore"):
        return np.stack([column.astype(np.float64) for column in columns], axis=1)


def narrowed(values: npt.NDArray[np.float64], dtype: np.dtype[Any], *, what: str) -> npt.NDArray[Any]:
    """Cast (K,) float64 to a file's float type; raises UnsupportedCloud where a finite value has no place in it."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        stored = values.astype(dtype)
    lost = np.isinf(stored) & np.isfinite(values)
    if lost.any():
        raise UnsupportedCloud(f"{what} {values[lost][0]:g} does not fit into {dtype.name}, which the file declares")
    return stored


def put_positions(
    columns: Sequence[npt.NDArray[Any]], new: npt.NDArray[np.float64], old: npt.NDArray[np.float64]
) -> None:
    """Overwrite the moved coordinates in `columns`, three writable (N,) float views of the file's own bytes."""
    changed = moved(new, old)
    for axis, column in enumerate(columns):
        rows = np.flatnonzero(changed[:, axis])
        column[rows] = narrowed(new[rows, axis], column.dtype, what=f"the new {AXES[axis]}")


def gathered(raw: bytes, offsets: npt.NDArray[np.int64], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return (K,) values of `dtype` that begin at (K,) byte offsets anywhere in `raw`."""
    size = dtype.itemsize
    out = np.empty((len(offsets), size), np.uint8)
    buffer = np.frombuffer(raw, np.uint8)
    for byte in range(size):
        out[:, byte] = buffer[offsets + byte]
    values: npt.NDArray[Any] = out.view(dtype).reshape(len(offsets))
    return values


def scattered(raw: bytearray, offsets: npt.NDArray[np.int64], values: npt.NDArray[Any]) -> None:
    """Store (K,) values at (K,) byte offsets of `raw`: the inverse of `gathered`."""
    size = values.dtype.itemsize
    rows = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), size)
    buffer = np.frombuffer(raw, np.uint8)
    for byte in range(size):
        buffer[offsets + byte] = rows[:, byte]


def number_text(values: npt.NDArray[np.float64]) -> list[bytes]:
    """Write (K,) float64 as the shortest text that reads back as the same numbers."""
    return [repr(value).encode() for value in values.tolist()]
