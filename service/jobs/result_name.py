"""Name a result after its input."""

from __future__ import annotations

from pathlib import PurePosixPath

from straightpcf.points.formats import format_named

__all__ = ["result_name"]

_MOST_BYTES = 255  # of a file's name, on nearly every system; a letter may have four


def result_name(name: str | None, format: str) -> str:
    """Return `scan_clean.ply` for scan.ply; the suffix stays if it is one of the result's format.

    Of a name that would be too long to be saved the beginning is left out.
    """
    stem = PurePosixPath(name).stem if name else "cloud"
    suffixes = format_named(format).suffixes
    own = PurePosixPath(name).suffix.lower() if name else ""
    end = f"_clean{own if own in suffixes else suffixes[0]}"
    return stem.encode()[-(_MOST_BYTES - len(end)) :].decode(errors="ignore") + end
