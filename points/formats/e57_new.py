"""A new E57 file for a cloud of another format: one scan, with what E57 has no name for in an extension of its own."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterator, Mapping
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import NORMALS, PointCloud
from straightpcf.points.formats.colours import RGB, in_8_bits
from straightpcf.points.formats.e57_bits import bits_packed
from straightpcf.points.formats.e57_file import HEADER, MAGIC, E57Field, E57Points, scans_of
from straightpcf.points.formats.e57_pages import PAGE
from straightpcf.points.formats.e57_scan import CALLED, CARTESIAN, SPHERICAL, STATES, Columns
from straightpcf.points.formats.e57_write import in_file, put_section, section_of
from straightpcf.points.formats.positions import check_held
from straightpcf.points.formats.scalars import not_held, scalar_columns, with_intensity

__all__ = ["TYPES", "check_new", "lost", "new_e57"]

TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "i8", "f4", "f8")
_NAMES = {called: name for name, called in CALLED.items()}
_WHOLE = {*RGB, "rowIndex", "columnIndex", "returnIndex", "returnCount"}  # E57 has whole numbers of these
_ANY = {"intensity", "timeStamp"}
# What says where points are, and whether, under whatever prefix; and what colours and normals become.
_TAKEN = (*CARTESIAN, *SPHERICAL, *STATES, *_NAMES.values())
_OURS = "pcf"
_NAMESPACES = {
    "": "http://www.astm.org/COMMIT/E57/2010-e57-v1.0",
    "nor": "http://www.libe57.org/E57_NOR_surface_normals.txt",
    _OURS: "urn:straightpcf:attributes",
}
_ROOT = "".join(f' xmlns{":" * bool(short)}{short}="{uri}"' for short, uri in _NAMESPACES.items())
_XML = """<?xml version="1.0" encoding="UTF-8"?>
<e57Root type="Structure"{root}>
<formatName type="String"><![CDATA[ASTM E57 3D Imaging Data File]]></formatName>
<guid type="String"><![CDATA[{{{file}}}]]></guid>
<versionMajor type="Integer">1</versionMajor>
<versionMinor type="Integer"/>
<e57LibraryVersion type="String"><![CDATA[straightpcf]]></e57LibraryVersion>
<coordinateMetadata type="String"/>
<data3D type="Vector" allowHeterogeneousChildren="1">
<vectorChild type="Structure">
<guid type="String"><![CDATA[{{{scan}}}]]></guid>
{limits}
<points type="CompressedVector" fileOffset="{place}" recordCount="{count}">
<prototype type="Structure">
{fields}
</prototype>
<codecs type="Vector" allowHeterogeneousChildren="1"/>
</points>
</vectorChild>
</data3D>
<images2D type="Vector" allowHeterogeneousChildren="1"/>
</e57Root>
"""


def lost(cloud: PointCloud) -> list[str]:
    """Name what a new file does not hold, or under another name."""
    attributes = _said(cloud)
    called = {name: _as_element(name) for name in scalar_columns(attributes, TYPES, taken=_TAKEN)}
    renamed = [f"{name} (renamed to {now})" for name, now in called.items() if now != name]
    return [*cloud.beside, *not_held(attributes, TYPES, taken=_TAKEN), *renamed]


def check_new(cloud: PointCloud) -> None:
    """Raise UnsupportedCloud where `new_e57` would: E57's numbers are no NaN, and what is no point is left out."""
    held = np.isfinite(cloud.xyz).all(axis=1)
    check_held(cloud.xyz, held, ", which an E57 file does not hold: take another format, as PLY")


def new_e57(cloud: PointCloud) -> bytes:
    """Return an E57 file of one scan in the cloud's own frame; raises UnsupportedCloud as `check_new` does."""
    check_new(cloud)
    valid = np.zeros(len(cloud), np.int8)  # it takes no bits, and pye57 reads no scan without it
    columns = {**dict(zip(CARTESIAN, cloud.xyz.T, strict=True)), STATES[0]: valid, **_elements(cloud)}
    content = bytearray(HEADER.pack(MAGIC, 1, 0, 0, 0, 0, PAGE))
    xml = _described(columns, len(cloud), len(content))
    points = E57Points.of(scans_of(ElementTree.fromstring(xml))[0])
    streams = [_stream(*pair) for pair in zip(points.fields, columns.values(), strict=True)]
    section = section_of(points.fields, streams, len(cloud))
    content += section
    put_section(content, points.file_offset, len(section))
    return in_file(content, xml)


