"""E57 written: sections of points in packets, and a file again whose points have moved."""

from __future__ import annotations

import contextlib
import itertools
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import UnsupportedCloud
from straightpcf.points.formats.e57_bits import bits_packed, bits_unpacked
from straightpcf.points.formats.e57_file import (
    PACKET,
    POINTS_PACKET,
    POINTS_SECTION,
    SECTION,
    E57Field,
    E57File,
    E57Points,
)
from straightpcf.points.formats.e57_pages import PAGE, PAYLOAD, in_pages, paged, unpaged
from straightpcf.points.formats.e57_xml import XmlEdits
from straightpcf.points.formats.positions import narrowed

__all__ = ["ChangedPoints", "check_changeable", "in_file", "put_section", "section_of", "with_changes"]

_INDEX_PACKET = 0
_INDEX = struct.Struct("<BBHHB9x")  # kind, flags, length - 1, entries, level
_ENTRY = struct.Struct("<QQ")  # the first point of a packet, and where that is
_LENGTHS_AT = 16  # of the file, of the XML's place and of its length in the file's header
_LARGEST_PACKET = 1 << 16
_ALIGNED = 4  # bytes, of sections and packets
_NOTHING = np.empty(0, np.int64), np.empty(0)


@dataclass(frozen=True)
class ChangedPoints:
    """Say what has changed of a scan: of fields by their names in which rows (K,) of its points, and to what, (K,).

    bounds: what the XML says of all its points, and is to say now.
    """

    points: E57Points
    values: Mapping[str, tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]]
    bounds: Mapping[ElementTree.Element, float]


def check_changeable(file: E57File, scans: Sequence[E57Points]) -> None:
    """Raise MalformedFile or UnsupportedCloud where `with_changes` would, wherever points move."""
    sections = sorted(file.section(points.file_offset)[:2] for points in scans if points.count)
    if any(begin < end + -end % _ALIGNED for (_, end), (begin, _) in itertools.pairwise(sections)):
        raise UnsupportedCloud("two scans of the E57 file share their points: take another format, as PLY or LAS")
    for element, place in _placed_elsewhere(file.root):
        if element.get("type") == "CompressedVector":
            file.section(place)
    for points in scans:
        _points_a_packet(points.fields, 0, points.count)


def with_changes(file: E57File, changes: Sequence[ChangedPoints]) -> bytes:
    """Return the file with changed points; raises UnsupportedCloud where a number has no place in it.

    Whole numbers get the bits that the new ones need beyond the old limits. Other sections keep what they hold and move
    as those before them grow; the XML changes where it says places in the file, limits and bounds.
    """
    edits = XmlEdits(file.xml, file.root)
    content, end = file.content, file.xml_begin + len(file.xml)
    if not content[end:].strip(b"\0"):  # the XML is last, as in every program's files; else it stays where it is
        del content[file.xml_begin :]
        content += bytes(-len(content) % _ALIGNED)
    parts: dict[int, tuple[int, bytearray]] = {}
    for change in changes:
        begin, end, _ = file.section(change.points.file_offset)
        parts[begin] = end + -end % _ALIGNED, section_of(*_changed(file, change, edits), change.points.count)
        for element, bound in change.bounds.items():
            edits.set_text(element, repr(bound))
    new, moved_to = _spliced(content, parts)
    for begin, (_, section) in parts.items():
        put_section(new, moved_to(begin), len(section))
    for element, place in _placed_elsewhere(file.root):
        begin = unpaged(place)
        if (now := moved_to(begin)) == begin:
            continue
        edits.set_attribute(element, "fileOffset", str(paged(now)))
        if begin not in parts and element.get("type") == "CompressedVector":
            _shift(new, file.section(place), moved_to)
    return in_file(new, edits.applied())


