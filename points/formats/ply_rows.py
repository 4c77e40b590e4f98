"""The rows of a PLY element: where each property of each row stands, in text and in binary, lists included."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile
from straightpcf.points.formats.base import check_room
from straightpcf.points.formats.ply_header import PlyElement, PlyProperty
from straightpcf.points.formats.positions import WRITTEN, gathered
from straightpcf.points.formats.text import Lines, as_integers, as_numbers, blocks, shown

__all__ = ["AsciiRows", "BinaryRows", "ascii_rows", "binary_rows", "scalar_offsets"]

_Offsets = npt.NDArray[np.int64]
_FEWEST_BYTES, _VALUE_BYTES = 1 << 12, 32  # of text looked at in one step, and for each value of an element


@dataclass(frozen=True)
class AsciiRows:
    """Hold the scalars of a text element; end, line: byte offset and line number after its last row.

    starts, ends: name -> (N,) int64, byte offsets of its token: of what may be written anew, positions and normals,
    because they take ten times a short token's bytes.  values: name -> (N,), of every scalar, of the declared type.
    """

    end: int
    line: int
    starts: dict[str, _Offsets]
    ends: dict[str, _Offsets]
    values: dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class BinaryRows:
    """Hold where the rows of a binary element stand; end: byte offset after its last row.

    fixed: the rows as a structured array that views the file, (N,), if all have one size; else None and
    begins: (N,) int64 byte offsets, none where only the end was asked for.
    """

    end: int
    fixed: npt.NDArray[Any] | None
    begins: _Offsets


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
    pieces: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in scalars}
    places: dict[str, list[tuple[_Offsets, _Offsets]]] = {name: [] for name in scalars if name in WRITTEN}
    rows_left, end = element.count, begin
    size = max(_FEWEST_BYTES, _VALUE_BYTES * element.count * len(element.properties))
    for lines, block_end in blocks(raw, begin, size=size) if rows_left else ():
        # A row without properties is a blank line.
        filled = np.flatnonzero(lines.counts if element.properties else lines.counts + 1)[:rows_left]
        _walk(lines.pick(filled), element, line + filled, pieces, places)
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
        {name: _joined([place[0] for place in parts], np.dtype(np.int64)) for name, parts in places.items()},
        {name: _joined([place[1] for place in parts], np.dtype(np.int64)) for name, parts in places.items()},
        {name: _joined(parts, kinds[name]) for name, parts in pieces.items()},
    )


def _walk(
    lines: Lines,
    element: PlyElement,
    numbers: _Offsets,
    pieces: dict[str, list[npt.NDArray[Any]]],
    places: dict[str, list[tuple[_Offsets, _Offsets]]],
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
            pieces[prop.name].append(values)
            if prop.name in places:
                places[prop.name].append((starts, ends))
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


def binary_rows(raw: bytes, begin: int, element: PlyElement, *, keep: bool) -> BinaryRows:
    """Find the rows of a binary element that begins at byte `begin`; of uneven ones only the end unless `keep`."""
    what = f"element {element.name} of {element.count} rows at byte {begin}"
    check_room(element.count * element.smallest_row, len(raw) - begin, what=what)
    dtype, none = element.row_dtype, np.empty(0, np.int64)
    if dtype is not None:
        end = begin + element.count * dtype.itemsize
        if end == begin:
            return BinaryRows(end, np.empty(0, dtype), none)
        return BinaryRows(end, np.frombuffer(raw, dtype, element.count, begin), none)
    ended = None if keep else _end_of_faces(raw, begin, element)
    return _walked(raw, begin, element, keep=keep) if ended is None else BinaryRows(ended, None, none)


def scalar_offsets(raw: bytes, begins: _Offsets, element: PlyElement) -> Iterator[tuple[PlyProperty, _Offsets]]:
    """Yield every scalar property and where it stands in the rows that begin at (N,) `begins`, (N,) byte offsets."""
    at = begins
    for prop in element.properties:
        if prop.counter is None:
            yield prop, at
            at = at + prop.dtype.itemsize
        else:
            lengths = gathered(raw, at, prop.counter).astype(np.int64)
            at = at + prop.counter.itemsize + lengths * prop.dtype.itemsize


def _end_of_faces(raw: bytes, begin: int, element: PlyElement) -> int | None:
    """Return where rows with one list, its length in one byte, end, as those of most meshes; None for any others.

    Each row says where the next begins, so that one step of Python a row is the least; 10 million take a second.
    """
    lists = [prop for prop in element.properties if prop.counter is not None]
    if len(lists) != 1 or lists[0].counter != np.uint8:
        return None
    skip = sum(prop.dtype.itemsize for prop in element.properties[: element.properties.index(lists[0])])
    sizes = [element.smallest_row + length * lists[0].dtype.itemsize for length in range(256)]
    at = begin
    try:
        for _ in range(element.count):
            at += sizes[raw[at + skip]]
    except IndexError:
        return None  # truncated: whoever walks again says where
    return at if at <= len(raw) else None


def _walked(raw: bytes, begin: int, element: PlyElement, *, keep: bool) -> BinaryRows:
    """Go from row to row over any lists, with as little Python a row as that takes."""
    steps: list[tuple[int, struct.Struct, int]] = []  # bytes before a list's length, how it is read, bytes of a value
    skip = 0
    for prop in element.properties:
        if prop.counter is None:
            skip += prop.dtype.itemsize
        else:
            steps.append((skip, _reader(prop.counter), prop.dtype.itemsize))
            skip = prop.counter.itemsize
    begins, at = array("q"), begin
    for row in range(element.count):
        row_begin = at
        try:
            for before, reader, width in steps:
                at += before
                (length,) = reader.unpack_from(raw, at)
                if length < 0:
                    raise ValueError
                at += length * width
        except (struct.error, OverflowError, ValueError):
            at = len(raw)
        at += skip
        if at > len(raw):
            _check_row(raw, row_begin, element, row)
        if keep:
            begins.append(row_begin)
    return BinaryRows(at, None, np.array(begins, np.int64))


def _reader(dtype: np.dtype[Any]) -> struct.Struct:
    letter = "bhiq"[dtype.itemsize.bit_length() - 1]
    return struct.Struct((">" if dtype.str[0] == ">" else "<") + (letter.upper() if dtype.kind == "u" else letter))


def _check_row(raw: bytes, begin: int, element: PlyElement, row: int) -> None:
    """Raise MalformedFile that names where a row does not fit into the file."""
    size = 0
    for prop in element.properties:
        here = f"row {row} of element {element.name} at byte {begin + size}, property {prop.name},"
        if prop.counter is None:
            size += prop.dtype.itemsize
        else:
            check_room(prop.counter.itemsize, len(raw) - begin - size, what=here)
            length = int(np.frombuffer(raw, prop.counter, 1, begin + size)[0])
            if length < 0:
                raise MalformedFile(f"{here} has a list of length {length}")
            size += prop.counter.itemsize + length * prop.dtype.itemsize
        check_room(size, len(raw) - begin, what=here)
