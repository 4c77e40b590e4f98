"""Attributes of one format as the scalar columns of another."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from typing import Any

import numpy.typing as npt

__all__ = ["further_columns", "scalar_columns"]

_WIDER = {"f2": "f4", "b1": "u1", "i8": "f8", "u8": "f8", "f16": "f8"}


def scalar_columns(
    attributes: Mapping[str, npt.NDArray[Any]], types: Collection[str], *, taken: Collection[str]
) -> dict[str, npt.NDArray[Any]]:
    """Return the numeric attributes as (N,) columns of the `types` (such as "f4") that a new file can hold.

    An (N, M) attribute becomes M columns; a type that is missing becomes the next that holds its numbers; names
    lose what a header cannot carry, and columns whose name is in `taken` or comes twice are numbered.
    """
    columns: dict[str, npt.NDArray[Any]] = {}
    for name, values in attributes.items():
        if values.dtype.kind not in "biuf":
            continue
        parts = values.reshape(len(values), math.prod(values.shape[1:])).T
        for index, part in enumerate(parts):
            kind = part.dtype.str[1:]
            wide = kind if kind in types else _WIDER.get(kind, "f8")
            label = _free(name if len(parts) == 1 else f"{name}_{index}", [*taken, *columns])
            columns[label] = part.astype("<" + wide)
    return columns


def further_columns(rows: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """Name the columns of an (N, M) array after the first three: column_4, column_5, ..."""
    return {f"column_{index + 1}": rows[:, index] for index in range(3, rows.shape[1])}


def _free(name: str, used: Collection[str]) -> str:
    label = re.sub(r"[^A-Za-z0-9_.\-]", "_", name)[:64] or "field"
    free, number = label, 2
    while free in used:
        free, number = f"{label}_{number}", number + 1
    return free
