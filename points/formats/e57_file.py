"""The container of an E57 file (ASTM E2807): pages with checksums, XML, and points in packets of one stream a field."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import check_room

__all__ = ["MAGIC", "E57Field", "E57File", "E57Points", "child", "number"]

MAGIC = b"ASTM-E57"
_HEADER = struct.Struct("<8sIIQQQQ")  # magic, version, its minor one, length, where the XML is, its length, page's size
_PAGE, _CHECKSUM = 1024, 4  # bytes of a page, with those of its checksum at its end
_PAYLOAD = _PAGE - _CHECKSUM
_SECTION = struct.Struct("<B7xQQQ")  # kind, length, where its packets begin, its index
_POINTS_SECTION, _POINTS_PACKET = 1, 1
_PACKET = struct.Struct("<BBH")  # kind, flags, length - 1
_CRC32C = 0x82F63B78  # Castagnoli's polynomial, its bits reversed
_PAGES_AT_ONCE, _VALUES_AT_ONCE = 1 << 14, 1 << 16
_INT64 = np.iinfo(np.int64)


@dataclass(frozen=True)
class E57Field:
    """One of the numbers that a scan has for each point, and how its stream is coded.

    name: without the prefix of an extension; dtype: of the values, as `E57Points.read` returns them. Whole numbers
    (kind "Integer", "ScaledInteger") take as many bits as tell `minimum` from `maximum`, the lowest first.
    """

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

    @classmethod
    def of(cls, element: ElementTree.Element) -> E57Field:
        """Read a child of a prototype; raises MalformedFile."""
        name, kind = _local(element.tag), element.get("type", "")
        if kind == "Float":
            is_single = element.get("precision") == "single"
            return cls(name, kind, np.dtype(np.float32 if is_single else np.float64), 0, 0, 1.0, 0.0)
        if kind not in ("Integer", "ScaledInteger"):
            return cls(name, kind, np.dtype(np.void), 0, 0, 1.0, 0.0)
        try:
            minimum, maximum = int(element.get("minimum", _INT64.min)), int(element.get("maximum", _INT64.max))
            scale, offset = float(element.get("scale", 1)), float(element.get("offset", 0))
        except ValueError as exc:
            raise MalformedFile(f"field {name[:40]} of the E57 file: {exc}") from exc
        if not _INT64.min <= minimum <= maximum <= _INT64.max:
            raise MalformedFile(f"field {name[:40]} of the E57 file holds {minimum} to {maximum}")
        whole = np.min_scalar_type(maximum if minimum >= 0 else min(minimum, -1 - maximum))
        return cls(name, kind, whole if kind == "Integer" else np.dtype(np.float64), minimum, maximum, scale, offset)


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
        if element is None or prototype is None:
            raise MalformedFile("points of the E57 file have no prototype")
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

    def read(self, file: E57File) -> dict[str, npt.NDArray[Any]]:
        """Unpack all fields that are numbers: name -> (count,)."""
        packets = file.packets(self) if any(self.count * field.bits for field in self.fields) else ()
        streams = [b"".join(parts) for parts in zip(*packets, strict=True)] or [b""] * len(self.fields)
        values = {}
        for field, stream in zip(self.fields, streams, strict=True):
            if field.dtype.kind == "V":  # text
                continue
            where = f"field {field.name[:40]} of {self.count} points of the E57 file"
            check_room((self.count * field.bits + 7) // 8, len(stream), what=where)
            values[field.name] = _decoded(stream, field, self.count)
        return values


class E57File:
    """An E57 file in memory, of which every page has been compared with its checksum."""

    def __init__(self, raw: bytes) -> None:
        """Raises MalformedFile, UnsupportedCloud."""
        check_room(_HEADER.size, len(raw), what="the header of an E57 file")
        _, major, _, length, xml_offset, xml_length, page = _HEADER.unpack_from(raw)
        if (major, page) != (1, _PAGE):
            raise UnsupportedCloud(f"version {major} of E57 in pages of {page} bytes is not known; 1 in {_PAGE} is")
        check_room(length, len(raw), what="the E57 file, says its header, which")
        self._pages = np.frombuffer(raw, np.uint8, length // _PAGE * _PAGE).reshape(-1, _PAGE)
        self._check()
        xml = self.logical(_unpaged(xml_offset), xml_length, what="the XML of the E57 file")
        if b"<!DOCTYPE" in xml:  # entities could make anything of it
            raise MalformedFile("the XML of the E57 file has a document type, which none has")
        try:
            self.root = ElementTree.fromstring(xml)
        except (ElementTree.ParseError, ValueError, LookupError) as exc:
            raise MalformedFile(f"the XML of the E57 file is broken: {exc}") from exc

    def logical(self, begin: int, length: int, *, what: str) -> bytes:
        """Return `length` bytes from `begin` on, both counted without checksums."""
        check_room(begin + length, self._pages.shape[0] * _PAYLOAD, what=what)
        first, last = begin // _PAYLOAD, -(-(begin + length) // _PAYLOAD)
        begin -= first * _PAYLOAD
        return self._pages[first:last, :_PAYLOAD].tobytes()[begin : begin + length]

    def packets(self, points: E57Points) -> Iterator[list[memoryview]]:
        """Yield, packet by packet, a part of each field's stream."""
        what, begin = "a section of points of the E57 file", _unpaged(points.file_offset)
        kind, length, data, _ = _SECTION.unpack(self.logical(begin, _SECTION.size, what=what))
        if kind != _POINTS_SECTION or not begin < (first := _unpaged(data)) <= begin + length:
            raise MalformedFile(f"byte {points.file_offset} of the E57 file begins no section of points")
        section = memoryview(self.logical(first, begin + length - first, what=what))
        at = 0
        while at + _PACKET.size <= len(section):
            kind, _, less = _PACKET.unpack_from(section, at)
            packet, at = section[at : at + less + 1], at + less + 1
            check_room(less + 1, len(packet), what="a packet of points of the E57 file")
            if kind == _POINTS_PACKET:
                yield _streams(packet, len(points.fields))

    def _check(self) -> None:
        """Raise MalformedFile where a page is not what its checksum is of."""
        table = _crc_table()
        for begin in range(0, len(self._pages), _PAGES_AT_ONCE):
            pages = self._pages[begin : begin + _PAGES_AT_ONCE]
            crc = np.full(len(pages), 0xFFFFFFFF, np.uint32)
            for pair in np.ascontiguousarray(pages[:, :_PAYLOAD]).view("<u2").T:
                crc = (crc >> 16) ^ table[(crc ^ pair) & 0xFFFF]
            wrong = np.flatnonzero(~crc != np.ascontiguousarray(pages[:, _PAYLOAD:]).view(">u4")[:, 0])
            if len(wrong):
                raise MalformedFile(f"page {begin + wrong[0]} of the E57 file is damaged: its checksum differs")


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


