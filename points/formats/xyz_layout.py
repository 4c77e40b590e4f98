"""What stands above a table of points in text: byte order mark, remarks, count, names; and so its columns."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.colours import RGB
from straightpcf.points.formats.positions import AXES
from straightpcf.points.formats.text import as_number, begin_of_text, is_missing, shown
from straightpcf.points.formats.titles import MAX_COLUMNS, Title, delimiter_of, named_columns, names_axes, words_of

__all__ = ["NO_COMMA", "PTS_COLUMNS", "Layout", "read_layout"]

MAX_LINES_ABOVE = 100_000  # they are read one by one: a tenth of a second
# What stands behind x, y, z in a .pts file of so many columns.
PTS_COLUMNS = {4: ("intensity",), 6: RGB, 7: ("intensity", *RGB)}
_COMMENTS = (b"#", b"//")
_SEPARATOR = re.compile(rb'"?sep=.?"?', re.IGNORECASE)  # Excel's first line; the rows say it, too
_REMARKS, _REMARK_BYTES = 20, 1 << 17  # the last comments above a table, of which one may be its title
NO_COMMA = "decimals have a point here, no comma"
_LINE_END = re.compile(rb"\r\n|\n|\r")
_DECIMAL_COMMAS = re.compile(rb"[+-]?\d+(?:,\d+)?(?:\s+[+-]?\d+(?:,\d+)?){2,}")  # 0,5 1 2,5: not between commas


@dataclass(frozen=True)
class Layout:
    """Describe the table; begin, line: byte offset and line number of its first line.  axes: the columns of x, y, z.

    declared: the number of points if a line of its own says it, as in `.pts`: those up to the next such line, of a
    further scan.  delimiter: None for white space.  is_named: whether something says which columns the axes are.
    """

    begin: int
    line: int
    declared: int | None
    delimiter: bytes | None
    names: tuple[str, ...]
    axes: tuple[int, int, int]
    is_named: bool = True


def read_layout(raw: bytes, marks: Sequence[bytes]) -> Layout:
    """Read what stands above the table, up to the first line that is neither blank, comment, count nor names."""
    at, line = begin_of_text(raw), 1
    declared: int | None = None
    names: Title | None = None
    remarks: deque[Title] = deque(maxlen=_REMARKS)
    while at < len(raw):
        if line > MAX_LINES_ABOVE:
            raise UnsupportedCloud(
                f"no point is in the first {MAX_LINES_ABOVE} lines, the limit of what stands above them"
            )
        text, end = _line_at(raw, at, marks)
        if text.startswith(_COMMENTS) or _SEPARATOR.fullmatch(text):
            remarks.append(Title(line, text[:_REMARK_BYTES].lstrip(b"#/ ")))
        elif text and declared is None and names is None and text.isdigit() and len(text) <= 18:
            declared = int(text)
        elif (
            text
            and names is None
            and (_are_names(text, marks) or _are_numbered(text, _line_at(raw, end, marks)[0], marks))
        ):
            names = Title(line, text.lstrip(b"% "))  # MATLAB's comments
        elif text:
            return _described(at, line, declared, text, names, remarks, marks)
        at, line = end, line + 1
    return Layout(len(raw), line, declared, None, ("x", "y", "z"), (0, 1, 2))


def _line_at(raw: bytes, begin: int, marks: Sequence[bytes]) -> tuple[bytes, int]:
    """Return the line at byte `begin` without white space around it that marks no cell, and where the next begins."""
    found = _LINE_END.search(raw, begin)
    end = found.end() if found else len(raw)
    text = raw[begin:end]
    return text.strip() if b"\t" not in marks or not text.strip() else text.strip(b" \n\v\f\r"), end


def _described(
    begin: int,
    line: int,
    declared: int | None,
    row: bytes,
    names: Title | None,
    remarks: Iterable[Title],
    marks: Sequence[bytes],
) -> Layout:
    cells = words_of(row, marks=marks)
    delimiter = delimiter_of(row, marks)
    # Without names, and with cells enough, the first cell that is no number says so.
    if (names is not None or len(cells) < 3) and delimiter == b"," and _DECIMAL_COMMAS.fullmatch(row):
        raise MalformedFile(f"line {line} has decimal commas: {shown(row)}; {NO_COMMA}")
    if len(cells) < 3:
        raise MalformedFile(f"line {line} has {len(cells)} columns, a point needs three: {shown(row)}")
    if len(cells) > MAX_COLUMNS:
        raise UnsupportedCloud(f"line {line} has more than {MAX_COLUMNS} columns, the limit")
    labels, axes = named_columns(names, list(remarks), cells, line, marks=marks)
    if declared is not None and labels[0] == "column_1" and len(labels) in PTS_COLUMNS:
        labels = (*AXES, *PTS_COLUMNS[len(labels)])
    is_named = axes is not None or declared is not None
    return Layout(begin, line, declared, delimiter, labels, axes or (0, 1, 2), is_named)


def _are_names(text: bytes, marks: Sequence[bytes]) -> bool:
    words = words_of(text, marks=marks)
    has_gaps = delimiter_of(text, marks) is not None and all(is_missing(word) for word in words)
    if not 3 <= len(words) <= MAX_COLUMNS or has_gaps:
        return False
    return not any(_is_number(word) for word in words) or names_axes(text, marks=marks)


def _are_numbered(text: bytes, following: bytes, marks: Sequence[bytes]) -> bool:
    """Say whether a line is pandas' 0, 1, 2... above columns without names; the line after it tells it from a point.

    Before them may stand the empty name of an index.
    """
    words = words_of(text, marks=marks)
    lead = int(words[0] == b"")
    if len(words) < lead + 3 or words[lead:] != [b"%d" % column for column in range(len(words) - lead)]:
        return False
    row = words_of(following, marks=marks)
    return len(row) == len(words) and not any(word.lstrip(b"+-").isdigit() for word in row[lead : lead + 3])


def _is_number(word: bytes) -> bool:
    try:
        as_number(word)
    except ValueError:
        return False
    return True
