"""XYZ, CSV, PTS: one point a line of text, as scanners and spreadsheets have it; only moved tokens change."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import NORMALS, PointCloud
from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import Format, check_count
from straightpcf.points.formats.colours import RGB, are_shares, unpacked
from straightpcf.points.formats.positions import AXES
from straightpcf.points.formats.scalars import check_columns, scalar_columns
from straightpcf.points.formats.text import (
    Lines,
    as_integers,
    as_numbers,
    blocks,
    refuse_binary,
    replaced,
    shown,
)
from straightpcf.points.formats.text_new import (
    TEXT_TYPES,
    axis_columns,
    intensity_and_colour,
    lost_of_colour,
    table_lines,
)
from straightpcf.points.formats.titles import MARKS, MAX_COLUMNS
from straightpcf.points.formats.xyz_layout import NO_COMMA, Layout, read_layout

__all__ = ["Csv", "Pts", "Tsv", "Xyz"]

MAX_LINE_BYTES = 1 << 23
_COUNTED = 10  # points: of fewer, an x may go up by one each
_SIX = tuple(f"column_{column + 1}" for column in range(6))
_UNIT_ERROR = 1e-2  # of a normal's length, by the digits of a text
_LOOKED_AT = 1 << 14  # bytes of the first rows, which tell decimal commas from cells
# Three numbers or more, each of two cells between commas: 0,5, 1,5, 2,5.
_PAIRS = re.compile(rb"\s*[+-]?\d+,\d+(?:,\s*[+-]?\d+,\d+){2,}\s*")
_WHOLE, _UNSIGNED = np.dtype(np.int64), np.dtype(np.uint64)
_Offsets = npt.NDArray[np.int64]


@dataclass(frozen=True)
class XyzSource:
    """Hold the whole file, the (N, 3) byte offsets of its position tokens, and the positions read from them.

    format: the name of the one that it was read as.
    """

    format: str
    layout: Layout
    raw: bytes
    starts: _Offsets
    ends: _Offsets
    xyz: npt.NDArray[np.float64]


class Xyz(Format):
    """Read and write text tables of at least three columns between white space, commas or semicolons.

    x, y, z are the columns that a line of names above the table says, and the first three where there is none
    (`titles`). Refused are names of more than three columns that say nothing of positions, or that are of more or fewer
    columns than the table has, and more than three columns without names whose first counts the points, or whose first
    two number a scanner's rows and columns. Between commas or semicolons a cell that is empty, `NA` or `null` is NaN,
    and one in quotes may hold them. Comment lines (`#`, `//`), blank lines, lines with the number of points and columns
    of any text are kept.
    """

    name = "xyz"
    suffixes: ClassVar[tuple[str, ...]] = (".xyz", ".txt", ".asc", ".xyzn", ".xyzrgb")
    media_type = "text/plain"
    has_magic = False
    delimiter: ClassVar[bytes | None] = None  # of a new file; None for a space
    marks: ClassVar[tuple[bytes, ...]] = MARKS  # that may be between cells
    types = TEXT_TYPES
    is_counted: ClassVar[bool] = False  # a new file begins with the number of points

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read the table; further columns of numbers become float64 attributes, int64 or uint64 where they need to."""
        raw = path.read_bytes()
        refuse_binary(raw, 0)
        layout = read_layout(raw, self.marks)
        if not layout.is_named and layout.delimiter == b",":
            _refuse_decimal_commas(raw[layout.begin : layout.begin + _LOOKED_AT], layout.line)
        if layout.declared is not None:
            check_count(layout.declared, max_points, f"line {layout.line - 1}")
        starts, ends, columns, texts = _table(raw, layout, max_points)
        if not layout.is_named:
            _refuse_counted(columns, layout.line)
            if len(starts) and all(raw[starts[0, axis] : ends[0, axis]].isdigit() for axis in (0, 1)):
                _refuse_numbered(columns, layout.line)
        xyz = np.stack([columns.pop(axis) for axis in layout.axes], axis=1)
        names = _meant(columns) if layout.names == _SIX else layout.names
        attributes = {names[column]: values for column, values in columns.items()}
        source = XyzSource(self.name, layout, raw, starts, ends, xyz.copy())
        return PointCloud(xyz, attributes, source, beside=tuple(layout.names[column] for column in texts))

    def left_behind(self, cloud: PointCloud) -> list[str]:
        """Name nothing where the table that was read has the layout."""
        source = cloud.source
        is_kept = isinstance(source, XyzSource) and self._has_layout(source.layout)
        return [] if is_kept else super().left_behind(cloud)

    def check(self, cloud: PointCloud) -> None:
        """Raise UnsupportedCloud where a new file has more columns than one may."""
        if not self.is_counted and self._own(cloud) is None:  # a counted one has seven at most
            check_columns(unpacked(cloud.attributes), MAX_COLUMNS, what=f"{self.name} tables")

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the file that was read with the moved positions replaced, or a new one if it is laid out otherwise."""
        if (source := self._own(cloud)) is not None:
            path.write_bytes(replaced(source.raw, source.starts, source.ends, cloud.xyz, source.xyz))
        else:
            self.check(cloud)
            path.write_bytes(self._new_file(cloud))

    def _new_file(self, cloud: PointCloud) -> bytes:
        """Lay out x, y, z and every numeric attribute; their names stand above if there are any."""
        columns = axis_columns(cloud) | scalar_columns(unpacked(cloud.in_columns()), TEXT_TYPES, taken=AXES)
        separator = " " if self.delimiter is None else self.delimiter.decode()
        names = ("# " if self.delimiter is None else "") + separator.join(columns)
        return table_lines([names] if len(columns) > 3 else [], columns, separator)

    def _own(self, cloud: PointCloud) -> XyzSource | None:
        """Return the file that was read, where it is written again."""
        source = cloud.source
        is_own = isinstance(source, XyzSource) and (source.format == self.name or self._has_layout(source.layout))
        return source if is_own else None

    def _has_layout(self, layout: Layout) -> bool:
        return layout.delimiter == self.delimiter and (layout.declared is not None) == self.is_counted


class Csv(Xyz):
    """Do as `Xyz`; a new table has commas, and names above if there are attributes."""

    name = "csv"
    suffixes = (".csv",)
    media_type = "text/csv"
    delimiter = b","


class Tsv(Xyz):
    """Do as `Xyz`, but tabs are between cells, which may be empty or hold spaces; a file without any is read as that.

    A new table has names above if there are attributes.
    """

    name = "tsv"
    suffixes = (".tsv",)
    media_type = "text/tab-separated-values"
    delimiter = b"\t"
    marks = (b"\t", *MARKS)


class Pts(Xyz):
    """Do as `Xyz`; a new table has the number of points above, and no names: x y z, intensity, red green blue."""

    name = "pts"
    suffixes = (".pts",)
    is_counted = True

    def left_behind(self, cloud: PointCloud) -> list[str]:
        """Name what is neither intensity nor colour, or has other numbers there."""
        source = cloud.source
        if isinstance(source, XyzSource) and self._has_layout(source.layout):
            return []
        return lost_of_colour(cloud)

    def _new_file(self, cloud: PointCloud) -> bytes:
        """Lay out what the format has columns for; with a colour, intensity is there."""
        return table_lines([str(len(cloud))], axis_columns(cloud) | intensity_and_colour(cloud), " ")


def _table(
    raw: bytes, layout: Layout, max_points: int
) -> tuple[_Offsets, _Offsets, dict[int, npt.NDArray[Any]], list[int]]:
    """Return the (N, 3) starts and ends of the position tokens, every column of numbers, and which are of text.

    A column without a name and with nothing in it is what a delimiter at the end of every line makes: none.
    """
    starts, ends = [np.empty((0, 3), np.int64)], [np.empty((0, 3), np.int64)]
    parts: dict[int, list[npt.NDArray[Any]]] = {column: [np.empty(0)] for column in range(len(layout.names))}
    line, count, declared = layout.line, 0, layout.declared
    texts, unsaid = [], {column for column, name in enumerate(layout.names) if name == f"column_{column + 1}"}
    for lines, _ in blocks(raw, layout.begin, delimiter=layout.delimiter, longest=MAX_LINE_BYTES):
        is_row = _is_row(lines)
        if declared is not None:
            further = np.flatnonzero(is_row & (lines.counts == 1))
            is_row[further] = False
            declared += _scans(lines.pick(further), line + further)
        rows = np.flatnonzero(is_row)
        table, numbers = lines.pick(rows), line + rows
        line, count = line + len(lines), count + len(rows)
        check_count(count, max_points, "the file")
        _check_columns(table, numbers, len(layout.names))
        for column in list(parts):
            token = table.first + column
            if column in unsaid and (table.starts[token] < table.ends[token]).any():
                unsaid.remove(column)
            if (values := _column(table, column, layout, numbers)) is not None:
                parts[column].append(values)
            else:
                texts.append(column)  # it stays in the file
                del parts[column]
        tokens = table.first[:, None] + np.array(layout.axes)
        starts.append(table.starts[tokens])
        ends.append(table.ends[tokens])
    if declared not in (None, count):
        raise MalformedFile(f"the file declares {declared} points and holds {count}")
    there = {*layout.axes} | ({*parts} - unsaid)
    columns = {column: _joined(values) for column, values in parts.items() if column in there}
    return np.concatenate(starts), np.concatenate(ends), columns, sorted(texts)


def _column(table: Lines, column: int, layout: Layout, numbers: _Offsets) -> npt.NDArray[Any] | None:
    """Read a column of rows with these line numbers, (K,); None where it is text. Raises MalformedFile of an axis."""
    token = table.first + column
    begins, stops = table.starts[token], table.ends[token]
    values, bad = as_numbers(table.raw, begins, stops, may_miss=layout.delimiter is not None)
    if bad is None:
        has_ids = column not in layout.axes and _is_beyond_doubles(values)
        return _whole(table, token, values) if has_ids else values
    if column not in layout.axes:
        return None
    text = table.raw[begins[bad] : stops[bad]]
    hint = f"; {NO_COMMA}" if _has_decimal_comma(text, layout.delimiter) else ""
    raise MalformedFile(f"line {numbers[bad]}, column {column + 1}: {shown(text)} is no number{hint}")


def _meant(columns: Mapping[int, npt.NDArray[Any]]) -> tuple[str, ...]:
    """Name six columns without names: x y z, and normals or a colour where the last three can be nothing else."""
    if not {3, 4, 5} <= columns.keys():
        return _SIX
    behind = np.stack([columns[column].astype(np.float64) for column in (3, 4, 5)], axis=1)
    if _are_normals(behind):
        return *AXES, *NORMALS[0]
    return (*AXES, *RGB) if are_shares(behind) else _SIX  # Open3D's .xyzrgb


def _are_normals(normals: npt.NDArray[np.float64]) -> bool:
    """Say whether (N, 3) numbers are normals, as in files of MeshLab and CGAL, and in `.xyzn`.

    Told by their length, of those that are not 0, and by a number below 0: colours of 0 to 1 have none.
    """
    with np.errstate(over="ignore"):
        lengths = np.sqrt((normals**2).sum(axis=1))
    lengths = lengths[~(lengths == 0)]
    return len(lengths) > 0 and bool((np.abs(lengths - 1) < _UNIT_ERROR).all() and (normals < 0).any())


def _has_decimal_comma(text: bytes, delimiter: bytes | None) -> bool:
    """Say whether a cell looks like 0,5, or, where commas were taken for delimiters, like what is between two such."""
    return re.fullmatch(rb"[+-]?\d+,\d+" + (rb"|\d+(\s+[+-]?\d+)+" if delimiter == b"," else b""), text) is not None


def _refuse_decimal_commas(raw: bytes, line: int) -> None:
    """Raise where the first rows read as numbers with decimal commas that commas separate: there would be two of each.

    Told by white space before every number, and none inside, or by decimals that are equally many and begin with 0.
    """
    rows = [row for row in raw.splitlines() if row.strip() and not row.startswith((b"#", b"//"))]
    rows = rows[:-1] if len(rows) > 1 and len(raw) == _LOOKED_AT else rows  # the last may be cut
    if not rows or not all(_PAIRS.fullmatch(row) for row in rows):
        return
    are_apart = all(mark[-1:].isspace() for row in rows for mark in re.findall(rb"\d+,\d+(,\s*)", row))
    decimals = [cell for row in rows for cell in row.split(b",")[1::2]]
    are_alike = len({len(cell.strip()) for cell in decimals}) == 1 and any(
        cell.startswith(b"0") and len(cell.strip()) > 1 for cell in decimals
    )
    if are_apart or are_alike:
        raise MalformedFile(
            f"line {line} looks like numbers with decimal commas between commas: {shown(rows[0].strip())}; {NO_COMMA}"
        )


def _refuse_counted(columns: Mapping[int, npt.NDArray[Any]], line: int) -> None:
    """Raise where a first column that nothing names counts the points: moved as x, it would be lost, and z left out."""
    first = columns[0]
    is_table = 3 in columns and len(first) >= _COUNTED and np.array_equal(first, first[0] + np.arange(len(first)))
    if is_table and float(first[0]).is_integer():
        raise UnsupportedCloud(
            f"the first of {max(columns) + 1} columns counts the points from {first[0]:.0f} on, and nothing above line "
            f"{line} says which are x, y, z: put a line of names there, such as `id x y z`"
        )


def _refuse_numbered(columns: Mapping[int, npt.NDArray[Any]], line: int) -> None:
    """Raise where the first two columns, whole numbers, seem to number a scanner's rows and columns, as FARO's do.

    They stand in the order of one of the two, and the three columns behind them have decimals in most rows, where a
    grid has z and perhaps a colour.
    """
    if not {3, 4} <= columns.keys() or len(columns[0]) < _COUNTED:
        return
    numbers = [columns[0], columns[1]]
    with np.errstate(invalid="ignore"):  # of infinities
        are_whole = all((column >= 0).all() and (column % 1 == 0).all() for column in numbers)
        are_in_order = any((step >= 0).all() or (step <= 0).all() for step in map(np.diff, numbers))
        have_decimals = all((columns[axis] % 1 > 0).mean() > 0.5 for axis in (2, 3, 4))
    if are_whole and are_in_order and have_decimals:
        raise UnsupportedCloud(
            f"the first two of {max(columns) + 1} columns look like a scanner's rows and columns, and nothing above "
            f"line {line} says which are x, y, z: put a line of names there, such as `row column x y z`"
        )


def _scans(lines: Lines, numbers: npt.NDArray[np.int64]) -> int:
    """Add up the numbers of points, each a line of its own, of further scans below a first."""
    counts, bad = as_integers(lines.raw, lines.starts[lines.first], lines.ends[lines.first], np.dtype(np.int32))
    if bad is not None or (counts < 0).any():
        row = int(np.argmin(counts)) if bad is None else bad
        token = lines.raw[lines.starts[lines.first[row]] : lines.ends[lines.first[row]]]
        raise MalformedFile(f"line {numbers[row]} has 1 column, neither a point nor a number of them: {shown(token)}")
    return int(counts.sum(dtype=np.int64))


def _is_beyond_doubles(values: npt.NDArray[np.float64]) -> bool:
    """Say of (K,) numbers whether they are whole and some too large for float64 to tell from the next: times, ids."""
    return bool(np.isfinite(values).all() and (np.abs(values) >= 2**53).any() and (values == np.rint(values)).all())


def _whole(table: Lines, token: npt.NDArray[np.int64], values: npt.NDArray[np.float64]) -> npt.NDArray[Any]:
    """Read (K,) tokens again as int64, or uint64: hashes; their values as they are where some fit into neither."""
    for kind in (_WHOLE, _UNSIGNED):
        exact, bad = as_integers(table.raw, table.starts[token], table.ends[token], kind)
        if bad is None:
            return exact
    return values


def _joined(parts: list[npt.NDArray[Any]]) -> npt.NDArray[Any]:
    """Join the blocks of a column: int64 or uint64 where one is and the others can be, else float64."""
    kinds = {part.dtype for part in parts}
    kind = next((kind for kind in (_UNSIGNED, _WHOLE) if kind in kinds), None)
    if kind is not None and all(_can_be(kind, part) for part in parts):
        return np.concatenate([part.astype(kind) for part in parts])
    return np.concatenate([part.astype(np.float64) for part in parts])


def _can_be(kind: np.dtype[Any], part: npt.NDArray[Any]) -> bool:
    if part.dtype.kind == "f" and not ((np.abs(part) < 2**53) & (part == np.rint(part))).all():
        return False
    return kind == _WHOLE or bool((part >= 0).all())


def _is_row(lines: Lines) -> npt.NDArray[np.bool_]:
    """Return (L,) bool: which lines are neither blank nor comments."""
    is_row: npt.NDArray[np.bool_] = lines.counts > 0
    text = np.frombuffer(lines.raw, np.uint8)
    at = lines.starts[lines.first[is_row]]
    following = text[np.minimum(at + 1, len(text) - 1)]
    is_remark = (text[at] == ord("#")) | ((text[at] == ord("/")) & (following == ord("/")))
    begins = lines.line_starts[is_row]
    for row in np.flatnonzero(is_remark):  # a quoted cell may begin with anything
        is_remark[row] = b'"' not in lines.raw[begins[row] : at[row]]
    is_row[is_row] = ~is_remark
    return is_row


def _check_columns(table: Lines, numbers: npt.NDArray[np.int64], columns: int) -> None:
    wrong = table.counts != columns
    if wrong.any():
        row = int(np.argmax(wrong))
        raise MalformedFile(f"line {numbers[row]} has {table.counts[row]} columns, the lines before have {columns}")
