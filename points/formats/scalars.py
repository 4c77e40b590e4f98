"""Attributes of one format as the scalar columns of another."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import UnsupportedCloud
from straightpcf.points.formats.positions import AXES

__all__ = ["check_columns", "further_columns", "meant", "not_held", "scalar_columns", "with_intensity"]

_NAME_CHARACTERS = 64
_WIDER = {"f2": "f4", "b1": "u1", "i8": "f8", "u8": "f8", "f16": "f8"}


def scalar_columns(
    attributes: Mapping[str, npt.NDArray[Any]], types: Collection[str], *, taken: Collection[str]
) -> dict[str, npt.NDArray[Any]]:
    """Return the numeric attributes as (N,) columns of the `types` (such as "f4") that a new file can hold.

    An (N, M) attribute becomes M columns; a type that is missing becomes the next that holds its numbers, or at least
    their size; names lose what a header cannot carry, and columns whose name is in `taken` or comes twice are numbered
    (`not_held` says which).
    """
    columns: dict[str, npt.NDArray[Any]] = {}
    used = dict.fromkeys(taken, 1)
    for name, values in attributes.items():
        if values.dtype.kind not in "biuf":
            continue
        parts = values.reshape(len(values), math.prod(values.shape[1:])).T
        for index, part in enumerate(parts):
            kind = part.dtype.str[1:]
            wide = _held_as(kind, types)
            plain = _plain(name)
            label = _free(plain if len(parts) == 1 else f"{plain}_{index}"[:_NAME_CHARACTERS], used)
            columns[label] = part.astype("<" + wide)
    return columns


def not_held(
    attributes: Mapping[str, npt.NDArray[Any]], types: Collection[str], *, taken: Collection[str] = AXES
) -> list[str]:
    """Name the attributes that `scalar_columns` leaves out, or whose numbers or names come out as others."""
    lost: list[str] = []
    used = dict.fromkeys(taken, 1)
    for name, values in attributes.items():
        kind, changes = values.dtype.str[1:], []
        if values.dtype.kind not in "biuf":
            lost.append(name)
            continue
        if (label := _free(_plain(name), used)) != name:
            changes.append(f"renamed to {label}")
        if (wide := _held_as(kind, types)) != kind:
            with np.errstate(invalid="ignore"):  # of what is beyond the type, and differs
                again = values.astype(wide).astype(values.dtype)
            if not np.array_equal(again, values, equal_nan=values.dtype.kind == "f"):
                changes.append(f"rounded to {np.dtype(wide).name}")
        if changes:
            lost.append(f"{name} ({', '.join(changes)})")
    return lost


def check_columns(attributes: Mapping[str, npt.NDArray[Any]], most: int, *, what: str) -> None:
    """Raise UnsupportedCloud where `scalar_columns` and the axes are more columns than are read again."""
    widths = {name: math.prod(values.shape[1:]) for name, values in attributes.items() if values.dtype.kind in "biuf"}
    if (total := len(AXES) + sum(widths.values())) > most:
        widest = max(widths, key=widths.__getitem__)
        raise UnsupportedCloud(
            f"x, y, z and the attributes are {total} columns, {widths[widest]} of them of {widest[:80]!r}; the limit "
            f"of {what} is {most}: ask for another format"
        )


def meant(names: Collection[str], known: Collection[str]) -> dict[str, str]:
    """Return, of the `known` names that are not among `names`, which of these each is: the only one that is alike.

    Programs write Intensity, ReturnNumber, GPS Time and scalar_Intensity for what LAS calls intensity and so on.
    """
    alike: dict[str, list[str]] = {}
    for name in names:
        alike.setdefault(_bare(name), []).append(name)
    found = {name: alike.get(_bare(name), []) for name in known if name not in names}
    return {name: several[0] for name, several in found.items() if len(several) == 1}


def with_intensity(attributes: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Return attributes with the one that is the intensity called so."""
    was = meant(attributes, ("intensity",)).get("intensity")
    return {"intensity" if name == was else name: values for name, values in attributes.items()}


def _bare(name: str) -> str:
    """Return a name without case, marks and what CloudCompare puts before those of a PLY file."""
    return re.sub(r"[\s_-]", "", name.lower().removeprefix("scalar_"))


def _held_as(kind: str, types: Collection[str]) -> str:
    return kind if kind in types else _WIDER.get(kind, "f8")


def further_columns(rows: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """Name the columns of an (N, M) array after the first three: column_4, column_5, ..."""
    return {f"column_{index + 1}": rows[:, index] for index in range(3, rows.shape[1])}


def _plain(name: str) -> str:
    """Return a name as any header can carry it; PCD takes one of nothing but `_` for padding."""
    plain = re.sub(r"[^A-Za-z0-9_.\-]", "_", name)[:_NAME_CHARACTERS]
    return plain if plain.strip("_") else "field"


def _free(label: str, used: dict[str, int]) -> str:
    """Return a label that is not used yet, numbered where it has to be, and note it; used: the last number of each."""
    free, number = label, used.get(label, 1)
    while free in used:
        number += 1
        free = f"{label}_{number}"
    used[label] = number
    used.setdefault(free, 1)
    return free