def _leaves(prototype: ElementTree.Element) -> Iterator[ElementTree.Element]:
    for element in prototype:
        if element.get("type") in ("Structure", "Vector"):
            yield from _leaves(element)
        else:
            yield element


def _local(tag: str) -> str:
    return tag.rpartition("}")[2]


def _unpaged(offset: int) -> int:
    """Turn a place in the file into one without checksums."""
    page, within = divmod(offset, _PAGE)
    return page * _PAYLOAD + min(within, _PAYLOAD)


def _streams(packet: memoryview, fields: int) -> list[memoryview]:
    """Cut a packet into its parts of the fields' streams."""
    what, begin = "a packet of points of the E57 file", _PACKET.size + 2 * (fields + 1)
    check_room(begin, len(packet), what=what)
    count, *lengths = struct.unpack_from(f"<{fields + 1}H", packet, _PACKET.size)
    if count != fields:
        raise MalformedFile(f"{what} has {count} streams for {fields} fields")
    check_room(begin + sum(lengths), len(packet), what=what)
    ends = begin + np.cumsum([0, *lengths])
    return [packet[a:b] for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]


def _decoded(stream: bytes, field: E57Field, count: int) -> npt.NDArray[Any]:
    """Unpack the values (count,) of a field."""
    if field.kind == "Float":
        return np.frombuffer(stream, field.dtype.newbyteorder("<"), count).astype(field.dtype)
    whole, bits = np.empty(count, np.int64), field.bits
    packed = np.frombuffer(stream, np.uint8)
    for begin in range(0, count, _VALUES_AT_ONCE):  # a multiple of 8: every part begins with a byte
        some = whole[begin : begin + _VALUES_AT_ONCE]
        if bits:
            here = packed[begin * bits // 8 :][: (len(some) * bits + 7) // 8]
            each = np.unpackbits(here, bitorder="little", count=len(some) * bits).reshape(len(some), bits)
            wide = np.zeros((len(some), 64), np.uint8)
            wide[:, :bits] = each
            some[:] = np.packbits(wide, axis=1, bitorder="little").view("<i8")[:, 0]
        else:
            some[:] = 0
    whole += field.minimum  # of 64 bits it wraps around, as it should
    if field.kind == "Integer":
        return whole.astype(field.dtype)
    return whole * field.scale + field.offset


def _crc_table() -> npt.NDArray[np.uint32]:
    """Return what two bytes make of a checksum, the lower one first: (65536,)."""
    table: npt.NDArray[np.uint32] = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        table = (table >> np.uint32(1)) ^ np.where(table & 1, np.uint32(_CRC32C), np.uint32(0))
    return table
