"""The rows of a PLY element: where each property of each row stands, in text and in binary, lists included."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile
from straightpcf.points.formats.base import check_room
from straightpcf.points.formats.ply_header import PlyElement, PlyProperty
from straightpcf.points.formats.positions import gathered
from straightpcf.points.formats.text import Lines, as_integers, as_numbers, blocks, shown

__all__ = ["AsciiRows", "BinaryRows", "ascii_rows", "binary_rows"]

_Offsets = npt.NDArray[np.int64]


@dataclass(frozen=True)
class AsciiRows:
    """Hold the scalars of a text element; end, line: byte offset and line number after its last row.

    starts, ends: scalar name -> (N,) int64, byte offsets of its token.  values: name -> (N,), of the declared type.
    """

    end: int
    line: int
    starts: dict[str, _Offsets]
    ends: dict[str, _Offsets]
    values: dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class BinaryRows:
    """Hold where the scalars of a binary element stand; end: byte offset after its last row.

    fixed: the rows as a structured array that views the file, (N,), if all have one size; else None and
    offsets: scalar name -> (N,) int64 byte offsets.
    """

    end: int
    fixed: npt.NDArray[Any] | None
    offsets: dict[str, _Offsets]


def ascii_rows(raw: bytes, begin: int, element: PlyElement, line: int, *, keep: bool) -> AsciiRows:
    """Walk a text element, one row a line; its scalars are kept if `keep`, else only checked for being there.

    Blank lines are passed over, as readers that go from word to word do.  line: the file's line number at `begin`.
    """
    check_room(
        element.count * max(2 * len(element.properties), 1) - 1,
        len(raw) - begin,
        what=f"element {element.name} of {element.count} rows",
    )
    scalars = [p.name for p in element.properties if p.counter is None] if keep else []
    pieces: dict[str, list[tuple[_Offsets, _Offsets, npt.NDArray[Any]]]] = {name: [] for name in scalars}
    rows_left, end = element.count, begin
    for lines, block_end in blocks(raw, begin) if rows_left else ():
        # A row without properties is a blank line.
        filled = np.flatnonzero(lines.counts if element.properties else lines.counts + 1)[:rows_left]
        _walk(lines.pick(filled), element, line + filled, pieces)
        rows_left -= len(filled)
        seen = len(lines) if rows_left else int(filled[-1]) + 1
        end = int(lines.line_starts[seen]) if seen < len(lines) else block_end
        line += seen
        if rows_left == 0:
            break
    if rows_left:
        raise MalformedFile(
            f"element {element.name} declares {element.count} rows, "
            f"the file ends after {element.count - rows_left}: it is truncated"
        )
    kinds = {p.name: p.dtype for p in element.properties}
    return AsciiRows(
        end,
        line,
        {name: _joined([piece[0] for piece in parts], np.dtype(np.int64)) for name, parts in pieces.items()},
        {name: _joined([piece[1] for piece in parts], np.dtype(np.int64)) for name, parts in pieces.items()},
        {name: _joined([piece[2] for piece in parts], kinds[name]) for name, parts in pieces.items()},
    )


def _walk(
    lines: Lines,
    element: PlyElement,
    numbers: _Offsets,
    pieces: dict[str, list[tuple[_Offsets, _Offsets, npt.NDArray[Any]]]],
) -> None:
    """Step through the properties of all lines at once; `at` is each line's next token.  numbers: of the lines."""
    at, stop = lines.first.copy(), lines.first + lines.counts
    for prop in element.properties:
        _require(at < stop, lines, element, prop, numbers)
        starts, ends = lines.starts[at], lines.ends[at]
        at += 1
        if prop.counter is not None:
            lengths, bad = as_integers(lines.raw, starts, ends, prop.counter)
            if bad is None and (lengths < 0).any():
                bad = int(np.argmax(lengths < 0))
            if bad is not None:
                raise _bad_token(lines.raw[starts[bad] : ends[bad]], "list length", element, prop, int(numbers[bad]))
            longest = stop - at
            _require(lengths <= longest, lines, element, prop, numbers)
            at += lengths.astype(np.int64)
        elif prop.name in pieces:
            if prop.dtype.kind == "f":
                values, bad = as_numbers(lines.raw, starts, ends)
            else:
                values, bad = as_integers(lines.raw, starts, ends, prop.dtype)
            if bad is not None:
                token = lines.raw[starts[bad] : ends[bad]]
                raise _bad_token(token, prop.dtype.name, element, prop, int(numbers[bad]))
            pieces[prop.name].append((starts, ends, values))
    if (at != stop).any():
        row = int(np.argmax(at != stop))
        raise MalformedFile(
            f"line {numbers[row]}: a row of element {element.name} has {lines.counts[row]} values, "
            f"{int(stop[row] - at[row])} more than declared"
        )


