"""The header of a PLY file: which elements and properties follow, and where the data begins."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.text import begin_of_text, shown

__all__ = [
    "MAX_HEADER_BYTES",
    "MAX_LINE_BYTES",
    "MAX_PROPERTIES",
    "PlyElement",
    "PlyHeader",
    "PlyProperty",
    "read_header",
]

MAX_HEADER_BYTES = 1 << 20
MAX_LINE_BYTES = 1 << 16
MAX_ELEMENTS = 1024
MAX_PROPERTIES = 4096

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class PlyProperty:
    """Describe one property; `counter` is the type of a list's length, None for a scalar."""

    name: str
    dtype: np.dtype[Any]
    counter: np.dtype[Any] | None = None


@dataclass(frozen=True)
class PlyElement:
    """Describe one element: its rows, in order of its properties."""

    name: str
    count: int
    properties: tuple[PlyProperty, ...]

    @property
    def smallest_row(self) -> int:
        """Return the bytes of a row whose lists are all empty."""
        return sum((p.counter or p.dtype).itemsize for p in self.properties)

    @property
    def row_dtype(self) -> np.dtype[Any] | None:
        """Return the type of a row, or None if a list makes rows differ in size."""
        if any(p.counter is not None for p in self.properties):
            return None
        return np.dtype([(p.name, p.dtype) for p in self.properties])


@dataclass(frozen=True)
class PlyHeader:
    """Describe the file; size: bytes up to the data.  lines: of the header.  is_ascii: how the data is written."""

    is_ascii: bool
    elements: tuple[PlyElement, ...]
    size: int
    lines: int


def read_header(raw: bytes) -> PlyHeader:
    """Parse the header of a PLY file; raises MalformedFile naming the line."""
    lines, size = _lines(raw)
    if lines[0][begin_of_text(raw) :].strip() != b"ply":
        raise MalformedFile(f"line 1 of a PLY file must be 'ply', not {shown(lines[0])}")
    encoding: str | None = None
    elements: dict[str, tuple[int, dict[str, PlyProperty]]] = {}
    properties: dict[str, PlyProperty] = {}  # of the last element
    for number, line in enumerate(lines[1:-1], start=2):
        words = line.split()
        keyword = words[0] if words else b""
        if keyword in (b"comment", b"obj_info", b""):
            continue
        where = f"line {number} of the PLY header"
        texts = _decoded(words, where)
        if keyword == b"format" and encoding is None:
            encoding = _encoding(texts, where)
        elif keyword == b"element" and encoding is not None:
            name, count = _element(texts, elements, where)
            properties = {}
            elements[name] = count, properties
        elif keyword == b"property" and elements:
            found = _property(texts, _BYTE_ORDERS[str(encoding)], properties, where)
            properties[found.name] = found
        else:
            raise MalformedFile(f"{where} is not understood, or stands in the wrong place: {shown(line)}")
    if encoding is None:
        raise MalformedFile("the PLY header has no format line")
    described = tuple(PlyElement(name, count, tuple(of.values())) for name, (count, of) in elements.items())
    return PlyHeader(encoding == "ascii", described, size, len(lines))


def _lines(raw: bytes) -> tuple[list[bytes], int]:
    """Split off the header, bounded in bytes before anything else looks at it; the last line is `end_header`."""
    begin = 0
    lines: list[bytes] = []
    magic = begin_of_text(raw) + len(b"ply")
    # Old Mac: a binary body may begin with the byte of LF.
    only_cr = raw[magic : magic + 1] == b"\r" and raw[magic + 1 : magic + 2] != b"\n"
    while True:
        limit = begin + MAX_LINE_BYTES + 2
        end = -1 if only_cr else raw.find(b"\n", begin, limit)
        cr = raw.find(b"\r", begin, limit if end < 0 else end)
        end = cr if cr >= 0 else end
        if end < 0:
            if len(raw) - begin > MAX_LINE_BYTES:
                raise MalformedFile(
                    f"line {len(lines) + 1} of the PLY header has more than {MAX_LINE_BYTES} bytes, the limit"
                )
            raise MalformedFile(f"the PLY header ends in line {len(lines) + 1}, before 'end_header'")
        has_crlf = not only_cr and raw[end : end + 2] == b"\r\n"
        lines.append(raw[begin:end])
        begin = end + (2 if has_crlf else 1)
        if lines[-1].strip() == b"end_header":
            return lines, begin
        if begin > MAX_HEADER_BYTES:
            raise MalformedFile(f"the PLY header has more than {MAX_HEADER_BYTES} bytes, the limit")


def _decoded(words: list[bytes], where: str) -> list[str]:
    try:
        return [word.decode("utf-8") for word in words]
    except UnicodeDecodeError as exc:
        raise MalformedFile(f"{where} is not UTF-8: {exc.reason} at byte {exc.start} of a word") from exc


def _encoding(words: list[str], where: str) -> str:
    if len(words) != 3 or words[1] not in _BYTE_ORDERS or words[2] != "1.0":
        raise MalformedFile(f"{where}: the format must be one of {', '.join(_BYTE_ORDERS)} 1.0, not {words[1:3]}")
    return words[1]


def _element(words: list[str], before: Collection[str], where: str) -> tuple[str, int]:
    if len(words) != 3:
        raise MalformedFile(f"{where}: an element has a name and a count, not {len(words) - 1} words")
    name, count = words[1][:80], words[2]
    if not (count.isascii() and count.isdigit() and len(count) <= 18):
        raise MalformedFile(f"{where}: element {name} has the count {count[:40]!r}, which is no whole number >= 0")
    if name in before:
        raise MalformedFile(f"{where}: element {name} is declared twice")
    if len(before) >= MAX_ELEMENTS:
        raise UnsupportedCloud(f"{where}: the file has more than {MAX_ELEMENTS} elements, the limit")
    return name, int(count)


def _property(words: list[str], order: str, before: Collection[str], where: str) -> PlyProperty:
    is_list = words[1:2] == ["list"]
    if len(words) != (5 if is_list else 3):
        said = [word[:40] for word in words[1:6]]
        raise MalformedFile(f"{where}: a property has a type and a name, a list a second type, not {said}")
    for kind in words[2:4] if is_list else words[1:2]:
        if kind not in _TYPES:
            raise MalformedFile(f"{where}: {kind[:40]!r} is no PLY type")
    name = words[-1]
    if name in before:
        raise MalformedFile(f"{where}: property {name[:80]} is declared twice in one element")
    if len(before) >= MAX_PROPERTIES:
        raise UnsupportedCloud(f"{where}: an element has more than {MAX_PROPERTIES} properties, the limit")
    if not is_list:
        return PlyProperty(name, np.dtype(order + _TYPES[words[1]]))
    counter = np.dtype(order + _TYPES[words[2]])
    if counter.kind == "f":
        raise MalformedFile(f"{where}: the length of list {name[:80]} cannot be a {words[2]}")
    return PlyProperty(name, np.dtype(order + _TYPES[words[3]]), counter)
