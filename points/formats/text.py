"""Text tables: find every token of every line, read numbers, and put new numbers in the place of old ones.

Everything is done on blocks of a few megabytes with numpy, so that a million lines take a second or two; the text
between the replaced tokens is copied byte for byte.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.positions import moved, number_text

__all__ = [
    "Lines",
    "as_integers",
    "as_number",
    "as_numbers",
    "begin_of_text",
    "blocks",
    "is_missing",
    "refuse_binary",
    "replaced",
    "shown",
]

BLOCK_BYTES = 1 << 23
MAX_NUMBER_CHARACTERS = 400
_STEP_TOKENS, _STEP_CHARACTERS = 1 << 16, 1 << 20  # read at once, each as wide as the longest of them
_Offsets = npt.NDArray[np.int64]

_IS_SPACE = np.zeros(256, bool)
_IS_SPACE[list(b" \t\n\v\f\r\x1a")] = True  # Ctrl-Z, how DOS ends a file
_IN_NUMBER = np.zeros(256, bool)
_IN_NUMBER[list(b"0123456789+-.eEnNaAiIfFtTyYdDqQsSuUlL#()\0")] = True
_MISSING = frozenset((b"", b"na", b"null"))  # what spreadsheets and databases write where there is no number
# What Microsoft's C runtimes print, old and new: -1.#IND00, 1.#INF, -nan(ind).
_NOT_FINITE = re.compile(rb"([+-]?)(?:1\.#(inf)0*|1\.#(?:ind|[qs]nan)0*|nan\((?:ind|snan)\))", re.IGNORECASE)


@dataclass(frozen=True)
class Lines:
    """Hold where the tokens of some whole lines are; every offset counts from the file's first byte.

    line_starts: (L,) int64.  first, counts: (L,) the lines' first token and their number of tokens.
    starts, ends: (T,) int64, the tokens of all lines in order.
    """

    raw: bytes
    line_starts: _Offsets
    first: _Offsets
    counts: _Offsets
    starts: _Offsets
    ends: _Offsets

    def __len__(self) -> int:
        return len(self.line_starts)

    def pick(self, rows: npt.NDArray[Any]) -> Lines:
        """Return the lines that an index or mask of lines picks."""
        return Lines(self.raw, self.line_starts[rows], self.first[rows], self.counts[rows], self.starts, self.ends)


def blocks(
    raw: bytes,
    begin: int,
    *,
    delimiter: bytes | None = None,
    longest: int | None = None,
    size: int | None = None,
) -> Iterator[tuple[Lines, int]]:
    """Yield the lines from byte `begin` on, block by block, each with the offset where the next block begins.

    Lines end in LF, CRLF or a lone CR.  Without a delimiter, tokens are runs of anything but white space; with one,
    they are what stands between two delimiters, white space and quotes trimmed, and may be empty: a line of delimiters
    is no blank one. Quoted delimiters are text, in a line whose quotes come in pairs.  longest: bytes of a line that
    does not fit into a block; raises UnsupportedCloud before memory is taken for a longer one.  size: bytes of a block,
    fewer where not all of the file is wanted.
    """
    size = min(size or BLOCK_BYTES, BLOCK_BYTES)
    while begin < len(raw):
        end = _last_end(raw, begin, begin + size)
        if end == 0:
            end = raw.find(b"\n", begin + size - 1) + 1 or len(raw)
            end = raw.find(b"\r", begin + size - 1, end - 2) + 1 or end
            if longest is not None and end - begin > longest:
                raise UnsupportedCloud(f"the line at byte {begin} has {end - begin} bytes; the limit is {longest}")
        yield _split(raw, begin, end, delimiter), end
        begin = end


def _last_end(raw: bytes, begin: int, end: int) -> int:
    """Return where the last line that ends within [begin, end) does, 0 if none does."""
    # A CR that is the last byte looked at may be half of a CRLF.
    return raw.rfind(b"\n", begin, end) + 1 or raw.rfind(b"\r", begin, end - 1) + 1


def _split(raw: bytes, begin: int, end: int, delimiter: bytes | None) -> Lines:
    text = np.frombuffer(raw, np.uint8, end - begin, begin)
    is_break = text == 10
    lone = np.flatnonzero(text == 13)
    is_break[lone[(lone + 1 == len(text)) | (text[np.minimum(lone + 1, len(text) - 1)] != 10)]] = True
    breaks = np.flatnonzero(is_break)
    line_starts = np.concatenate([[0], breaks + 1])
    line_ends = np.concatenate([breaks, [len(text)]])
    if line_starts[-1] == len(text):  # the block ends with a line's end: no further line begins
        line_starts, line_ends = line_starts[:-1], line_ends[:-1]

    in_token = ~_IS_SPACE[text]
    if delimiter is not None:
        is_mark, is_quote = text == delimiter[0], text == ord('"')
        if is_quote.any():
            is_mark &= ~_quoted(is_quote, line_starts)
        in_token &= ~(is_mark | is_quote)
    edges = np.diff(in_token.view(np.int8), prepend=np.int8(0), append=np.int8(0))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    first, last = np.searchsorted(starts, line_starts), np.searchsorted(starts, line_ends)
    if delimiter is not None:
        marks = np.flatnonzero(is_mark)
        is_blank = (first == last) & (np.searchsorted(marks, line_starts) == np.searchsorted(marks, line_ends))
        starts, ends, first, last = _fields(marks, line_starts, line_ends, starts, ends)
        last = np.where(is_blank, first, last)
    return Lines(raw, line_starts + begin, first, last - first, starts + begin, ends + begin)


def _quoted(is_quote: npt.NDArray[np.bool_], line_starts: _Offsets) -> npt.NDArray[np.bool_]:
    """Return (K,) bool: which bytes stand between two quotes of a line; none where a line has an odd number of them."""
    counts = np.add.reduceat(is_quote, line_starts, dtype=np.int64)
    lengths = np.diff(np.append(line_starts, len(is_quote)))
    paired = is_quote & np.repeat(counts % 2 == 0, lengths)
    inside: npt.NDArray[np.bool_] = np.logical_xor.accumulate(paired)
    return inside


def _fields(
    marks: _Offsets, line_starts: _Offsets, line_ends: _Offsets, starts: _Offsets, ends: _Offsets
) -> tuple[_Offsets, _Offsets, _Offsets, _Offsets]:
    """Return tokens between delimiters at `marks`, trimmed to the words (starts, ends) inside them."""
    field_starts = np.sort(np.concatenate([line_starts, marks + 1]))
    field_ends = np.sort(np.concatenate([line_ends, marks]))
    first_word = np.searchsorted(starts, field_starts)
    last_word = np.searchsorted(ends, field_ends, side="right") - 1
    full = first_word <= last_word
    token_starts, token_ends = field_ends.copy(), field_ends.copy()
    token_starts[full] = starts[first_word[full]]
    token_ends[full] = ends[last_word[full]]
    first = np.searchsorted(field_starts, line_starts)
    return token_starts, token_ends, first, np.searchsorted(field_starts, line_ends, side="right")


def as_numbers(
    raw: bytes, starts: _Offsets, ends: _Offsets, *, may_miss: bool = False
) -> tuple[npt.NDArray[np.float64], int | None]:
    """Read (K,) tokens as float64; also return the index of the first that is no number, or None.

    may_miss: an empty token, NA and null are NaN.
    """
    values = np.full(len(starts), np.nan)
    for begin, chunk in _texts(raw, starts, ends, empty=b"nan" if may_miss else b"?"):
        bad = _parse(chunk, values[begin : begin + len(chunk)], may_miss=may_miss)
        if bad is not None:
            return values, begin + bad
    return values, None


def as_integers(
    raw: bytes, starts: _Offsets, ends: _Offsets, dtype: np.dtype[Any]
) -> tuple[npt.NDArray[Any], int | None]:
    """Read (K,) tokens as whole numbers that fit into `dtype`; also return the index of the first that does not."""
    values, bad = as_numbers(raw, starts, ends)
    limits = np.iinfo(dtype)
    if bad is None:
        fits = (values >= limits.min) & (values <= limits.max) & (values == np.floor(values))
        bad = None if fits.all() else int(np.argmin(fits))
    if bad is not None:
        return np.zeros(len(starts), dtype), bad
    if dtype.itemsize < 8:
        return values.astype(dtype), None
    # float64 is too short for 64 bits
    tokens = (raw[start:end].lower() for start, end in zip(starts.tolist(), ends.tolist(), strict=True))
    exact = [int(float(token)) if b"." in token or b"e" in token else int(token) for token in tokens]
    outside = next((row for row, value in enumerate(exact) if not limits.min <= value <= limits.max), None)
    if outside is not None:
        return np.zeros(len(starts), dtype), outside
    return np.array(exact, dtype), None


def is_missing(token: bytes) -> bool:
    """Say whether a cell of a delimited table has no number where its column has some."""
    return token.lower() in _MISSING


def _texts(raw: bytes, starts: _Offsets, ends: _Offsets, *, empty: bytes) -> Iterator[tuple[int, npt.NDArray[Any]]]:
    """Yield (first index, (k,) fixed-width byte strings), `?` for a token that is too long for a number."""
    text = np.frombuffer(raw, np.uint8)
    begin = 0
    while begin < len(starts):
        at = starts[begin : begin + _STEP_TOKENS]
        length = ends[begin : begin + _STEP_TOKENS] - at
        is_empty, is_long = length == 0, length > MAX_NUMBER_CHARACTERS
        length = np.where(is_long, 0, length)
        widths = np.maximum(np.maximum.accumulate(length), len(empty))
        count = int(np.count_nonzero(widths * np.arange(1, len(at) + 1) <= _STEP_CHARACTERS))
        at, length, width = at[:count], length[:count], int(widths[count - 1])
        column = np.arange(width)
        index = np.minimum(at[:, None] + column, max(len(text) - 1, 0))
        characters = np.where(column < length[:, None], text[index], 0).astype(np.uint8)
        characters[is_empty[:count], : len(empty)] = list(empty)
        characters[is_long[:count], 0] = ord("?")
        characters[~_IN_NUMBER[characters].all(axis=1), 0] = ord("?")
        yield begin, characters.view(f"S{width}").reshape(count)
        begin += count


def _parse(texts: npt.NDArray[Any], out: npt.NDArray[np.float64], *, may_miss: bool) -> int | None:
    try:
        out[:] = texts.astype(np.float64)
    except ValueError:
        pass
    else:
        return None
    for row, token in enumerate(texts.tolist()):
        try:
            out[row] = np.nan if may_miss and is_missing(token) else as_number(token)
        except ValueError:
            return row
    return None


def as_number(token: bytes) -> float:
    """Read one number, infinity and NaN as any C library writes them; raises ValueError."""
    if (special := _NOT_FINITE.fullmatch(token)) is None:
        return float(token)
    return float(special[1] + (special[2] or b"nan"))


def replaced(
    raw: bytes,
    starts: _Offsets,
    ends: _Offsets,
    new: npt.NDArray[np.float64],
    old: npt.NDArray[np.float64],
) -> bytes:
    """Return `raw` with the tokens of the moved coordinates rewritten; starts, ends: (N, 3) byte offsets."""
    changed = moved(new, old)
    begins, stops, numbers = starts[changed], ends[changed], new[changed]
    order = np.argsort(begins, kind="stable")
    parts: list[bytes] = []
    at = 0
    for begin in range(0, len(order), _STEP_TOKENS):  # a piece of text takes several times its length in memory
        some = order[begin : begin + _STEP_TOKENS]
        pieces: list[bytes] = [b""] * (2 * len(some))
        pieces[1::2] = number_text(numbers[some])
        kept_from = [at, *stops[some[:-1]].tolist()]
        pieces[0::2] = [raw[start:stop] for start, stop in zip(kept_from, begins[some].tolist(), strict=True)]
        parts.append(b"".join(pieces))
        at = int(stops[some[-1]])
    return b"".join([*parts, raw[at:]])


def shown(token: bytes) -> str:
    """Return a token as an error message may show it."""
    text = token[:40].decode("ascii", "backslashreplace")
    return repr(text + "…" if len(token) > 40 else text)


def begin_of_text(raw: bytes) -> int:
    """Return where a text begins: behind the byte order mark that editors put before it."""
    return len(codecs.BOM_UTF8) if raw.startswith(codecs.BOM_UTF8) else 0


def refuse_binary(raw: bytes, begin: int) -> None:
    """Raise MalformedFile where a text file holds a zero byte."""
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise MalformedFile("the file is UTF-16 text: save it as UTF-8")
    at = raw.find(b"\0", begin)
    if at >= 0:
        raise MalformedFile(f"byte {at} is 0x00: this is no text file")