def _require(
    there: npt.NDArray[np.bool_], lines: Lines, element: PlyElement, prop: PlyProperty, numbers: _Offsets
) -> None:
    if not there.all():
        row = int(np.argmin(there))
        raise MalformedFile(
            f"line {numbers[row]}: a row of element {element.name} ends after {lines.counts[row]} values, "
            f"within property {prop.name}"
        )


def _bad_token(token: bytes, kind: str, element: PlyElement, prop: PlyProperty, line: int) -> MalformedFile:
    return MalformedFile(f"line {line}: property {prop.name} of element {element.name} is {shown(token)}, no {kind}")


def _joined(parts: list[npt.NDArray[Any]], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    if dtype.kind == "f" and parts:
        dtype = parts[0].dtype  # text may carry more digits than the declared float holds
    return np.concatenate(parts) if parts else np.empty(0, dtype)


def binary_rows(raw: bytes, begin: int, element: PlyElement) -> BinaryRows:
    """Find the rows of a binary element that begins at byte `begin`."""
    what = f"element {element.name} of {element.count} rows at byte {begin}"
    check_room(element.count * element.smallest_row, len(raw) - begin, what=what)
    dtype = element.row_dtype
    if dtype is not None:
        end = begin + element.count * dtype.itemsize
        if end == begin:
            return BinaryRows(end, np.empty(0, dtype), {})
        return BinaryRows(end, np.frombuffer(raw, dtype, element.count, begin), {})
    return _varying(raw, begin, element)


def _varying(raw: bytes, begin: int, element: PlyElement) -> BinaryRows:
    """Walk rows that lists make uneven: as many at once as have the same list lengths as the first of them."""
    parts: dict[str, list[_Offsets]] = {p.name: [] for p in element.properties if p.counter is None}
    row, reach = 0, 1
    while row < element.count:
        offsets, counters, size = _first_row(raw, begin, element, row)
        reach = min(reach, element.count - row, max((len(raw) - begin) // size, 1))
        at = begin + size * np.arange(reach, dtype=np.int64)
        same = np.ones(reach, bool)
        for counter, offset, length in counters:
            same &= gathered(raw, at + offset, counter) == length
        run = reach if same.all() else int(np.argmin(same))
        for name, offset in offsets.items():
            parts[name].append(at[:run] + offset)
        begin += run * size
        row += run
        reach = min(2 * reach, 1 << 20) if run == reach else max(reach // 2, 1)
    return BinaryRows(begin, None, {name: _joined(found, np.dtype(np.int64)) for name, found in parts.items()})


def _first_row(
    raw: bytes, begin: int, element: PlyElement, row: int
) -> tuple[dict[str, int], list[tuple[np.dtype[Any], int, int]], int]:
    """Return one row's scalar offsets, its lists as (length type, offset, length), and its size in bytes."""
    offsets: dict[str, int] = {}
    counters: list[tuple[np.dtype[Any], int, int]] = []
    size = 0
    for prop in element.properties:
        here = f"row {row} of element {element.name} at byte {begin + size}, property {prop.name},"
        if prop.counter is None:
            offsets[prop.name] = size
            size += prop.dtype.itemsize
        else:
            check_room(prop.counter.itemsize, len(raw) - begin - size, what=here)
            length = int(np.frombuffer(raw, prop.counter, 1, begin + size)[0])
            if length < 0:
                raise MalformedFile(f"{here} has a list of length {length}")
            counters.append((prop.counter, size, length))
            size += prop.counter.itemsize + length * prop.dtype.itemsize
        check_room(size, len(raw) - begin, what=here)
    return offsets, counters, size
