"""PTX: the scans of a terrestrial scanner as text, a line for each direction, each scan with its pose above."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import Format, check_count
from straightpcf.points.formats.colours import RGB
from straightpcf.points.formats.positions import check_held, moved
from straightpcf.points.formats.text import Lines, as_number, as_numbers, blocks, refuse_binary, replaced, shown
from straightpcf.points.formats.text_new import axis_columns, intensity_and_colour, lost_of_colour, table_lines
from straightpcf.points.formats.xyz_layout import PTS_COLUMNS

__all__ = ["Ptx"]

_ABOVE = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)  # numbers in a scan's first lines: columns, rows, the scanner, a matrix
_MATRIX = slice(6, 10)  # of these lines
_COUNT = rb"[ \t]*\d+[ \t]*\r?\n"
_THREE, _FOUR = (rb"[ \t]*" + rb"[ \t]+".join([rb"[-+.\deE]+"] * count) + rb"[ \t]*\r?\n" for count in (3, 4))
_BEGINNING = re.compile(_COUNT * 2 + _THREE * 4 + _FOUR * 4)
_COLUMNS = {3: (), **PTS_COLUMNS}  # behind x y z
_LONGEST_LINE, _COUNT_DIGITS = 1 << 16, 10
_SCAN = "scan"
_NO_INTENSITY = 0.5  # what programs write there
_NEW = ("0 0 0", "1 0 0", "0 1 0", "0 0 1", "1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1")  # no pose


@dataclass(frozen=True)
class PtxSource:
    """Hold the file, the byte offsets (N, 3) of its points' coordinates, these (N, 3), and where they were placed.

    scans: of each the matrix (4, 4) of its pose, p' = [p 1] M, and how many of the points are its own.
    """

    raw: bytes
    starts: npt.NDArray[np.int64]
    ends: npt.NDArray[np.int64]
    local: npt.NDArray[np.float64]
    xyz: npt.NDArray[np.float64]
    scans: tuple[tuple[npt.NDArray[np.float64], int], ...]


class Ptx(Format):
    """Read all scans of a PTX file as one cloud, each where its matrix puts it; only moved numbers change.

    A line `0 0 0` is a direction from which nothing came back, and no point. With several scans `scan` says which one a
    point is of, 0 and up.
    """

    name = "ptx"
    suffixes = (".ptx",)
    media_type = "text/plain"

    def sniff(self, head: bytes) -> bool:
        """Recognise the ten lines above a scan, whatever the file is called."""
        return _BEGINNING.match(head) is not None

    def estimate(self, head: bytes, size: int) -> int:
        """Guess from what a line of short numbers takes."""
        return size // 20

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read places, intensities and colours; an attribute that a scan lacks is left behind."""
        raw = path.read_bytes()
        refuse_binary(raw, 0)
        scans = _scans(raw, max_points)
        common = [name for name in scans[0].names if all(name in scan.names for scan in scans)]
        others = dict.fromkeys(name for scan in scans for name in scan.names if name not in common)
        local, starts, ends = (np.concatenate([part[of] for scan in scans for part in scan.parts]) for of in (0, 1, 2))
        xyz = np.concatenate([scan.placed() for scan in scans])
        columns: dict[str, npt.NDArray[Any]] = {}
        for name in common:
            values = np.concatenate([part[3][:, scan.names.index(name)] for scan in scans for part in scan.parts])
            columns[name] = _whole(values) if name in RGB else values
        if len(scans) > 1:
            columns[_SCAN] = np.repeat(
                np.array([scan.number for scan in scans], np.uint32), [scan.count for scan in scans]
            )
        poses = tuple((scan.matrix, scan.count) for scan in scans)
        return PointCloud(xyz, columns, PtxSource(raw, starts, ends, local, xyz.copy(), poses), beside=tuple(others))

    def left_behind(self, cloud: PointCloud) -> list[str]:
        """Name what is neither intensity nor colour, or has other numbers there."""
        return [] if isinstance(cloud.source, PtxSource) else lost_of_colour(cloud)

    def check(self, cloud: PointCloud) -> None:
        """Raise UnsupportedCloud where a new file would not hold a point."""
        if isinstance(cloud.source, PtxSource):
            return
        is_point = np.isfinite(cloud.xyz).all(axis=1) & cloud.xyz.any(axis=1)
        check_held(cloud.xyz, is_point, ", which is none in a PTX file: take another format, as PLY")

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the file that was read, the numbers of what moved in its scan's frame; or a new one."""
        source = cloud.source
        if not isinstance(source, PtxSource):
            self.check(cloud)
            path.write_bytes(_new_file(cloud))
            return
        changed = np.any(moved(cloud.xyz, source.xyz), axis=1)
        new, begin = source.local.copy(), 0
        for matrix, count in source.scans:
            rows = begin + np.flatnonzero(changed[begin : begin + count])
            new[rows] = (cloud.xyz[rows] - matrix[3, :3]) @ np.linalg.inv(matrix[:3, :3])
            begin += count
        path.write_bytes(replaced(source.raw, source.starts, source.ends, new, source.local))


