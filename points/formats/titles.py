"""What stands above a text table: which of its columns are x, y, z, and what the others are called."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from straightpcf.points.errors import MalformedFile
from straightpcf.points.formats.positions import AXES
from straightpcf.points.formats.text import shown

__all__ = ["MARKS", "MAX_COLUMNS", "Title", "delimiter_of", "named_columns", "names_axes", "words_of"]

MAX_COLUMNS = 4096
MARKS = (b";", b",")  # what may stand between cells where it is not white space: the first that a row has
_AROUND = b'" \t\n\v\f\r'  # a cell between delimiters
# Names of position columns as programs write them, ParaView's and surveyors' among them; a unit may follow: x [m].
_POSITIONS = (
    AXES,
    *(tuple(f"points{mark}{axis}" for axis in range(3)) for mark in ":_"),  # of old and of new ParaView
    *(tuple(f"points_m_xyz{mark}{axis}" for axis in range(3)) for mark in ":_"),  # VeloView's
    ("point_x", "point_y", "point_z"),  # ArcGIS's
    ("px", "py", "pz"),
    ("pos_x", "pos_y", "pos_z"),
    *(("easting", "northing", height) for height in ("elevation", "height", "altitude", "z")),
    *(("east", "north", height) for height in ("elev", "elevation", "height", "z")),
    ("e", "n", "z"),
    *(tuple(axis + more for axis in AXES) for more in ("_m", " coordinate", "_coordinate", " coord", "_coord")),
    ("x1", "y1", "z1"),  # Ouster's first returns
    ("0", "1", "2"),  # pandas' numbers of columns
)
# What says that no x, y, z are there, where words of both sets are among the names.
_DEGREES = ({"lat", "latitude"}, {"lon", "lng", "long", "longitude"})
_POLAR = (
    {"azimuth", "azimuthal", "azim", "az", "bearing", "theta", "phi"},
    {"range", "distance", "dist", "radius", "r", "rho", "elevation", "elev", "el", "zenith", "inclination"},
)
_VALUE = re.compile(r"[-+.]?\d[\d.,]*[^\w:-]*[A-Za-z]{0,2}")  # 48.1, 0..360, 120m: no name of a column, as 1_lat is
_NO_LETTERS = re.compile(r"[^a-z]+")
_UNIT = re.compile(r"\s*(\[.*\]|\(.*\))$")
_BEFORE_UNIT = re.compile(rb"(?<!\s)\s++(?=[\[(])")
_LEAD = re.compile(rb"^[^,;\t:]*:\s+")  # columns: x y z


@dataclass(frozen=True)
class Title:
    """Hold what a line above the table says, without the marks of a comment; line: its number."""

    line: int
    text: bytes


def named_columns(
    names: Title | None, remarks: Sequence[Title], cells: Sequence[bytes], line: int, *, marks: Sequence[bytes] = MARKS
) -> tuple[tuple[str, ...], tuple[int, int, int] | None]:
    """Return a name for each column, and which columns are x, y and z, None where nothing says it.

    names: a line of names above the table; remarks: the comments there, of which the last that names them counts;
    cells: the first row's, whose number is `line`. Raises MalformedFile where names and rows do not go together.
    """
    columns = len(cells)
    labels = [f"column_{column + 1}" for column in range(columns)]
    for title in (names, *reversed(remarks)):
        fitting = [words for some in _meant(title, columns, marks) if (words := _fitted(some, cells))]
        for words in fitting:
            if axes := _axes(words):
                once = [word if word and words.count(word) == 1 else "" for word in words]
                return tuple(word or label for word, label in zip(once, labels, strict=True)), axes
        if title and any(_hold(_DEGREES, words) for words in fitting):
            raise MalformedFile(
                f"the names above line {line} are of degrees: {shown(title.text)}; no distance can be told in them: "
                "project the points first (easting, northing, height)"
            )
        if title and any(_hold(_POLAR, words) for words in fitting):
            raise MalformedFile(
                f"the names above line {line} are of angles: {shown(title.text)}; no distance can be told in them: "
                "turn them into x, y, z first"
            )
        if title is names and columns > 3:  # a remark may be any text
            _refuse(title, line, columns, marks, fits=bool(fitting))
    return tuple(labels), None


def names_axes(text: bytes, *, marks: Sequence[bytes] = MARKS) -> bool:
    """Tell whether a line names x, y and z in words, whatever else it names: 450 and 550, of wavelengths."""
    ways = _meant(Title(0, text), MAX_COLUMNS, marks)
    return any((axes := _axes(words)) is not None and not words[axes[0]].isdigit() for words in ways)


def delimiter_of(row: bytes, marks: Sequence[bytes] = MARKS) -> bytes | None:
    """Return what a row has between its cells, quoted ones left out; None for white space."""
    bare = b"".join(_by_quotes(row)[::2])
    return next((mark for mark in marks if mark in bare), None)


def words_of(row: bytes, most: int = MAX_COLUMNS, *, marks: Sequence[bytes] = MARKS) -> list[bytes]:
    """Split a row, its quotes taken off; what is beyond the limit stays together as one more word."""
    mark = delimiter_of(row, marks)
    if mark is None:
        return row.split(None, most)
    parts = _by_quotes(row)
    parts[1::2] = [part.replace(mark, b"\0") for part in parts[1::2]]  # no text has a zero byte of its own
    return [word.replace(b"\0", mark).strip(_AROUND) for word in b'"'.join(parts).split(mark, most)]


def _by_quotes(row: bytes) -> list[bytes]:
    """Split a row at its quotes: every second part is quoted; one part where they are not in pairs, or too many."""
    count = row.count(b'"')
    return row.split(b'"') if count % 2 == 0 and count <= 4 * MAX_COLUMNS else [row]


def _meant(title: Title | None, columns: int, marks: Sequence[bytes]) -> Iterator[list[str]]:
    """Yield the names in a title as they may be meant: `x [m]` as one, `Point Id` between tabs, `columns: x y z`.

    What is beyond columns + 1 names stays together as one more.
    """
    if title is None:
        return
    for text in (title.text, _LEAD.sub(b"", title.text)):
        ways = [words_of(text, columns + 1, marks=marks)]
        if delimiter_of(text, marks) is None:
            ways += [text.split(b"\t", columns + 1), _BEFORE_UNIT.sub(b"", text).split(None, columns + 1)]
        for words in ways:
            yield [word[:320].strip(b"\"' ").decode("utf-8", "replace")[:80] for word in words]


def _fitted(names: list[str], cells: Sequence[bytes]) -> list[str] | None:
    """Return a name for each cell of a row, or None; a delimiter at the end of either is no column of its own."""
    if len(names) == len(cells) + 1 and not names[-1]:
        return names[:-1]
    if len(names) == len(cells) - 1 and not cells[-1]:
        return [*names, ""]
    return names if len(names) == len(cells) else None


def _refuse(names: Title | None, line: int, columns: int, marks: Sequence[bytes], *, fits: bool) -> None:
    """Raise where a line of names says nothing of positions, or is of more or fewer columns than a row has."""
    if names and fits:
        known = "; ".join(", ".join(three) for three in _POSITIONS)
        said = f"the names above line {line} do not say which columns are x, y, z: {shown(names.text)}"
        raise MalformedFile(f"{said}; known are {known}")
    for words in _meant(names, columns, marks):
        if names and _axes(words):
            more = " or more" if len(words) > columns + 1 else ""
            said = f"line {names.line} names {len(words)}{more} columns: {shown(names.text)}"
            raise MalformedFile(f"{said}; line {line} has {columns}, so which of them are x, y, z is not known")


def _hold(sets: Sequence[set[str]], words: Sequence[str]) -> bool:
    """Tell whether something of every set is among names such as `lat`, `gps_lon` and `Range [m]`.

    `lat 48.1 long 9.2`, where a scanner stood, is none of names.
    """
    if any(map(_VALUE.fullmatch, words)):
        return False
    plain = {part for word in words for part in _NO_LETTERS.split(_UNIT.sub("", word).lower())}
    return all(plain & names for names in sets)


def _axes(words: Sequence[str]) -> tuple[int, int, int] | None:
    """Return which of the columns so named are x, y and z, where each is named once: so written, or in any case.

    A table may have x and X; swapcase finds X, Y, Z beside an x.
    """
    plain = [_UNIT.sub("", word) for word in words]
    for cased in (plain, [word.swapcase() for word in plain], [word.lower() for word in plain]):
        for x, y, z in _POSITIONS:
            if cased.count(x) == cased.count(y) == cased.count(z) == 1:
                return cased.index(x), cased.index(y), cased.index(z)
    return None
