"""NPY: one array whose first three columns are x, y, z; its type, order and further columns stay."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import PointCloud
from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.base import Format, check_count, check_room
from straightpcf.points.formats.positions import put_positions
from straightpcf.points.formats.scalars import further_columns

__all__ = ["ArrayHeader", "Npy", "NpySource", "array_bytes", "check_positions", "npy_source", "read_array_header"]

MAX_HEADER_BYTES = 1 << 16
_MAGIC = b"\x93NUMPY"


@dataclass(frozen=True)
class ArrayHeader:
    """Describe an array in a file; size: bytes up to its data."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    is_fortran: bool
    size: int

    @property
    def count(self) -> int:
        """Return the number of values, as a Python int that cannot overflow."""
        count = 1
        for length in self.shape:
            count *= length
        return count

    @property
    def data_bytes(self) -> int:
        """Return the bytes that follow the header."""
        return self.count * self.dtype.itemsize


@dataclass(frozen=True)
class NpySource:
    """Hold a whole NPY file and the positions that were read from it."""

    raw: bytes
    header: ArrayHeader
    xyz: npt.NDArray[np.float64]


class Npy(Format):
    """Read and write (N, M >= 3) arrays of float16, float32 or float64, either byte order, C or Fortran order."""

    name = "npy"
    suffixes = (".npy",)

    def sniff(self, head: bytes) -> bool:
        """Recognise numpy's magic."""
        return head.startswith(_MAGIC)

    def read(self, path: Path, *, max_points: int) -> PointCloud:
        """Read the array; columns after the third become attributes. Nothing is ever unpickled."""
        source = npy_source(path.read_bytes(), "the NPY file", max_points)
        return PointCloud(source.xyz.copy(), further_columns(array_of(source.raw, source.header)), source)

    def write(self, cloud: PointCloud, path: Path) -> None:
        """Write the file that was read with its positions replaced, or an (N, 3) float64 array without attributes."""
        source = cloud.source
        path.write_bytes(patched(source, cloud.xyz) if isinstance(source, NpySource) else array_bytes(cloud.xyz))


def npy_source(raw: bytes, where: str, max_points: int) -> NpySource:
    """Check and read a whole NPY file of positions; `where` names it in errors."""
    header = read_array_header(io.BytesIO(raw), where)
    check_positions(header, where)
    check_count(header.shape[0], max_points, where)
    check_room(header.size + header.data_bytes, len(raw), what=f"{where} of shape {header.shape}")
    return NpySource(raw, header, array_of(raw, header)[:, :3].astype(np.float64))


def patched(source: NpySource, xyz: npt.NDArray[np.float64]) -> bytearray:
    """Return the file with its positions replaced."""
    out = bytearray(source.raw)
    put_positions(list(array_of(out, source.header)[:, :3].T), xyz, source.xyz)
    return out


def read_array_header(file: IO[bytes], where: str) -> ArrayHeader:
    """Read the header at the file's position, bounded; raises MalformedFile."""
    try:
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file, max_header_size=MAX_HEADER_BYTES)
        elif version == (2, 0):
            shape, is_fortran, dtype = np.lib.format.read_array_header_2_0(file, max_header_size=MAX_HEADER_BYTES)
        else:
            raise UnsupportedCloud(f"{where} is of NPY version {version}; 1.0 and 2.0 hold plain arrays")
    except (ValueError, TypeError, KeyError, SyntaxError, RecursionError, OverflowError, Warning) as exc:
        raise MalformedFile(f"{where} has a broken NPY header: {exc}"[:300]) from exc
    if any(isinstance(length, bool) or not 0 <= length < 1 << 62 for length in shape):
        raise MalformedFile(f"{where} has a broken NPY header: its shape is {shape}"[:300])
    return ArrayHeader(dtype, shape, bool(is_fortran), file.tell())


def check_positions(header: ArrayHeader, where: str) -> None:
    """Raise UnsupportedCloud if the array cannot be positions."""
    if header.dtype.kind != "f" or header.dtype.itemsize not in (2, 4, 8):
        kind = "Python objects, which are never unpickled" if header.dtype.hasobject else str(header.dtype)[:80]
        raise UnsupportedCloud(f"{where} holds {kind}; positions must be float16, float32 or float64")
    if len(header.shape) != 2 or header.shape[1] < 3:
        hint = "; transpose it" if len(header.shape) == 2 and header.shape[0] == 3 else ""
        raise UnsupportedCloud(f"{where} has the shape {header.shape}; positions must be (N, 3) or wider{hint}")


def array_of(raw: bytes | bytearray, header: ArrayHeader) -> npt.NDArray[Any]:
    """View the array that stands in a whole NPY file; writable where raw is."""
    order: Literal["C", "F"] = "F" if header.is_fortran else "C"
    if header.data_bytes == 0:
        return np.empty(header.shape, header.dtype)
    return np.ndarray(header.shape, header.dtype, buffer=raw, offset=header.size, order=order)


def array_bytes(values: npt.NDArray[Any]) -> bytes:
    """Return a new NPY file."""
    np.lib.format.write_array(buffer := io.BytesIO(), np.ascontiguousarray(values), allow_pickle=False)
    return buffer.getvalue()