def _described(columns: Columns, count: int, place: int) -> bytes:
    """Return the XML of a scan of (count,) columns that begins at this place, with ids that are these columns'."""
    hashed = hashlib.sha256()
    for values in columns.values():
        hashed.update(values.tobytes())
    digest = hashed.hexdigest()
    return _XML.format(
        root=_ROOT,
        file=uuid.uuid5(uuid.NAMESPACE_OID, f"file {digest}"),
        scan=uuid.uuid5(uuid.NAMESPACE_OID, f"scan {digest}"),
        limits="\n".join(_limits(columns)),
        place=place,
        count=count,
        fields="\n".join(_element(*column) for column in columns.items()),
    ).encode()


def _said(cloud: PointCloud) -> Columns:
    """Return the attributes as E57 has them: red, green and blue, of 8 bits where that is all, and intensity."""
    return with_intensity(in_8_bits(cloud.new_attributes(NORMALS[0])))


def _elements(cloud: PointCloud) -> Columns:
    """Return the attributes by the names of their elements, each with its prefix."""
    called = {}
    for name, values in scalar_columns(_said(cloud), TYPES, taken=_TAKEN).items():
        if name in NORMALS[0]:
            called[f"nor:{_NAMES[name]}"] = values
        elif name in _ANY or (name in _WHOLE and values.dtype.kind in "iu"):
            called[_NAMES.get(name, name)] = values
        else:
            called[f"{_OURS}:{_as_element(name)}"] = values
    return called


def _as_element(name: str) -> str:
    """Return a name of a header's characters as one that XML has: no digit or mark is first."""
    return name if name[0].isalpha() or name[0] == "_" else f"n_{name}"


def _element(name: str, values: npt.NDArray[Any]) -> str:
    """Describe (N,) numbers: whole ones may be all of their type, so that they are read as of it."""
    if values.dtype.kind == "f":
        return f'<{name} type="Float" precision="{"single" if values.dtype.itemsize == 4 else "double"}"/>'
    whole = np.iinfo(values.dtype)
    least, most = (0, 0) if name in STATES else (whole.min, whole.max)
    return f'<{name} type="Integer" minimum="{least}" maximum="{most}"/>'


def _stream(field: E57Field, values: npt.NDArray[Any]) -> bytes:
    if field.kind == "Float":
        return np.ascontiguousarray(values, field.dtype.newbyteorder("<")).tobytes()
    return bits_packed(values.astype(np.int64) - np.int64(field.minimum), field.bits)


def _limits(columns: Columns) -> Iterator[str]:
    """Yield what a scan says of its points' places, intensities and colours: programs draw them by it."""
    bounds = {
        f"{axis}{end}": bound
        for axis, name in zip("xyz", CARTESIAN, strict=True)
        for end, bound in _ends(columns, name)
    }
    if bounds:
        yield _structure("cartesianBounds", "Float", bounds)
    if intensity := {f"intensity{end}": bound for end, bound in _ends(columns, "intensity")}:
        yield _structure("intensityLimits", "Float", intensity)
    colours = [name for name, called in CALLED.items() if called in RGB and name in columns]
    if len(colours) == len(RGB):
        most = {name: np.iinfo(columns[name].dtype).max for name in colours}
        limits = {f"{name}{end}": bound for name in colours for end, bound in (("Minimum", 0), ("Maximum", most[name]))}
        yield _structure("colorLimits", "Integer", limits)


def _ends(columns: Columns, name: str) -> list[tuple[str, float]]:
    """Return the least and the largest finite number of a column, if there is one."""
    values = columns.get(name, np.empty(0))
    known = values[np.isfinite(values)]
    return [("Minimum", float(known.min())), ("Maximum", float(known.max()))] if len(known) else []


def _structure(name: str, kind: str, values: Mapping[str, float]) -> str:
    inner = "".join(f'<{each} type="{kind}">{value!r}</{each}>' for each, value in values.items())
    return f'<{name} type="Structure">{inner}</{name}>'
