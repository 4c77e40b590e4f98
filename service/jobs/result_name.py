"""Name a result after its input."""

from __future__ import annotations

from pathlib import PurePosixPath

from straightpcf.points.formats import format_named

__all__ = ["result_name"]


def result_name(name: str | None, format: str) -> str:
    """Return `scan_clean.ply` for scan.ply; the suffix stays if it is one of the result's format."""
    stem = PurePosixPath(name).stem if name else "cloud"
    suffixes = format_named(format).suffixes
    own = PurePosixPath(name).suffix.lower() if name else ""
    return f"{stem}_clean{own if own in suffixes else suffixes[0]}"
