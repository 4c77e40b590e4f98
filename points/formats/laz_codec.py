"""LASzip compression of LAS points through lazrs; what a broken file could make it do is checked first."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile, MissingDependency, UnsupportedCloud
from straightpcf.points.formats.base import check_room, check_unpacked
from straightpcf.points.formats.las_layout import LASZIP_ID, LasHeader, standard_bytes, value_bytes

__all__ = ["check_packing", "pack", "packing_record", "unpack"]

VARIABLE_CHUNKS = 0xFFFFFFFF
_WITH_WAVES, _PACKED_ANEW = (4, 5, 9, 10), (0, 1, 2, 3, 6, 7, 8)  # point formats
_TRIAL_POINTS = 50_000  # a chunk
_STEP_BYTES = 4 << 20  # that are packed, and unpacked again to be compared, at a time
_POINTWISE, _LAYERED = 2, 3
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # item type -> layers of one chunk; type 14, extra bytes, has one a byte


def _lazrs() -> Any:
    try:
        import lazrs
    except ImportError as exc:
        raise MissingDependency("LAZ needs the extra straightpcf[las]: pip install 'straightpcf[las]'") from exc
    return lazrs


@contextmanager
def _converted() -> Iterator[None]:
    """Turn what lazrs raises into MalformedFile, here and only here."""
    try:
        yield
    except (RuntimeError, OSError, ValueError, OverflowError, EOFError) as exc:
        raise MalformedFile(f"the LAZ points cannot be unpacked: {exc}") from exc
    except BaseException as exc:
        if type(exc).__name__ != "PanicException":  # how a Rust panic arrives: no Exception, not importable
            raise
        raise MalformedFile(f"the LAZ points cannot be unpacked: {exc}") from exc


def unpack(raw: bytes, header: LasHeader) -> bytearray:
    """Return the points' bytes, points x row_bytes."""
    lazrs = _lazrs()
    if not header.points:
        return bytearray()
    record = header.record(*LASZIP_ID)
    if record is None:
        raise MalformedFile("a LAZ file without a laszip record: nothing says how its points are packed")
    chunk_size = _check_record(record.data, header)
    # A few kilobytes can be valid and unpack to hundreds of gigabytes: layers that never change take no byte at all.
    size = header.points * value_bytes(header)
    check_unpacked(size, len(raw), what=f"the LAS header of {header.points} packed points")
    _check_chunk_table(raw, header, chunk_size)
    with _converted():
        lazrs.LazVlr(record.data)
        source = BytesIO(raw)
        source.seek(header.data_begin)
        chunks = lazrs.read_chunk_table(source, lazrs.LazVlr(record.data))
    _check_chunks(raw, header, record.data, [(int(points), int(size)) for points, size in chunks], chunk_size)
    out = bytearray(header.points * header.row_bytes)
    with _converted():
        source.seek(header.data_begin)
        lazrs.LasZipDecompressor(source, record.data).decompress_many(out)
    return out


def packing_record(header: LasHeader) -> bytes:
    """Return the laszip record's data to pack with: the file's own where it can be written again, else a new one."""
    lazrs = _lazrs()
    record = header.record(*LASZIP_ID)
    if record is not None and header.points:
        chunk_size = _check_record(record.data, header)
        versions = [version for _, _, version in _items(record.data)]
        if chunk_size != VARIABLE_CHUNKS and min(versions) >= 2:
            return record.data
    if header.point_format not in _PACKED_ANEW:
        raise UnsupportedCloud(f"LAS point format {header.point_format} cannot be packed as LAZ; write LAS")
    extra = header.row_bytes - standard_bytes(header.point_format)
    return bytes(lazrs.LazVlr.new_for_compression(header.point_format, extra).record_data())


def check_packing(header: LasHeader | None = None, rows: npt.NDArray[np.uint8] | None = None) -> None:
    """Raise MissingDependency without lazrs, UnsupportedCloud where it cannot pack such points; None: new ones.

    Some wave packets come out of lazrs changed: a chunk of them is packed as a trial.
    """
    _lazrs()
    if header is None or rows is None:
        return
    record = packing_record(header)
    if header.point_format in _WITH_WAVES:
        pack(rows[:_TRIAL_POINTS], record, 0)


