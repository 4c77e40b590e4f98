"""Which positions moved, and how new ones are stored in the place of the old."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import NORMALS, PointCloud
from straightpcf.points.errors import UnsupportedCloud

__all__ = [
    "AXES",
    "WRITTEN",
    "axes_among",
    "changes",
    "check_held",
    "from_middle",
    "gathered",
    "moved",
    "narrowed",
    "number_text",
    "put_positions",
    "rounding",
    "scattered",
    "widened",
]

AXES = ("x", "y", "z")
_FAR = 1000  # times as far from the middle as half of all rows are: no point of a scan is
WRITTEN = frozenset(name for names in (AXES, ("X", "Y", "Z"), *NORMALS) for name in names)  # anew, in a file's place


def axes_among(names: Collection[str]) -> tuple[str, ...]:
    """Return what a file with fields of these `names` calls its axes: x y z, or X Y Z where it has those alone."""
    capitals = tuple(axis.upper() for axis in AXES)
    return capitals if set(capitals) <= {*names} and not {*AXES} & {*names} else AXES


def changes(
    cloud: PointCloud, xyz: npt.NDArray[np.float64], axes: tuple[str, ...]
) -> tuple[tuple[str, ...], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return what a file must hold in the place of what was read: the names of C columns, new (N, C), old (N, C).

    xyz: (N, 3) as read. The columns are the axes, as the file calls them, and the normals where the cloud has new ones.
    """
    if cloud.normals is None:
        return axes, cloud.xyz, xyz
    new, old = np.hstack([cloud.xyz, cloud.normals]), np.hstack([xyz, cloud.old_normals()])
    return (*axes, *cloud.normal_names), new, old


def moved(new: npt.NDArray[np.float64], old: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return (N, C) bool: which numbers differ; NaN equals NaN, so that what is stored keeps its bits."""
    changed: npt.NDArray[np.bool_] = new != old
    changed &= ~(np.isnan(new) & np.isnan(old))
    return changed


def check_held(xyz: npt.NDArray[np.float64], held: npt.ArrayLike, why: str) -> None:
    """Raise UnsupportedCloud with the first of (N, 3) points that a format does not hold; held: (N,), which it does."""
    if not np.all(held):
        row = int(np.argmin(held))
        raise UnsupportedCloud(f"point {row} is {xyz[row].tolist()}{why}")


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


def rounding(xyz: npt.NDArray[np.float64], stored: npt.NDArray[Any]) -> tuple[float, float]:
    """Return by how much positions (N, 3) are stored wrong at most, and half of their extent; of finite ones.

    Of those near most others: beside a row of zeros among UTM coordinates, or of 1e30, any error looks small.
    """
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.any():
        return 0.0, 0.0
    away = from_middle(xyz[finite])
    reach = float(np.median(away))
    near = away / _FAR <= reach if reach > 0 else np.ones(len(away), dtype=bool)
    rows = np.flatnonzero(finite)[near]
    half = float((xyz[rows].max(axis=0) / 2 - xyz[rows].min(axis=0) / 2).max())  # a difference may overflow
    return float(np.abs(stored[rows] - xyz[rows]).max()), half


def from_middle(xyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return how far finite positions (N, 3) are from their median along any axis, (N,), halved: it may overflow."""
    halves = xyz / 2
    away: npt.NDArray[np.float64] = np.abs(halves - np.median(halves, axis=0)).max(axis=1)
    return away


def put_positions(
    columns: Mapping[str, npt.NDArray[Any]],
    new: npt.NDArray[np.float64],
    old: npt.NDArray[np.float64],
    names: Sequence[str] = AXES,
) -> None:
    """Overwrite what changed in the named `columns`, writable (N,) float views of the file's own bytes."""
    changed = moved(new, old)
    for at, name in enumerate(names):
        rows, column = np.flatnonzero(changed[:, at]), columns[name]
        column[rows] = narrowed(new[rows, at], column.dtype, what=f"the new {name}")


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
