"""Archives of training clouds, .npz: what is wrong with one is said with its name, and one is written whole."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.model.patches import PATCH_SIZE
from straightpcf.points.errors import InvalidOptions, MalformedFile, TooFewPoints

__all__ = ["by_stem", "fingerprint", "opened", "read_array", "split_name", "write_archive"]

_ROWS = {"eye": (3,), "frame": (4,)}  # the shapes of what is no cloud
_MOST_EXTENT = 1e18  # its square is a float32
_NO_CLOUDS = ("eye", "frame", "normals")
_LENGTH_SLACK = 0.01  # normals come from files of few digits, too


@contextmanager
def opened(path: Path) -> Iterator[np.lib.npyio.NpzFile]:
    """Open an archive; what zipfile, zlib and numpy find wrong with it becomes MalformedFile, here and only here."""
    with path.open("rb") as file:
        if not zipfile.is_zipfile(file):
            raise MalformedFile(f"{path} is no NPZ file, or not a whole one")
    try:
        with np.load(path, allow_pickle=False) as archive:
            yield archive
    except KeyError as exc:  # numpy's says so
        raise MalformedFile(f"{path}: {exc.args[0]}") from exc
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError) as exc:
        raise MalformedFile(f"{path} cannot be read as NPZ: {exc}") from exc


def fingerprint(path: Path) -> int:
    """Tell an archive's arrays from others, by the names, sizes and checksums at its end: none of them is read."""
    with opened(path), zipfile.ZipFile(path) as archive:
        members = sorted((entry.filename, entry.file_size, entry.CRC) for entry in archive.infolist())
    return zlib.crc32(repr(members).encode())


def split_name(name: str, path: Path, *, rule: str = "<shape>/<resolution>") -> list[str]:
    """Return the parts of an array's name, as many as the rule has; raises MalformedFile."""
    parts = name.split("/")
    if len(parts) != len(rule.split("/")) or not all(parts):
        raise MalformedFile(f"{path}: an array is called {name[:80]!r}; it must be {rule}")
    return parts


def read_array(archive: np.lib.npyio.NpzFile, name: str, path: Path) -> npt.NDArray[np.float32]:
    """Read a cloud or what stands beside one; all numbers are finite, and normals are as long as they should be."""
    values, what = archive[name], name.rpartition("/")[2]
    is_array = isinstance(values, np.ndarray) and values.dtype.kind == "f"  # of another member, bytes
    shape = values.shape if is_array else ()
    if shape != _ROWS[what] if what in _ROWS else (len(shape) != 2 or shape[1] != 3):
        found = f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else "no array"
        wanted = f"({_ROWS[what][0]},)" if what in _ROWS else "(N, 3)"
        raise MalformedFile(f"{path}: {name[:80]} is {found}; it must be {wanted} floats")
    if not np.isfinite(values).all():
        raise MalformedFile(f"{path}: {name[:80]} holds NaN or infinity")
    if what == "normals" and len(wrong := _not_unit(values)):
        raise MalformedFile(f"{path}: {name[:80]} has {len(wrong)} of a length like {wrong[0]:g}; it must be 1")
    if what not in _NO_CLOUDS and len(values) < PATCH_SIZE:
        raise TooFewPoints(f"{path}: {name[:80]} has {len(values)} points; a training patch has {PATCH_SIZE}")
    if what not in _NO_CLOUDS and not 0 < (extent := float(np.ptp(values, axis=0).max())) < _MOST_EXTENT:
        raise MalformedFile(f"{path}: {name[:80]} is {extent:g} wide; it must be above 0 and below {_MOST_EXTENT:g}")
    return values


def _not_unit(normals: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the lengths that are not 1, of normals (N, 3)."""
    lengths = np.linalg.norm(normals.astype(np.float64), axis=1)
    return np.asarray(lengths[np.abs(lengths - 1) > _LENGTH_SLACK])


def by_stem(paths: Sequence[Path]) -> dict[str, Path]:
    """Return archives by the name that recorded clouds know them by; raises InvalidOptions where two have one."""
    found: dict[str, Path] = {}
    for path in paths:
        other = found.setdefault(path.stem, path)
        if other.resolve() != path.resolve():
            raise InvalidOptions(f"{other} and {path} have one name, by which recorded clouds tell their archive")
    return found


def write_archive(
    path: Path, arrays: Mapping[str, npt.NDArray[np.generic]], *, save: Callable[..., None] = np.savez
) -> None:
    """Write an archive, which replaces an old one whole, or OSError says where there was no room."""
    scratch = path.with_suffix(".tmp.npz")
    wanted: Any = arrays  # whose names may be anything
    try:
        save(scratch, **wanted)
        scratch.replace(path)
    except OSError as error:
        error.filename = error.filename or str(path)  # a full disk is told to a write, which has no name
        raise
    finally:
        scratch.unlink(missing_ok=True)
