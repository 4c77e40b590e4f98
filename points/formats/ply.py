"""PLY: text and binary of both byte orders; everything but moved positions is copied byte for byte."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import NORMALS, PointCloud
from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import Format, check_count
from straightpcf.points.formats.colours import in_8_bits
from straightpcf.points.formats.ply_header import MAX_PROPERTIES, PlyElement, PlyHeader, read_header
from straightpcf.points.formats.ply_rows import AsciiRows, BinaryRows, ascii_rows, binary_rows, scalar_offsets
from straightpcf.points.formats.positions import (
    AXES,
    axes_among,
    changes,
    gathered,
    moved,
    narrowed,
    put_positions,
    scattered,
    widened,
)
from straightpcf.points.formats.scalars import check_columns, scalar_columns
from straightpcf.points.formats.text import begin_of_text, blocks, refuse_binary, replaced

__all__ = ["Ply"]

_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
_NAMES |= {"f4": "float", "f8": "double"}


@dataclass(frozen=True)
class PlySource:
    """Hold the whole file, where its vertices stand, what it calls their axes, and the positions that were read."""

    raw: bytes
    begin: int
    rows: AsciiRows | BinaryRows
    vertex: PlyElement
    xyz: npt.NDArray[np.float64]
    axes: tuple[str, ...]


class Ply(Format):
    """Read and write PLY; x, y and z (or X, Y and Z) of the element `vertex` must be scalars.

    Whole numbers are read for conversions only: the points' own file has no place for where they move to.
    """

    name = "ply"
    suffixes = (".ply",)
    media_type = "application/vnd.ply"
    writes_normals = True
    types = tuple(_NAMES)

    def sniff(self, head: bytes) -> bool:
        """Recognise the first line."""
        return head.startswith((b"ply\n", b"ply\r", b"ply \n", b"ply \r"), begin_of_text(head))

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read the vertices; scalar properties become attributes."""
        raw = path.read_bytes()
        header = read_header(raw)
        vertex, axes = _vertex(header)
        check_count(vertex.count, max_points, where="element vertex")
        begin, rows = _find(raw, header, vertex)
        values = rows.values if isinstance(rows, AsciiRows) else _values(raw, vertex, rows)
        xyz = widened([values[axis] for axis in axes])
        attributes = {name: value for name, value in values.items() if name not in axes}
        lists = [f"list {p.name}" for p in vertex.properties if p.counter is not None]
        others = [f"element {element.name}" for element in header.elements if element is not vertex and element.count]
        source = PlySource(raw, begin, rows, vertex, xyz.copy(), axes)
        return PointCloud(xyz, attributes, source, beside=(*lists, *others))

    def check(self, cloud: PointCloud) -> None:
        """Raise UnsupportedCloud where a file's own positions are whole numbers, or a new one has too many columns."""
        if not isinstance(cloud.source, PlySource):
            check_columns(in_8_bits(cloud.attributes), MAX_PROPERTIES, what="PLY")
            return
        for prop in cloud.source.vertex.properties:
            if prop.name in cloud.source.axes and prop.dtype.kind != "f":
                raise UnsupportedCloud(
                    f"property {prop.name} of element vertex is {prop.dtype.name}, which has no place for where points "
                    "move to: ask for another format, or save the file with float or double positions"
                )

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the file that was read with its positions replaced, or a new binary one."""
        source = cloud.source
        if not isinstance(source, PlySource):
            self.check(cloud)
            path.write_bytes(_new_file(cloud))
            return
        names, new, old = changes(cloud, source.xyz, source.axes)
        if not moved(new, old).any():
            path.write_bytes(source.raw)
            return
        self.check(cloud)
        if isinstance(source.rows, AsciiRows):
            starts = np.stack([source.rows.starts[name] for name in names], axis=1)
            ends = np.stack([source.rows.ends[name] for name in names], axis=1)
            path.write_bytes(replaced(source.raw, starts, ends, new, old))
        else:
            path.write_bytes(_patched(source, source.rows, names, new, old))


def _vertex(header: PlyHeader) -> tuple[PlyElement, tuple[str, ...]]:
    """Return the element of the points, and what it calls their axes."""
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    if vertex is None:
        names = ", ".join(element.name for element in header.elements)[:200]
        raise MalformedFile(f"the PLY file has no element vertex; its elements are: {names or 'none'}")
    properties = {p.name: p for p in vertex.properties}
    for axis in (axes := axes_among(properties)):
        if axis not in properties:
            raise MalformedFile(f"element vertex has no property {axis}")
        is_list, dtype = properties[axis].counter is not None, properties[axis].dtype
        if is_list or (dtype.kind != "f" and dtype.itemsize > 4):  # float64 is too short for 64 bits
            kind = "a list" if is_list else dtype.name
            raise UnsupportedCloud(f"property {axis} of element vertex is {kind}; it must be float or double")
    return vertex, axes


def _find(raw: bytes, header: PlyHeader, vertex: PlyElement) -> tuple[int, AsciiRows | BinaryRows]:
    """Walk every element, so that a truncated file is found out whatever stands last in it."""
    if header.is_ascii:
        refuse_binary(raw, header.size)
    at, line = header.size, header.lines + 1
    found: tuple[int, AsciiRows | BinaryRows] | None = None
    for element in header.elements:
        rows: AsciiRows | BinaryRows
        if header.is_ascii:
            rows = ascii_rows(raw, at, element, line, keep=element is vertex)
            line = rows.line
        else:
            rows = binary_rows(raw, at, element, keep=element is vertex)
        if element is vertex:
            found = at, rows
        at = rows.end
    if header.is_ascii and element is vertex:
        _refuse_more(raw, at, vertex, line)
    if found is None:  # pragma: no cover - _vertex has looked
        raise MalformedFile("the PLY file has no element vertex")
    return found


def _refuse_more(raw: bytes, begin: int, vertex: PlyElement, line: int) -> None:
    """Raise where one more vertex follows than the header declares: it would stay as it is."""
    for lines, _ in blocks(raw, begin):
        if lines.counts.any():
            first = int(np.argmax(lines.counts > 0))
            if lines.counts[first] == len(vertex.properties):
                raise MalformedFile(f"element vertex declares {vertex.count} rows, and line {line + first} is one more")
            return
        line += len(lines)


def _values(raw: bytes, vertex: PlyElement, rows: BinaryRows) -> dict[str, npt.NDArray[Any]]:
    if rows.fixed is not None:
        return {p.name: rows.fixed[p.name] for p in vertex.properties}
    return {p.name: gathered(raw, offsets, p.dtype) for p, offsets in scalar_offsets(raw, rows.begins, vertex)}


def _patched(
    source: PlySource,
    rows: BinaryRows,
    names: tuple[str, ...],
    new: npt.NDArray[np.float64],
    old: npt.NDArray[np.float64],
) -> bytearray:
    changed = moved(new, old)
    out = bytearray(source.raw)
    if rows.fixed is not None:
        table = np.frombuffer(out, rows.fixed.dtype, len(rows.fixed), source.begin)
        put_positions({name: table[name] for name in names}, new, old, names)
        return out
    for prop, offsets in scalar_offsets(source.raw, rows.begins, source.vertex):
        if prop.name in names:
            column = names.index(prop.name)
            picked = changed[:, column]
            values = narrowed(new[picked, column], prop.dtype, what=f"the new {prop.name}")
            scattered(out, offsets[picked], values)
    return out


def _new_file(cloud: PointCloud) -> bytes:
    """Write binary little-endian with double positions and every attribute as scalar properties."""
    columns = {axis: cloud.xyz[:, column] for column, axis in enumerate(AXES)}
    columns |= scalar_columns(in_8_bits(cloud.new_attributes(NORMALS[0])), _NAMES, taken=AXES)
    lines = ["ply", "format binary_little_endian 1.0", "comment written by straightpcf", f"element vertex {len(cloud)}"]
    lines += [f"property {_NAMES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    table = np.empty(len(cloud), [(name, "<" + values.dtype.str[1:]) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return "\n".join([*lines, "end_header", ""]).encode() + table.tobytes()
