"""The header of a PCD file: fields, counts, and how the data is written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.positions import axes_among
from straightpcf.points.formats.text import begin_of_text, shown

__all__ = ["MAX_FIELDS", "PcdField", "PcdHeader", "read_header"]

MAX_HEADER_BYTES = 1 << 20
MAX_FIELDS = 4096
MAX_COUNT = 1 << 20
_KEYWORDS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_ENCODINGS = ("ascii", "binary", "binary_compressed")
_KINDS = {"F": ("f", (4, 8)), "I": ("i", (1, 2, 4, 8)), "U": ("u", (1, 2, 4, 8))}
_KINDS |= {"B": ("u", (1,))}  # a bool, since PCL 1.13: 0 or 1, in text as well


@dataclass(frozen=True)
class PcdField:
    """Describe one field of `count` values a point; label: its name, numbered where names repeat (padding `_`)."""

    label: str
    dtype: np.dtype[Any]
    count: int


@dataclass(frozen=True)
class PcdHeader:
    """Describe the file; size: bytes up to the data.  lines: of the header.

    axes: what it calls x, y and z.  beside: what else it says of the cloud that no other format has a place for.
    """

    fields: tuple[PcdField, ...]
    points: int
    encoding: str
    size: int
    lines: int
    axes: tuple[str, ...]
    beside: tuple[str, ...]

    @property
    def row_dtype(self) -> np.dtype[Any]:
        """Return the type of one point of a binary file."""
        return np.dtype([(f.label, f.dtype, (f.count,) if f.count != 1 else ()) for f in self.fields])


def read_header(raw: bytes) -> PcdHeader:
    """Parse the header of a PCD file; raises MalformedFile naming the line."""
    entries: dict[str, list[str]] = {}
    begin, number = begin_of_text(raw), 0
    while "DATA" not in entries:
        end = raw.find(b"\n", begin, MAX_HEADER_BYTES)
        if end < 0:
            reason = f"has more than {MAX_HEADER_BYTES} bytes, the limit" if len(raw) > MAX_HEADER_BYTES else "ends"
            raise MalformedFile(f"the PCD header {reason} in line {number + 1}, before DATA{_and_unknown(entries)}")
        number += 1
        line, begin = raw[begin:end].strip(), end + 1
        if not line or line.startswith(b"#"):
            continue
        try:
            keyword, *words = line.decode("ascii").split()
        except UnicodeDecodeError as exc:
            raise MalformedFile(
                f"line {number} of the PCD header is not ASCII: {shown(line)}{_and_unknown(entries)}"
            ) from exc
        keyword = "FIELDS" if keyword == "COLUMNS" else keyword  # its name in old files
        if keyword in entries:
            raise MalformedFile(f"line {number} of the PCD header is there twice: {shown(line)}")
        # COUNTS, say: without it, rows would be short.
        if keyword not in _KEYWORDS and keyword.upper().startswith(_KEYWORDS):
            raise MalformedFile(f"line {number} of the PCD header is unknown, but nearly a known one: {shown(line)}")
        entries[keyword] = words
    axes = axes_among(entries.get("FIELDS", []))
    fields = _fields(entries, axes)
    encoding = " ".join(entries["DATA"])
    if encoding not in _ENCODINGS:
        raise MalformedFile(f"PCD DATA is {encoding[:40]!r}; it must be one of {', '.join(_ENCODINGS)}")
    return PcdHeader(fields, _points(entries), encoding, begin, number, axes, _beside(entries))


def _beside(entries: dict[str, list[str]]) -> tuple[str, ...]:
    """Name an organised shape, a sensor's place, and lines that only the program that wrote them knows."""
    found = []
    if entries.get("HEIGHT", ["1"]) != ["1"]:
        found.append(f"organised shape {' '.join(entries['WIDTH'])} x {' '.join(entries['HEIGHT'])}")
    viewpoint = entries.get("VIEWPOINT", [])
    if viewpoint and not _is_identity(viewpoint):
        found.append(f"viewpoint {' '.join(viewpoint)}")
    return (*found, *(f"header line {keyword}" for keyword in _unknown(entries)))


def _unknown(entries: dict[str, list[str]]) -> list[str]:
    return [keyword for keyword in entries if keyword not in _KEYWORDS]


