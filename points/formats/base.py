"""What every format does: recognise its bytes, read a cloud, write one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from pathlib import Path
from typing import ClassVar

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, TooManyBytes, TooManyPoints
from straightpcf.points.formats.scalars import not_held

__all__ = ["DEFAULT_MAX_POINTS", "HEAD_BYTES", "Format", "check_count", "check_room", "check_unpacked", "most_unpacked"]

DEFAULT_MAX_POINTS = 100_000_000
HEAD_BYTES = 4096  # what `sniff` sees of a file
SMALL_UNPACKED_BYTES = 256 << 20  # that a file of any size may unpack to
MAX_UNPACKED_RATIO = 40  # of a larger one: aerial scans pack 6 to 20 to 1 as LAZ


class Format(ABC):
    """Read and write one kind of file.

    A format that reads a cloud and writes it again changes nothing but the positions that moved; the rest of the file,
    down to the bits of a NaN, comes back. It may raise anything on a broken file: `read_cloud` makes it MalformedFile.
    """

    name: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]]
    media_type: ClassVar[str] = "application/octet-stream"
    writes_normals: ClassVar[bool] = False  # that were recomputed, in the place of the file's own
    has_magic: ClassVar[bool] = True  # False: only the file's suffix says what it is
    types: ClassVar[Collection[str]] = ()  # of the numbers that a new file has columns for, such as "f4"

    def sniff(self, head: bytes) -> bool:
        """Tell whether a file that begins with `head` (up to 4 KiB) is of this format; one without magic never says."""
        return False

    def estimate(self, head: bytes, size: int) -> int:
        """Guess the points of a file of `size` bytes that begins with `head`: for admission, before it is read."""
        return size // 16

    @abstractmethod
    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read a file; raises MalformedFile, UnsupportedCloud, TooManyPoints, the last before memory is taken."""

    def left_behind(self, cloud: PointCloud) -> list[str]:
        """Name what a cloud read of another format holds and a file of this one does not, or only rounded."""
        return [*cloud.beside, *not_held(cloud.attributes, self.types)]

    def check(self, cloud: PointCloud) -> None:  # noqa: B027 - most formats hold every cloud
        """Raise what `write` would of a cloud, of this or of another format, wherever its points are then moved to."""

    @abstractmethod
    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write a cloud: into the file it came from, as `cloud.source` holds it, or else into a new one."""


def check_count(declared: int, max_points: int, where: str) -> None:
    """Raise TooManyPoints if `where` declares more than max_points."""
    if declared > max_points:
        raise TooManyPoints(f"{where} declares {declared} points; the limit is {max_points}")


def check_room(needed: int, available: int, *, what: str) -> None:
    """Raise MalformedFile if `what` needs more bytes than the file still has, before memory is taken for it."""
    if needed > available:
        raise MalformedFile(f"{what} needs at least {needed} bytes, the file has {max(available, 0)}: it is truncated")


def most_unpacked(packed: int) -> int:
    """Return how many bytes a file of `packed` ones may take unpacked: a bomb takes all memory."""
    return max(SMALL_UNPACKED_BYTES, MAX_UNPACKED_RATIO * packed)


def check_unpacked(unpacked: int, packed: int, *, what: str) -> None:
    """Raise TooManyBytes where `what` declares more bytes than a file of `packed` ones may."""
    limit = most_unpacked(packed)
    if unpacked > limit:
        raise TooManyBytes(f"{what} declares {unpacked} bytes unpacked; the limit for {packed} bytes is {limit}")
