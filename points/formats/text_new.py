"""A new table of text: columns of numbers, each the shortest text that reads back as it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.formats.colours import RGB, in_8_bits
from straightpcf.points.formats.positions import AXES
from straightpcf.points.formats.scalars import scalar_columns, with_intensity
from straightpcf.points.formats.xyz_layout import PTS_COLUMNS

__all__ = ["TEXT_TYPES", "axis_columns", "intensity_and_colour", "lost_of_colour", "table_lines"]

TEXT_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")


def axis_columns(cloud: PointCloud) -> dict[str, npt.NDArray[Any]]:
    """Return x, y and z, (N,) each."""
    return {axis: cloud.xyz[:, index] for index, axis in enumerate(AXES)}


def intensity_and_colour(cloud: PointCloud) -> dict[str, npt.NDArray[Any]]:
    """Return what PTS and PTX have of the attributes: intensity, 0 where only a colour is there, and 8 bits of it."""
    return _pts_columns(in_8_bits(with_intensity(cloud.attributes)))


def lost_of_colour(cloud: PointCloud) -> list[str]:
    """Name what is neither intensity nor colour, or has other numbers there."""
    held = in_8_bits(with_intensity(cloud.attributes))
    columns = _pts_columns(held)
    there = [name for name in columns if name in held]
    other = [name for name in there if not np.array_equal(held[name], columns[name], equal_nan=True)]
    rounded = (f"{name} (rounded to uint8)" if name in RGB else name for name in other)
    return [*cloud.beside, *(name for name in held if name not in columns), *rounded]


def table_lines(above: list[str], columns: dict[str, npt.NDArray[Any]], separator: str) -> bytes:
    """Return a table of (N,) columns below some lines."""
    rows = map(separator.join, zip(*(_texts(values) for values in columns.values()), strict=True))
    lines = [*above, *rows]
    return "\n".join([*lines, ""]).encode() if lines else b""


def _pts_columns(attributes: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """Return what a .pts file has of attributes, their colour in 8 bits where it can be: see PTS_COLUMNS."""
    columns = scalar_columns({n: attributes[n] for n in PTS_COLUMNS[7] if n in attributes}, TEXT_TYPES, taken=AXES)
    if not all(name in columns and columns[name].dtype.str[1:] in ("u1", "u2") for name in RGB):
        return {name: columns[name] for name in ("intensity",) if name in columns}
    intensity = columns.get("intensity", np.zeros(len(columns["red"]), np.uint8))
    rgb = {name: columns[name] >> 8 if columns[name].itemsize > 1 else columns[name] for name in RGB}
    return {"intensity": intensity, **rgb}


def _texts(values: npt.NDArray[Any]) -> list[str]:
    """Write (N,) numbers as the shortest texts that read back as the same numbers of their type."""
    texts = values.astype(str).tolist() if values.dtype == np.float32 else map(repr, values.tolist())
    return [text.removesuffix(".0") for text in texts]  # a label stays a whole number
