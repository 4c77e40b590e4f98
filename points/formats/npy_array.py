"""One array in NPY layout, in a file of its own or inside a NPZ; never unpickled."""

from __future__ import annotations

import ast
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import check_count, check_room
from straightpcf.points.formats.positions import AXES, put_positions
from straightpcf.points.formats.scalars import further_columns

__all__ = [
    "HEADER_BYTES",
    "MAGIC",
    "NpyHeader",
    "columns_of",
    "new_array",
    "patched",
    "positions_header",
    "read_header",
    "view",
]

MAGIC = b"\x93NUMPY"
HEADER_BYTES = 10_000 + 12  # what numpy itself takes of a header, and what stands before it
MAX_COLUMNS = 4096
_FEWEST = 33  # points that are filtered: of fewer rows, that many columns are the points
_AXES = (("x", "y", "z"), ("X", "Y", "Z"))
_FLOATS = re.compile(r"[<>=|]?f[248]")
_PYTHON_2 = re.compile(r"(\d)L(?=[,)])")  # (400L, 3L)
_PLAIN = re.compile(r"[<>=|]?([biufc][1-9][0-9]?|[SU][1-9][0-9]{0,4})")


@dataclass(frozen=True)
class NpyHeader:
    """Describe an array; size: bytes before its data.  descr: as written, a string, or a list of a record's fields."""

    descr: Any  # of whatever type a literal has
    shape: tuple[int, ...]
    fortran: bool
    size: int

    @property
    def is_positions(self) -> bool:
        """Say whether this is an (N, >= 3) array of 16, 32 or 64 bit floats, or (N,) records with such x, y, z."""
        if self.axes is not None:
            return True
        is_float = isinstance(self.descr, str) and _FLOATS.fullmatch(self.descr) is not None
        return is_float and len(self.shape) == 2 and self.shape[1] >= 3

    @property
    def axes(self) -> tuple[str, str, str] | None:
        """Name the positions' fields in (N,) records; None of another array."""
        if not isinstance(self.descr, list) or len(self.shape) != 1:
            return None
        try:
            fields = self.dtype
        except (TypeError, ValueError, SyntaxError, RecursionError):
            return None
        floats = {name for name in fields.names or () if _FLOATS.fullmatch(fields[name].str)}
        return next((three for three in _AXES if floats.issuperset(three)), None)

    def is_attribute_of(self, count: int) -> bool:
        """Say whether this holds plain numbers or texts, one row for each of `count` points and not too wide."""
        is_plain = isinstance(self.descr, str) and _PLAIN.fullmatch(self.descr) is not None
        is_row_each = len(self.shape) in (1, 2) and self.shape[0] == count
        return is_plain and is_row_each and math.prod(self.shape[1:]) <= MAX_COLUMNS

    @property
    def dtype(self) -> np.dtype[Any]:
        """Return the type of an array that `is_positions` or `is_attribute_of` some."""
        return np.lib.format.descr_to_dtype(self.descr)

    @property
    def data_bytes(self) -> int:
        """Return the bytes of the data of an array that has a `dtype`."""
        return math.prod(self.shape) * self.dtype.itemsize


def read_header(head: bytes, *, where: str) -> NpyHeader:
    """Parse the header at the beginning of `head` (HEADER_BYTES of the array are enough)."""
    if not head.startswith(MAGIC):
        raise MalformedFile(f"{where} does not begin with the NPY magic, but with {head[:6]!r}")
    check_room(8, len(head), what=f"the NPY header of {where}")
    version = tuple(head[6:8])
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise MalformedFile(f"{where} has NPY version {'.'.join(map(str, version))}; 1.0, 2.0 and 3.0 exist")
    begin = 10 if version == (1, 0) else 12
    length = int.from_bytes(head[8:begin], "little")
    if begin + length > HEADER_BYTES:
        raise MalformedFile(f"{where} declares an NPY header of {length} bytes; the limit is {HEADER_BYTES - begin}")
    check_room(begin + length, len(head), what=f"the NPY header of {where}")
    text = head[begin : begin + length]
    try:
        said = text.decode("utf-8" if version == (3, 0) else "latin-1")
        entries = ast.literal_eval(_PYTHON_2.sub(r"\1", said) if version == (1, 0) else said)
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as exc:
        raise MalformedFile(f"the NPY header of {where} is no Python literal: {text[:60]!r}") from exc
    if not isinstance(entries, dict) or set(entries) != {"descr", "fortran_order", "shape"}:
        raise MalformedFile(f"the NPY header of {where} must hold descr, fortran_order and shape: {text[:60]!r}")
    shape, fortran = entries["shape"], entries["fortran_order"]
    if not isinstance(shape, tuple) or not all(type(n) is int and 0 <= n < 2**62 for n in shape):
        raise MalformedFile(f"{where} has the shape {str(shape)[:60]}, which is no tuple of whole numbers >= 0")
    if not isinstance(fortran, bool):
        raise MalformedFile(f"{where} has fortran_order {str(fortran)[:60]}, which is neither True nor False")
    return NpyHeader(entries["descr"], shape, fortran, begin + length)


