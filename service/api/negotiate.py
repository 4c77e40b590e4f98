"""What a client would rather have (RFC 9110, 12.5)."""

from __future__ import annotations

__all__ = ["asks_for"]


def asks_for(header: str, value: str) -> bool:
    """Say whether an Accept or Accept-Encoding header names a value, in any case, and not with the weight 0."""
    for item in header.lower().split(","):
        name, *parameters = (part.strip() for part in item.split(";"))
        if name == value:
            weights = [part[2:].strip() for part in parameters if part.startswith("q=")]
            return not weights or weights[0].strip("0.") != ""
    return False