def _and_unknown(entries: dict[str, list[str]]) -> str:
    """Say which keywords no reader knows, one of which may be a known one that is misspelt."""
    found = ", ".join(shown(keyword.encode()) for keyword in _unknown(entries)[:4])
    return f"; its unknown lines are {found}" if found else ""


def _is_identity(viewpoint: list[str]) -> bool:
    try:
        return [float(number) for number in viewpoint] == [0, 0, 0, 1, 0, 0, 0]
    except ValueError:
        return False


def _fields(entries: dict[str, list[str]], axes: tuple[str, ...]) -> tuple[PcdField, ...]:
    """Read the fields; as PCL does, take those of an old file without SIZE and TYPE for float32."""
    for keyword in ("FIELDS",) if {"SIZE", "TYPE"}.isdisjoint(entries) else ("FIELDS", "SIZE", "TYPE"):
        if keyword not in entries:
            raise MalformedFile(f"the PCD header has no {keyword}{_and_unknown(entries)}")
    names = entries["FIELDS"]
    if len(names) > MAX_FIELDS:
        raise UnsupportedCloud(f"the PCD header has {len(names)} FIELDS; the limit is {MAX_FIELDS}")
    sizes, kinds = entries.get("SIZE", ["4"] * len(names)), entries.get("TYPE", ["F"] * len(names))
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise MalformedFile(
            f"the PCD header has {len(names)} FIELDS, but SIZE, TYPE and COUNT of "
            f"{len(sizes)}, {len(kinds)} and {len(counts)}"
        )
    fields: list[PcdField] = []
    used: set[str] = set()
    last: dict[str, str] = {}  # label of a name: to look again from the name on is cubic in how often it comes
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        label = last.get(name, name)
        while label in used:
            label += "_"
        used.add(label)
        last[name] = label
        fields.append(_field(label, size, kind, count))
    by_label = {field.label: field for field in fields}
    for axis in axes:
        if axis not in by_label:
            raise MalformedFile(f"PCD FIELDS are {' '.join(names)[:200]}; there is no {axis}")
        if axis + "_" in by_label and names.count(axis) > 1:
            raise MalformedFile(f"PCD FIELDS name {axis} twice")
        if by_label[axis].dtype.kind != "f" or by_label[axis].count != 1:
            raise UnsupportedCloud(
                f"PCD field {axis} is {by_label[axis].count} x {by_label[axis].dtype.name}; "
                "moved points need one float of 4 or 8 bytes"
            )
    return tuple(fields)


def _field(label: str, size: str, kind: str, count: str) -> PcdField:
    letter, sizes = _KINDS.get(kind.upper(), ("", ()))
    if size not in [str(known) for known in sizes]:
        raise MalformedFile(
            f"PCD field {label[:40]} has TYPE {kind[:40]!r} of SIZE {size[:40]!r}, which does not exist"
        )
    values = _whole(count, f"COUNT of PCD field {label[:40]}")
    if not 1 <= values <= MAX_COUNT:
        raise MalformedFile(f"COUNT of PCD field {label[:40]} is {values}; it must be in 1..{MAX_COUNT}")
    return PcdField(label, np.dtype("<" + letter + size), values)


def _points(entries: dict[str, list[str]]) -> int:
    """Read how many points there are; an old file has POINTS alone, and HEIGHT is 1 if it is not there."""
    texts = {"HEIGHT": "1"} | {key: " ".join(words) for key, words in entries.items()}
    if "HEIGHT" not in entries and "POINTS" in entries:
        texts.setdefault("WIDTH", texts["POINTS"])
    if "WIDTH" not in texts:
        raise MalformedFile(f"the PCD header has no WIDTH{_and_unknown(entries)}")
    width, height = (_whole(texts[key], f"PCD {key}") for key in ("WIDTH", "HEIGHT"))
    points = _whole(texts["POINTS"], "PCD POINTS") if "POINTS" in texts else width * height
    if points != width * height:
        raise MalformedFile(f"PCD POINTS is {points}, but WIDTH {width} x HEIGHT {height} is {width * height}")
    return points


def _whole(text: str, what: str) -> int:
    if not (text.isdigit() and len(text) <= 18):
        raise MalformedFile(f"{what} is {text[:40]!r}, which is no whole number >= 0")
    return int(text)