def positions_header(head: bytes, *, where: str, max_points: int) -> NpyHeader:
    """Parse a header that must be of an (N, >= 3) float array of at most `max_points` rows."""
    header = read_header(head, where=where)
    descr = str(header.descr)[:60]
    if _has_objects(header.descr):
        raise UnsupportedCloud(f"{where} holds Python objects ({descr}); they are never unpickled")
    shape = str(header.shape)[:60]
    if not header.is_positions:
        is_image = len(header.shape) > 2 and header.shape[-1] == 3  # of a depth camera, or a batch of one
        hint = "; reshape(-1, 3) makes such rows of it" if is_image else ""
        raise UnsupportedCloud(
            f"{where} has shape {shape} and type {descr}; positions are (N, >= 3) floats f2, f4, f8"
            f", or (N,) records with such x, y, z{hint}"
        )
    if header.axes is None and 3 <= header.shape[0] < _FEWEST <= header.shape[1]:
        raise UnsupportedCloud(f"{where} has shape {shape}, more columns than rows; a point is a row: transpose it")
    if header.axes is None and header.shape[1] > MAX_COLUMNS:
        raise UnsupportedCloud(f"{where} has {header.shape[1]} columns; the limit is {MAX_COLUMNS}")
    check_count(header.shape[0], max_points, where=where)
    return header


def _has_objects(descr: object) -> bool:
    """Look for the type code of Python objects in a type as written: a text, or a list of (name, type, ...)."""
    if isinstance(descr, str):
        return descr.lstrip("<>=|").startswith("O")
    fields = descr if isinstance(descr, list) else []
    return any(_has_objects(field[1]) for field in fields if isinstance(field, tuple) and len(field) > 1)


def columns_of(
    raw: bytes | bytearray, header: NpyHeader
) -> tuple[list[npt.NDArray[Any]], dict[str, npt.NDArray[Any]], tuple[str, ...]]:
    """View the three (N,) columns of positions behind a header, those beside them, and which fields are none."""
    table = view(raw, header)
    if header.axes is None:
        return [table[:, axis] for axis in range(3)], further_columns(table), ()
    fields = {name: table[name] for name in header.dtype.names or () if name not in header.axes}
    plain = {name: values for name, values in fields.items() if _is_plain(values)}
    return [table[name] for name in header.axes], plain, tuple(name for name in fields if name not in plain)


def _is_plain(values: npt.NDArray[Any]) -> bool:
    return values.dtype.kind in "biufcSU" and values.ndim <= 2 and math.prod(values.shape[1:]) <= MAX_COLUMNS


def view(raw: bytes | bytearray, header: NpyHeader) -> npt.NDArray[Any]:
    """View the (N, M) or (N,) array behind a header."""
    values = np.frombuffer(raw, dtype=header.dtype, count=math.prod(header.shape), offset=header.size)
    return values.reshape(header.shape, order="F" if header.fortran else "C")


def patched(
    raw: bytes, header: NpyHeader, new: npt.NDArray[np.float64], old: npt.NDArray[np.float64]
) -> bytes | bytearray:
    """Return the array's bytes with the moved positions replaced."""
    if not len(new):
        return raw
    out = bytearray(raw)
    axes, *_ = columns_of(out, header)
    put_positions(dict(zip(AXES, axes, strict=True)), new, old)
    return out


def new_array(xyz: npt.NDArray[np.float64]) -> bytes:
    """Return (N, 3) float64 positions as a version 1.0 NPY array."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({len(xyz)}, 3), }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    data = np.ascontiguousarray(xyz, "<f8").tobytes()
    return MAGIC + b"\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + data