def section_of(fields: Sequence[E57Field], streams: Sequence[bytes], count: int) -> bytearray:
    """Return a section of `count` points that is not told yet where it is: `put_section` does that.

    Every packet begins with a whole point. Text, whose points nobody can tell, is shared out evenly.
    """
    rows = _points_a_packet(fields, sum(len(s) for f, s in zip(fields, streams, strict=True) if not f.is_number), count)
    total = -(-count // rows)
    section = bytearray(SECTION.size)
    for index in range(total):
        parts = [_part(*each, index, total, rows, count) for each in zip(fields, streams, strict=True)]
        lengths = struct.pack(f"<{len(parts) + 1}H", len(parts), *map(len, parts))
        size = PACKET.size + len(lengths) + sum(map(len, parts))
        padding = bytes(-size % _ALIGNED)
        section += PACKET.pack(POINTS_PACKET, 0, size + len(padding) - 1) + lengths
        section += b"".join([*parts, padding])
    return section + _INDEX.pack(_INDEX_PACKET, 0, _INDEX.size + _ENTRY.size - 1, 1, 0) + _ENTRY.pack(0, 0)


def put_section(content: bytearray, begin: int, length: int) -> None:
    """Tell a section of `section_of` in a file's content where it begins."""
    first, end = paged(begin + SECTION.size), begin + length
    SECTION.pack_into(content, begin, POINTS_SECTION, length, first, paged(end - _ENTRY.size - _INDEX.size))
    _ENTRY.pack_into(content, end - _ENTRY.size, 0, first)


def in_file(content: bytearray, xml: bytes) -> bytes:
    """Return the file of a content that begins with a header, with its XML behind it."""
    begin = len(content)
    content += xml
    length = -(-len(content) // PAYLOAD) * PAGE
    struct.pack_into("<QQQ", content, _LENGTHS_AT, length, paged(begin), len(xml))
    return in_pages(content)


def _points_a_packet(fields: Sequence[E57Field], text_bytes: int, count: int) -> int:
    """Return how many points go into one packet, a multiple of 8, so that every stream's part begins with a byte."""
    room = _LARGEST_PACKET - PACKET.size - 2 * (len(fields) + 1) - _ALIGNED - len(fields)
    bits = sum(field.bits for field in fields) + 8 * -(-text_bytes // max(count, 1))
    points = 8 * room // max(bits, 1) // 8 * 8
    if points < 8:
        raise UnsupportedCloud(
            f"points of {bits // 8} bytes do not fit into an E57 file's packets: take another format"
        )
    return points


def _part(field: E57Field, stream: bytes, index: int, total: int, rows: int, count: int) -> bytes:
    if not field.is_number:
        return stream[len(stream) * index // total : len(stream) * (index + 1) // total]
    size, most = rows * field.bits // 8, (count * field.bits + 7) // 8
    return stream[index * size : min((index + 1) * size, most)]


def _changed(file: E57File, change: ChangedPoints, edits: XmlEdits) -> tuple[list[E57Field], list[bytes]]:
    """Return a scan's fields, with the limits that they now have, and their streams."""
    fields, streams = list(change.points.fields), change.points.streams(file)
    for index, field in enumerate(fields):
        rows, values = change.values.get(field.name, _NOTHING)
        if len(rows):
            column = _Column(field, streams[index], change.points.count)
            put = column.put_floats if field.kind == "Float" else column.put_whole
            fields[index], streams[index] = put(rows, values, edits)
    return fields, streams


@dataclass(frozen=True)
class _Column:
    """One field of a scan, to be changed."""

    field: E57Field
    stream: bytes
    count: int

    def put_floats(
        self, rows: npt.NDArray[np.int64], values: npt.NDArray[np.float64], edits: XmlEdits
    ) -> tuple[E57Field, bytes]:
        """Return the field and its stream with other values in some rows."""
        element, dtype = self.field.element, self.field.dtype.newbyteorder("<")
        column = np.frombuffer(self.stream, dtype, self.count).copy()
        column[rows] = narrowed(values, dtype, what=f"the new {self.field.name}")
        for name, bound, wider in (("minimum", column[rows].min(), min), ("maximum", column[rows].max(), max)):
            if (was := element.get(name)) is not None:
                with contextlib.suppress(ValueError):  # no number is no limit
                    edits.set_attribute(element, name, repr(wider(float(was), float(bound))))
        return self.field, column.tobytes()

    def put_whole(
        self, rows: npt.NDArray[np.int64], values: npt.NDArray[np.float64], edits: XmlEdits
    ) -> tuple[E57Field, bytes]:
        """Return the field, with limits that hold all values, and its stream with other values in some rows."""
        field = self.field
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            whole = np.rint((values - field.offset) / field.scale)
        if not ((whole >= -(2.0**63)) & (whole < 2.0**63)).all():
            raise UnsupportedCloud(
                f"a new {field.name} has no place in 64 bits at the E57 file's scale {field.scale:g} and offset "
                f"{field.offset:g}: take another format"
            )
        codes = bits_unpacked(self.stream, field.bits, self.count) + np.int64(field.minimum)
        codes[rows] = whole.astype(np.int64)
        least, most = min(field.minimum, int(whole.min())), max(field.maximum, int(whole.max()))
        if least < field.minimum:
            edits.set_attribute(field.element, "minimum", str(least))
        if most > field.maximum:
            edits.set_attribute(field.element, "maximum", str(most))
        new = replace(field, minimum=least, maximum=most)
        return new, bits_packed(codes - np.int64(least), new.bits)


def _placed_elsewhere(root: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, int]]:
    """Yield what the XML says the place of, sections of points and blobs, and that place in the file."""
    for element in root.iter():
        said = element.get("fileOffset", "")
        if element.get("type") in ("CompressedVector", "Blob") and said.isdecimal() and int(said):
            yield element, int(said)


def _spliced(content: bytearray, parts: Mapping[int, tuple[int, bytearray]]) -> tuple[bytearray, Callable[[int], int]]:
    """Return the content with other parts, begin -> (end, new), and a function of an old place: where that is now."""
    new, at = bytearray(), 0
    moves: list[tuple[int, int]] = []  # from this old place on, so much further
    for begin in sorted(parts):
        end, part = parts[begin]
        new += content[at:begin]
        new += part
        moves.append((end, len(part) - (end - begin)))
        at = end
    new += content[at:]
    return new, lambda place: place + sum(by for end, by in moves if end <= place)


def _shift(content: bytearray, section: tuple[int, int, int], moved_to: Callable[[int], int]) -> None:
    """Put right what a section of points that has moved, and its index, say of places in the file."""
    begin, end, first = section
    now = moved_to(begin)
    kind, length, data, index = SECTION.unpack_from(content, now)
    SECTION.pack_into(content, now, kind, length, *(paged(moved_to(unpaged(place))) for place in (data, index)))
    at, end = moved_to(first), now + end - begin
    while at + _INDEX.size <= end:
        kind, _, less, entries, _ = _INDEX.unpack_from(content, at)
        places = range(at + _INDEX.size, min(at + less + 1, end), _ENTRY.size) if kind == _INDEX_PACKET else ()
        for entry in places[:entries]:
            row, place = _ENTRY.unpack_from(content, entry)
            _ENTRY.pack_into(content, entry, row, paged(moved_to(unpaged(place))))
        at += less + 1