@dataclass
class _Scan:
    """A scan while it is read; parts: places (K, 3) in its own frame, starts and ends of their text, and the others."""

    number: int
    matrix: npt.NDArray[np.float64]
    left: int  # lines that are still to come
    names: tuple[str, ...] = ()
    parts: list[tuple[npt.NDArray[Any], ...]] = field(default_factory=list)

    @property
    def count(self) -> int:
        return sum(len(part[0]) for part in self.parts)

    def placed(self) -> npt.NDArray[np.float64]:
        """Return its points (N, 3) in the file's frame; of one that is infinite little is left."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.concatenate([part[0] for part in self.parts]) @ self.matrix[:3, :3] + self.matrix[3, :3]

    def take(self, lines: Lines, numbers: npt.NDArray[np.int64]) -> None:
        """Read some of its lines, which have these numbers in the file; raises MalformedFile."""
        width = int(lines.counts[0])
        if not self.parts:
            if width not in _COLUMNS:
                raise MalformedFile(f"line {numbers[0]} has {width} columns; a point of a PTX file has 3, 4, 6 or 7")
            self.names = _COLUMNS[width]
        wrong = np.flatnonzero(lines.counts != 3 + len(self.names))
        if len(wrong):
            said = f"{lines.counts[wrong[0]]} columns, the lines before have {3 + len(self.names)}"
            raise MalformedFile(f"line {numbers[wrong[0]]} has {said}")
        tokens = lines.first[:, None] + np.arange(width)
        starts, ends = lines.starts[tokens], lines.ends[tokens]
        values, bad = as_numbers(lines.raw, starts.reshape(-1), ends.reshape(-1))
        if bad is not None:
            row, column = divmod(bad, width)
            text = lines.raw[starts[row, column] : ends[row, column]]
            raise MalformedFile(f"line {numbers[row]}, column {column + 1}: {shown(text)} is no number")
        table = values.reshape(-1, width)
        came = table[:, :3].any(axis=1)
        self.parts.append((table[came, :3], starts[came, :3], ends[came, :3], table[came, 3:]))
        self.left -= len(table)


def _scans(raw: bytes, max_points: int) -> list[_Scan]:
    """Read a file's scans; raises MalformedFile, TooManyPoints."""
    scans: list[_Scan] = []
    above: list[list[bytes]] = []  # the lines above a scan that has not begun
    declared = 0
    for lines, numbers in _lines(raw):
        at = 0
        while at < len(lines):
            if scans and scans[-1].left:
                some = np.arange(at, min(at + scans[-1].left, len(lines)))
                scans[-1].take(lines.pick(some), numbers[some])
                at += len(some)
                continue
            one = lines.first[at] + np.arange(lines.counts[at])
            above.append([raw[begin:end] for begin, end in zip(lines.starts[one], lines.ends[one], strict=True)])
            _check_above(above, int(numbers[at]))
            at += 1
            if len(above) == len(_ABOVE):
                size = int(above[0][0]) * int(above[1][0])
                scans.append(_Scan(len(scans), _matrix(above, int(numbers[at - 1])), size))
                declared += scans[-1].left
                check_count(declared, max_points, where="the PTX file")
                above = []
    if scans and scans[-1].left:
        raise MalformedFile(f"the PTX file is truncated: scan {len(scans)} lacks {scans[-1].left} of its lines")
    if above:
        there = f"{len(above)} of the {len(_ABOVE)} lines above scan {len(scans) + 1} are there"
        raise MalformedFile(f"the PTX file is truncated: {there}")
    if not any(scan.count for scan in scans):
        raise UnsupportedCloud("nothing came back to the scanner of the PTX file: it holds no point")
    return [scan for scan in scans if scan.count]


def _lines(raw: bytes) -> Iterator[tuple[Lines, npt.NDArray[np.int64]]]:
    """Yield the lines that are not blank, block by block, with their numbers in the file."""
    number = 1
    for lines, _ in blocks(raw, 0, longest=_LONGEST_LINE):
        rows = np.flatnonzero(lines.counts > 0)
        yield lines.pick(rows), number + rows
        number += len(lines)


def _check_above(above: list[list[bytes]], number: int) -> None:
    """Raise MalformedFile where the last of the lines above a scan, with this number in the file, is no such line."""
    line, wanted = above[-1], _ABOVE[len(above) - 1]
    is_right = len(line) == wanted
    if wanted == 1:
        is_right = is_right and line[0].isdigit() and len(line[0]) <= _COUNT_DIGITS
    try:
        [as_number(token) for token in line]
    except ValueError:
        is_right = False
    if not is_right:
        what = "a number of columns or rows" if wanted == 1 else f"{wanted} numbers of a pose"
        raise MalformedFile(f"line {number} of the PTX file is not {what}, but {shown(b' '.join(line))}")


def _matrix(above: list[list[bytes]], number: int) -> npt.NDArray[np.float64]:
    """Return a scan's matrix (4, 4), whose last line has this number in the file; raises MalformedFile."""
    matrix = np.array([[as_number(token) for token in line] for line in above[_MATRIX]])
    is_pose = np.isfinite(matrix).all() and (matrix[:, 3] == [0, 0, 0, 1]).all()
    if not is_pose or not 1e-6 < abs(np.linalg.det(matrix[:3, :3])) < 1e6:
        raise MalformedFile(f"the matrix above line {number + 1} of the PTX file is no pose: {matrix.tolist()}")
    return matrix


def _whole(values: npt.NDArray[np.float64]) -> npt.NDArray[Any]:
    """Return (N,) parts of a colour as the bytes that they are; other numbers as they are."""
    are_bytes = (values >= 0) & (values <= 255) & (values == np.rint(values))
    return values.astype(np.uint8) if are_bytes.all() else values


def _new_file(cloud: PointCloud) -> bytes:
    """Lay out one scan of one column, whose frame is the cloud's own."""
    columns = intensity_and_colour(cloud)
    there = {"intensity": np.full(len(cloud), _NO_INTENSITY)} | columns
    return table_lines(["1", str(len(cloud)), *_NEW], axis_columns(cloud) | there, " ")