def pack(rows: npt.NDArray[np.uint8], record: bytes, begin: int) -> bytes:
    """Pack points (N, row_bytes); the chunk table's place counts from the file's start, the points begin at `begin`.

    Raises UnsupportedCloud where they do not unpack to the same bytes: lazrs 0.8 loses bits of some wave packets.
    """
    lazrs = _lazrs()
    step = max(_STEP_BYTES // rows.shape[1], 1)
    sink = BytesIO(bytes(begin))
    sink.seek(begin)
    with _converted():
        packer = lazrs.LasZipCompressor(sink, lazrs.LazVlr(record))
        for first in range(0, len(rows), step):
            packer.compress_many(rows[first : first + step].reshape(-1))
        packer.done()
        sink.seek(begin)
        unpacker: Any = lazrs.LasZipDecompressor(sink, record) if len(rows) else None
    for first in range(0, len(rows), step):
        block = rows[first : first + step]
        again = np.empty_like(block)
        with _converted():
            unpacker.decompress_many(again.reshape(-1))
        differs = (again != block).any(axis=1)
        if differs.any():
            row = first + int(np.argmax(differs))
            raise UnsupportedCloud(f"lazrs cannot pack point {row} as LAZ without loss; write LAS")
    return sink.getvalue()[begin:]


def _items(record: bytes) -> list[tuple[int, int, int]]:
    """Return the items as (type, bytes, version)."""
    count = struct.unpack_from("<H", record, 32)[0]
    return [struct.unpack_from("<HHH", record, 34 + 6 * item) for item in range(count)]


def _check_record(record: bytes, header: LasHeader) -> int:
    """Check the laszip record against the header; return the points of a chunk."""
    check_room(34, len(record), what="the laszip record")
    packer, coder = struct.unpack_from("<HH", record, 0)
    chunk_size, count = struct.unpack_from("<I", record, 12)[0], struct.unpack_from("<H", record, 32)[0]
    check_room(34 + 6 * count, len(record), what=f"the laszip record of {count} items")
    if packer not in (_POINTWISE, _LAYERED) or coder != 0:
        raise UnsupportedCloud(f"LASzip compressor {packer}, coder {coder} is not known; 2 and 3 with coder 0 are")
    size = sum(size for _, size, _ in _items(record))
    if size != header.row_bytes:
        raise MalformedFile(f"the laszip record packs {size} bytes a point, the LAS header declares {header.row_bytes}")
    if chunk_size == 0:
        raise MalformedFile("the laszip record declares chunks of 0 points")
    return int(chunk_size)


def _check_chunk_table(raw: bytes, header: LasHeader, chunk_size: int) -> None:
    """Check where the chunk table is and how many chunks it declares: lazrs takes memory for that many."""
    begin = header.data_begin
    check_room(8, len(raw) - begin, what="the offset of the LAZ chunk table")
    (table,) = struct.unpack_from("<q", raw, begin)
    if table == -1:  # written to a pipe: the offset is at the end
        (table,) = struct.unpack_from("<q", raw, len(raw) - 8)
    if not begin + 8 <= table <= len(raw) - 8:
        raise MalformedFile(f"the LAZ chunk table is said to be at byte {table}, outside {begin + 8}..{len(raw) - 8}")
    _, chunks = struct.unpack_from("<II", raw, table)
    check_room(chunks * header.row_bytes, table - begin, what=f"LAZ data of {chunks} chunks")
    if chunk_size != VARIABLE_CHUNKS and header.points > chunks * chunk_size:
        raise MalformedFile(
            f"the LAS header declares {header.points} points, but {chunks} LAZ chunks of {chunk_size} hold fewer"
        )


def _check_chunks(raw: bytes, header: LasHeader, record: bytes, chunks: list[tuple[int, int]], chunk_size: int) -> None:
    """Check every chunk's place, and the sizes of its layers: lazrs takes memory for what they declare."""
    if chunk_size == VARIABLE_CHUNKS and sum(points for points, _ in chunks) != header.points:
        raise MalformedFile(
            f"the LAS header declares {header.points} points, the LAZ chunks {sum(points for points, _ in chunks)}"
        )
    is_layered = struct.unpack_from("<H", record, 0)[0] == _LAYERED
    layers = sum(_LAYERS.get(kind, size) for kind, size, _ in _items(record))
    at = header.data_begin + 8
    for number, (_, size) in enumerate(chunks):
        check_room(size, len(raw) - at, what=f"LAZ chunk {number} at byte {at}")
        if is_layered:
            head = header.row_bytes + 4 + 4 * layers
            check_room(head, size, what=f"the head of LAZ chunk {number} at byte {at}")
            sizes = struct.unpack_from(f"<{layers}I", raw, at + header.row_bytes + 4)
            check_room(head + sum(sizes), size, what=f"LAZ chunk {number} at byte {at} of {layers} layers")
        at += size
