"""The container of an E57 file (ASTM E2807): pages with checksums, XML, and points in packets of one stream a field."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import check_room
from straightpcf.points.formats.e57_bits import bits_unpacked
from straightpcf.points.formats.e57_pages import PAGE, PAYLOAD, checksums, unpaged

__all__ = [
    "HEADER",
    "MAGIC",
    "PACKET",
    "POINTS_PACKET",
    "POINTS_SECTION",
    "SECTION",
    "E57Field",
    "E57File",
    "E57Points",
    "child",
    "number",
    "scans_of",
]

MAGIC = b"ASTM-E57"
HEADER = struct.Struct("<8sIIQQQQ")  # magic, version, its minor one, length, where the XML is, its length, page's size
SECTION = struct.Struct("<B7xQQQ")  # kind, length, where its packets begin, its index
PACKET = struct.Struct("<BBH")  # kind, flags, length - 1
POINTS_SECTION, POINTS_PACKET = 1, 1
_INT64 = np.iinfo(np.int64)
_A_SECTION = "a section of points of the E57 file"


@dataclass(frozen=True)
class E57Field:
    """One of the numbers that a scan has for each point, and how its stream is coded.

    name: without the prefix of an extension; dtype: of the values, as `E57Points.read` returns them. Whole numbers
    (kind "Integer", "ScaledInteger") take as many bits as tell `minimum` from `maximum`, the lowest first.
    element: of the prototype, which says it.
    """

    element: ElementTree.Element
    name: str
    kind: str
    dtype: np.dtype[Any]
    minimum: int
    maximum: int
    scale: float
    offset: float

    @property
    def bits(self) -> int:
        """How many bits of the stream a value takes, none where all are the same."""
        return 8 * self.dtype.itemsize if self.kind == "Float" else (self.maximum - self.minimum).bit_length()

    @property
    def is_number(self) -> bool:
        """Whether it is one, and not text."""
        return self.dtype.kind != "V"

    @classmethod
    def of(cls, element: ElementTree.Element) -> E57Field:
        """Read a child of a prototype; raises MalformedFile."""
        name, kind = _local(element.tag), element.get("type", "")
        if kind == "Float":
            is_single = element.get("precision") == "single"
            return cls(element, name, kind, np.dtype(np.float32 if is_single else np.float64), 0, 0, 1.0, 0.0)
        if kind not in ("Integer", "ScaledInteger"):
            return cls(element, name, kind, np.dtype(np.void), 0, 0, 1.0, 0.0)
        try:
            minimum, maximum = int(element.get("minimum", _INT64.min)), int(element.get("maximum", _INT64.max))
            scale, offset = float(element.get("scale", 1)), float(element.get("offset", 0))
        except ValueError as exc:
            raise MalformedFile(f"field {name[:40]} of the E57 file: {exc}") from exc
        if not _INT64.min <= minimum <= maximum <= _INT64.max:
            raise MalformedFile(f"field {name[:40]} of the E57 file holds {minimum} to {maximum}")
        whole = np.min_scalar_type(maximum if minimum >= 0 else min(minimum, -1 - maximum))
        dtype = whole if kind == "Integer" else np.dtype(np.float64)
        return cls(element, name, kind, dtype, minimum, maximum, scale, offset)


@dataclass(frozen=True)
class E57Points:
    """The points of one scan, still packed: how many, their fields, and where they are in the file."""

    count: int
    fields: tuple[E57Field, ...]
    file_offset: int

    @classmethod
    def of(cls, scan: ElementTree.Element) -> E57Points:
        """Read what a scan says of its CompressedVector; raises MalformedFile, UnsupportedCloud."""
        element = child(scan, "points")
        prototype, codecs = child(element, "prototype"), child(element, "codecs")
        if element is None or element.get("type") != "CompressedVector" or prototype is None:
            raise MalformedFile("points of the E57 file are no CompressedVector with a prototype")
        if codecs is not None and len(codecs):
            raise UnsupportedCloud("points of the E57 file are packed with a codec of their own; bitPackCodec is known")
        try:
            count, offset = int(element.get("recordCount", 0)), int(element.get("fileOffset", 0))
        except ValueError as exc:
            raise MalformedFile(f"points of the E57 file: {exc}") from exc
        if count < 0:
            raise MalformedFile(f"points of the E57 file are {count}")
        return cls(count, tuple(map(E57Field.of, _leaves(prototype))), offset)

    @property
    def row_bytes(self) -> int:
        """How many bytes a point takes unpacked."""
        return sum(field.dtype.itemsize for field in self.fields)

    def read(self, file: E57File, *, only: Collection[str] | None = None) -> dict[str, npt.NDArray[Any]]:
        """Unpack the fields that are numbers, those alone of which `only` holds the names: name -> (count,)."""
        wanted = [field.is_number and (only is None or field.name in only) for field in self.fields]
        streams = itertools.compress(zip(self.fields, self.streams(file), strict=True), wanted)
        return {field.name: _decoded(stream, field, self.count) for field, stream in streams}

    def streams(self, file: E57File) -> list[bytes]:
        """Return each field's stream, as long at least as `count` values need; raises MalformedFile."""
        packets = file.packets(self) if any(self.count * field.bits for field in self.fields) else ()
        streams = [b"".join(parts) for parts in zip(*packets, strict=True)] or [b""] * len(self.fields)
        for field, stream in zip(self.fields, streams, strict=True):
            where = f"field {field.name[:40]} of {self.count} points of the E57 file"
            check_room((self.count * field.bits + 7) // 8, len(stream), what=where)
        return streams


class E57File:
    """An E57 file in memory, of which every page has been compared with its checksum.

    raw: its bytes; xml: what describes them, from `xml_begin` on, counted without checksums; root: the same, parsed.
    """

    def __init__(self, raw: bytes) -> None:
        """Raises MalformedFile, UnsupportedCloud."""
        check_room(HEADER.size, len(raw), what="the header of an E57 file")
        _, major, _, length, xml_offset, xml_length, page = HEADER.unpack_from(raw)
        if (major, page) != (1, PAGE):
            raise UnsupportedCloud(f"version {major} of E57 in pages of {page} bytes is not known; 1 in {PAGE} is")
        check_room(length, len(raw), what="the E57 file, says its header, which")
        self.raw = raw
        self._pages = np.frombuffer(raw, np.uint8, length // PAGE * PAGE).reshape(-1, PAGE)
        self._check()
        self.xml_begin = unpaged(xml_offset)
        self.xml = xml = self.logical(self.xml_begin, xml_length, what="the XML of the E57 file")
        if b"<!DOCTYPE" in xml:  # entities could make anything of it
            raise MalformedFile("the XML of the E57 file has a document type, which none has")
        try:
            self.root = ElementTree.fromstring(xml)
        except (ElementTree.ParseError, ValueError, LookupError) as exc:
            raise MalformedFile(f"the XML of the E57 file is broken: {exc}") from exc

    @property
    def content(self) -> bytearray:
        """All of the file without its checksums."""
        return bytearray(self._pages[:, :PAYLOAD].tobytes())

    def logical(self, begin: int, length: int, *, what: str) -> bytes:
        """Return `length` bytes from `begin` on, both counted without checksums."""
        check_room(begin + length, self._pages.shape[0] * PAYLOAD, what=what)
        first, last = begin // PAYLOAD, -(-(begin + length) // PAYLOAD)
        begin -= first * PAYLOAD
        return self._pages[first:last, :PAYLOAD].tobytes()[begin : begin + length]

    def section(self, file_offset: int) -> tuple[int, int, int]:
        """Return where a section of points begins and ends and its packets begin; raises MalformedFile."""
        begin = unpaged(file_offset)
        kind, length, data, _ = SECTION.unpack(self.logical(begin, SECTION.size, what=_A_SECTION))
        first, end = unpaged(data), begin + length
        if kind != POINTS_SECTION or not begin + SECTION.size <= first <= end:
            raise MalformedFile(f"byte {file_offset} of the E57 file begins no section of points")
        check_room(end, self._pages.shape[0] * PAYLOAD, what=_A_SECTION)
        return begin, end, first

    def packets(self, points: E57Points) -> Iterator[list[memoryview]]:
        """Yield, packet by packet, a part of each field's stream."""
        _, end, first = self.section(points.file_offset)
        section = memoryview(self.logical(first, end - first, what=_A_SECTION))
        at = 0
        while at + PACKET.size <= len(section):
            kind, _, less = PACKET.unpack_from(section, at)
            packet, at = section[at : at + less + 1], at + less + 1
            check_room(less + 1, len(packet), what="a packet of points of the E57 file")
            if kind == POINTS_PACKET:
                yield _streams(packet, len(points.fields))

    def _check(self) -> None:
        """Raise MalformedFile where a page is not what its checksum is of."""
        said = np.ascontiguousarray(self._pages[:, PAYLOAD:]).view(">u4")[:, 0]
        wrong = np.flatnonzero(checksums(self._pages) != said)
        if len(wrong):
            raise MalformedFile(f"page {wrong[0]} of the E57 file is damaged: its checksum differs")


def child(element: ElementTree.Element | None, *path: str) -> ElementTree.Element | None:
    """Return the child of a child ... of these names, whatever their namespaces; None where there is none."""
    for name in path:
        element = next((each for each in element if _local(each.tag) == name), None) if element is not None else None
    return element


def number(element: ElementTree.Element | None, *path: str, default: float = 0.0) -> float:
    """Return the number in such a child, 0 where it is empty; raises MalformedFile."""
    found = child(element, *path)
    if found is None:
        return default
    try:
        return float(found.text or 0)
    except ValueError as exc:
        raise MalformedFile(f"{path[-1]} of the E57 file is {found.text!r:.40}") from exc


def scans_of(root: ElementTree.Element) -> list[ElementTree.Element]:
    """Return the scans of an E57 file that have points."""
    scans = child(root, "data3D")
    return [scan for scan in (() if scans is None else scans) if child(scan, "points") is not None]


def _leaves(prototype: ElementTree.Element) -> Iterator[ElementTree.Element]:
    for element in prototype:
        if element.get("type") in ("Structure", "Vector"):
            yield from _leaves(element)
        else:
            yield element


def _local(tag: str) -> str:
    return tag.rpartition("}")[2]


def _streams(packet: memoryview, fields: int) -> list[memoryview]:
    """Cut a packet into its parts of the fields' streams."""
    what, begin = "a packet of points of the E57 file", PACKET.size + 2 * (fields + 1)
    check_room(begin, len(packet), what=what)
    count, *lengths = struct.unpack_from(f"<{fields + 1}H", packet, PACKET.size)
    if count != fields:
        raise MalformedFile(f"{what} has {count} streams for {fields} fields")
    check_room(begin + sum(lengths), len(packet), what=what)
    ends = begin + np.cumsum([0, *lengths])
    return [packet[a:b] for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]


def _decoded(stream: bytes, field: E57Field, count: int) -> npt.NDArray[Any]:
    """Unpack the values (count,) of a field."""
    if field.kind == "Float":
        return np.frombuffer(stream, field.dtype.newbyteorder("<"), count).astype(field.dtype)
    whole = bits_unpacked(stream, field.bits, count)
    whole += field.minimum  # of 64 bits it wraps around, as it should
    if field.kind == "Integer":
        return whole.astype(field.dtype)
    return whole * field.scale + field.offset
