"""Attributes of one format as the scalar columns of another."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["further_columns", "not_held", "scalar_columns"]

_WIDER = {"f2": "f4", "b1": "u1", "i8": "f8", "u8": "f8", "f16": "f8"}


def scalar_columns(
    attributes: Mapping[str, npt.NDArray[Any]], types: Collection[str], *, taken: Collection[str]
) -> dict[str, npt.NDArray[Any]]:
    """Return the numeric attributes as (N,) columns of the `types` (such as "f4") that a new file can hold.

    An (N, M) attribute becomes M columns; a type that is missing becomes the next that holds its numbers, or at least
    their size (`not_held` says where); names
    lose what a header cannot carry, and columns whose name is in `taken` or comes twice are numbered.
    """
    columns: dict[str, npt.NDArray[Any]] = {}
    for name, values in attributes.items():
        if values.dtype.kind not in "biuf":
            continue
        parts = values.reshape(len(values), math.prod(values.shape[1:])).T
        for index, part in enumerate(parts):
            kind = part.dtype.str[1:]
            wide = _held_as(kind, types)
            label = _free(name if len(parts) == 1 else f"{name}_{index}", [*taken, *columns])
            columns[label] = part.astype("<" + wide)
    return columns


def not_held(attributes: Mapping[str, npt.NDArray[Any]], types: Collection[str]) -> list[str]:
    """Name the attributes that `scalar_columns` leaves out, or whose numbers no longer come out as they went in."""
    lost = []
    for name, values in attributes.items():
        kind = values.dtype.str[1:]
        if values.dtype.kind not in "biuf":
            lost.append(name)
        elif (wide := _held_as(kind, types)) != kind:
            with np.errstate(invalid="ignore"):  # of what is beyond the type, and differs
                again = values.astype(wide).astype(values.dtype)
            if not np.array_equal(again, values, equal_nan=values.dtype.kind == "f"):
                lost.append(f"{name} (rounded to {np.dtype(wide).name})")
    return lost


def _held_as(kind: str, types: Collection[str]) -> str:
    return kind if kind in types else _WIDER.get(kind, "f8")


def further_columns(rows: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """Name the columns of an (N, M) array after the first three: column_4, column_5, ..."""
    return {f"column_{index + 1}": rows[:, index] for index in range(3, rows.shape[1])}


def _free(name: str, used: Collection[str]) -> str:
    label = re.sub(r"[^A-Za-z0-9_.\-]", "_", name)[:64] or "field"
    free, number = label, 2
    while free in used:
        free, number = f"{label}_{number}", number + 1
    return free
