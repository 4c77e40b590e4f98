"""Pack archives of training clouds for where little may be carried: 13 bits a coordinate, some 2 bytes a point.

python -m straightpcf.model.train.packing pack carried.npz --data punet_train.npz --data solids.npz --without 30000
python -m straightpcf.model.train.packing unpack carried.npz --into data

A float32 archive takes 12 bytes a point, and compresses badly. Points are sorted along a Morton curve (Morton 1966),
of whose codes the differences are kept: what is lost is their order, which nothing in training depends on.
"""

from __future__ import annotations

import argparse
import json
import lzma
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from straightpcf.model.train.archive import by_stem, opened, write_archive
from straightpcf.model.train.command import archive_to_write, errors_in_one_line, positive
from straightpcf.points.errors import MalformedFile

__all__ = ["unpack_archives", "write_packed"]

_BITS = 13  # of each coordinate: 1 part in 8,190 of the longest side, 1.2e-4 of it off at most
_HIGHEST = 2**_BITS - 2  # an even number of steps: the middle is one of them
_CODE_BYTES = -(-3 * _BITS // 8)
_NORMAL_STEPS = 127  # from the middle of the octahedron's square to its edge: normals are 1 degree off at most
_INDEX, _CODES, _NORMALS = "index", "codes", "normals"

_Bytes = npt.NDArray[np.uint8]
_Arrays = Mapping[str, npt.NDArray[np.generic]]


def write_packed(path: Path, data: Sequence[Path], *, without: Sequence[int] = ()) -> None:
    """Pack the archives `data`, clean clouds or recorded ones, into one .npz; `without`: clouds of so many points.

    Normals go with the cloud that they are of. Raises InvalidOptions where two archives have one name, MalformedFile,
    OSError.
    """
    by_stem(data)
    index: list[list[object]] = []
    codes: list[npt.NDArray[np.uint64]] = []
    normals: list[_Bytes] = []
    others: dict[str, npt.NDArray[np.generic]] = {}
    for archive in data:
        with opened(archive) as file:
            arrays = {name: _checked(file[name], archive, name) for name in file.files}
        finest = {_finest_beside(name, arrays): name for name in arrays if name.endswith("/normals")}
        for name, values in arrays.items():
            place = f"{archive.stem}/{name}"
            if name in finest.values() or name.rpartition("/")[2] in map(str, without):
                continue
            if values.ndim != 2:
                others[place] = values
                continue
            centre, half, code, order = _morton(values.astype(np.float64), archive, name)
            index.append([place, len(values), centre.tolist(), half])
            codes.append(np.diff(code, prepend=np.uint64(0)))
            if name in finest:
                if len(arrays[finest[name]]) != len(values):
                    raise MalformedFile(
                        f"{archive}: {finest[name][:80]} has {len(arrays[finest[name]])} rows for {len(values)} points"
                    )
                index.append([f"{archive.stem}/{finest[name]}", len(values)])
                normals.append(
                    np.diff(_octahedral(arrays[finest[name]][order]), axis=0, prepend=np.zeros((1, 2), np.uint8))
                )
    columns = np.concatenate(codes or [np.empty(0, np.uint64)]).astype("<u8").view(np.uint8).reshape(-1, 8)
    turned = np.concatenate(normals or [np.empty((0, 2), np.uint8)])
    packed = {_INDEX: np.array(json.dumps(index)), **others}
    packed |= {f"{_CODES}{n}": _compressed(columns[:, n]) for n in range(_CODE_BYTES)}
    packed |= {f"{_NORMALS}{n}": _compressed(turned[:, n]) for n in range(2)}
    write_archive(path, packed)


def unpack_archives(path: Path, into: Path) -> list[Path]:
    """Write the archives that `write_packed` packed as `<into>/<name>.npz`, and return their paths.

    Clouds are float32, of the points that were packed, in another order. Raises MalformedFile, OSError.
    """
    with opened(path) as file:
        if _INDEX not in file:
            raise MalformedFile(f"{path} is no packed archive: it has no {_INDEX}")
        index = json.loads(str(file[_INDEX]))
        columns = [_decompressed(file[f"{_CODES}{n}"], path) for n in range(_CODE_BYTES)]
        turned = [_decompressed(file[f"{_NORMALS}{n}"], path) for n in range(2)]
        parts = tuple(f"{kind}{n}" for kind, count in ((_CODES, _CODE_BYTES), (_NORMALS, 2)) for n in range(count))
        found = {name: file[name] for name in file.files if name not in (_INDEX, *parts)}
    code_at = normal_at = 0
    for name, count, *box in index:
        if box:
            some = slice(code_at, code_at := code_at + count)
            steps = np.zeros((count, 8), dtype=np.uint8)
            for n, column in enumerate(columns):
                steps[:, n] = column[some]
            found[name] = _placed(np.cumsum(steps.view("<u8")[:, 0], dtype=np.uint64), *box)
        else:
            some = slice(normal_at, normal_at := normal_at + count)
            # Sums wrap around as the differences did.
            found[name] = _unit(np.stack([np.cumsum(c[some], dtype=np.uint8) for c in turned], axis=1))
    archives: dict[str, dict[str, npt.NDArray[np.generic]]] = {}
    for name, values in found.items():
        stem, _, rest = name.partition("/")
        archives.setdefault(stem, {})[rest] = values
    into.mkdir(parents=True, exist_ok=True)
    paths = [into / f"{stem}.npz" for stem in archives]
    for each, arrays in zip(paths, archives.values(), strict=True):
        write_archive(each, arrays)
    return paths


def _checked(values: object, archive: Path, name: str) -> npt.NDArray[np.generic]:
    """Return what an archive holds under a name; raises MalformedFile of what is no array, and of two axes no cloud."""
    if not isinstance(values, np.ndarray):  # of another member, bytes
        raise MalformedFile(f"{archive}: {name[:80]} is no array")
    if values.ndim == 2 and (values.shape[1] != 3 or len(values) == 0 or values.dtype.kind not in "fiu"):
        raise MalformedFile(f"{archive}: {name[:80]} is {values.dtype} {values.shape}; it must be (N, 3) numbers")
    return values


def _finest_beside(name: str, arrays: _Arrays) -> str:
    """Return the name of the cloud that normals belong to: the shape's surface, or its cloud of most points."""
    shape = name.rpartition("/")[0]
    if (surface := f"{shape}/surface") in arrays:
        return surface
    clouds = [each for each in arrays if each.rpartition("/")[0] == shape and each.rpartition("/")[2].isdecimal()]
    return max(clouds, key=lambda each: len(arrays[each]), default=name)


def _morton(
    xyz: npt.NDArray[np.float64], archive: Path, name: str
) -> tuple[npt.NDArray[np.float64], float, npt.NDArray[np.uint64], npt.NDArray[np.int64]]:
    """Return a cloud's middle and half its longest side, its sorted codes, and the order that sorts its points."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    centre, half = (low + high) / 2, float((high - low).max() / 2)
    if not (np.isfinite(half) and half > 0):
        raise MalformedFile(f"{archive}: {name[:80]} is no cloud: half its longest side is {half:g}")
    steps = np.round((xyz - centre) / half * (_HIGHEST / 2) + _HIGHEST / 2).clip(0, _HIGHEST).astype(np.uint64)
    code = np.zeros(len(xyz), dtype=np.uint64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= ((steps[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    order = np.argsort(code, kind="stable")
    return centre, half, code[order], order


def _placed(code: npt.NDArray[np.uint64], centre: list[float], half: float) -> npt.NDArray[np.float32]:
    steps = np.zeros((len(code), 3))
    for bit in range(_BITS):
        for axis in range(3):
            steps[:, axis] += ((code >> np.uint64(3 * bit + axis)) & np.uint64(1)).astype(np.float64) * 2**bit
    return np.asarray((steps - _HIGHEST / 2) / (_HIGHEST / 2) * half + np.array(centre), dtype=np.float32)


def _octahedral(normals: npt.NDArray[np.generic]) -> _Bytes:
    """Map unit normals (N, 3) to places (N, 2) in the square that an octahedron unfolds to (Meyer et al. 2010)."""
    wide = normals.astype(np.float64)
    wide /= np.abs(wide).sum(axis=1, keepdims=True)
    return np.round((_folded(wide[:, :2], wide[:, 2]) + 1) * _NORMAL_STEPS).astype(np.uint8)


def _unit(place: _Bytes) -> npt.NDArray[np.float32]:
    flat = place.astype(np.float64) / _NORMAL_STEPS - 1
    height = 1 - np.abs(flat).sum(axis=1)
    normals = np.column_stack([_folded(flat, height), height])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals.astype(np.float32)


def _folded(place: npt.NDArray[np.float64], height: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Fold the corners of the square over its middle, which is the upper half, or back: places (N, 2)."""
    over = (1 - np.abs(place[:, [1, 0]])) * np.where(place >= 0, 1.0, -1.0)
    return np.where(height[:, None] < 0, over, place)


def _compressed(column: _Bytes) -> _Bytes:
    return np.frombuffer(lzma.compress(column.tobytes()), dtype=np.uint8)


def _decompressed(column: npt.NDArray[np.generic], path: Path) -> _Bytes:
    try:
        return np.frombuffer(lzma.decompress(column.tobytes()), dtype=np.uint8)
    except lzma.LZMAError as exc:
        raise MalformedFile(f"{path} cannot be unpacked: {exc}") from exc


@errors_in_one_line()
def _main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    pack = commands.add_parser("pack", help="archives into one file")
    pack.add_argument("path", type=archive_to_write, help="the .npz to write")
    pack.add_argument("--data", type=Path, action="append", required=True, help="an archive; may be given again")
    pack.add_argument("--without", type=positive, nargs="+", default=(), help="leave clouds of so many points out")
    unpack = commands.add_parser("unpack", help="one file into the archives that it was packed of")
    unpack.add_argument("path", type=Path)
    unpack.add_argument("--into", type=Path, default=Path(), help="the folder to write them to")
    options = parser.parse_args()
    if options.command == "pack":
        write_packed(options.path, options.data, without=options.without)
    else:
        for path in unpack_archives(options.path, options.into):
            sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    _main()
