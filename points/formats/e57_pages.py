"""The pages of an E57 file (ASTM E2807), each with a checksum, which places in the file count, too."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["PAGE", "PAYLOAD", "checksums", "in_pages", "paged", "unpaged"]

PAGE, _CHECKSUM = 1024, 4  # bytes of a page, with those of its checksum at its end
PAYLOAD = PAGE - _CHECKSUM
_CRC32C = 0x82F63B78  # Castagnoli's polynomial, its bits reversed
_PAGES_AT_ONCE = 1 << 14


def unpaged(offset: int) -> int:
    """Turn a place in the file into one without checksums."""
    page, within = divmod(offset, PAGE)
    return page * PAYLOAD + min(within, PAYLOAD)


def paged(place: int) -> int:
    """Turn a place without checksums into one in the file."""
    page, within = divmod(place, PAYLOAD)
    return page * PAGE + within


def checksums(pages: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint32]:
    """Return the CRC-32C of each of (N, 1024) pages, of all but its last four bytes: (N,)."""
    table, found = _table(), np.empty(len(pages), np.uint32)
    for begin in range(0, len(pages), _PAGES_AT_ONCE):
        some = pages[begin : begin + _PAGES_AT_ONCE]
        crc = np.full(len(some), 0xFFFFFFFF, np.uint32)
        for pair in np.ascontiguousarray(some[:, :PAYLOAD]).view("<u2").T:
            crc = (crc >> 16) ^ table[(crc ^ pair) & 0xFFFF]
        found[begin : begin + len(some)] = ~crc
    return found


def in_pages(content: bytearray) -> bytes:
    """Return a file of this content, in whole pages with their checksums."""
    count = -(-len(content) // PAYLOAD)
    pages = np.empty((count, PAGE), np.uint8)
    pages[:, :PAYLOAD] = np.frombuffer(content.ljust(count * PAYLOAD, b"\0"), np.uint8).reshape(count, PAYLOAD)
    pages[:, PAYLOAD:] = checksums(pages).astype(">u4")[:, None].view(np.uint8)
    return pages.tobytes()


def _table() -> npt.NDArray[np.uint32]:
    """Return what two bytes make of a checksum, the lower one first: (65536,)."""
    table: npt.NDArray[np.uint32] = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        table = (table >> np.uint32(1)) ^ np.where(table & 1, np.uint32(_CRC32C), np.uint32(0))
    return table
