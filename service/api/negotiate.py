"""What a client would rather have (RFC 9110, 12.5)."""

from __future__ import annotations

__all__ = ["asks_for"]


def asks_for(header: str, value: str, *, over: str | None = None) -> bool:
    """Say whether an Accept or Accept-Encoding header names a value, in any case, and not with the weight 0.

    over: what else could be sent: it is not named with more weight, either.
    """
    weight = _weight(header, value)
    return weight > 0 and (over is None or weight >= _weight(header, over))


def _weight(header: str, value: str) -> float:
    """Return the weight that a value is named with: 1 where none that can be read is said, 0 where it is not named."""
    for item in header.lower().split(","):
        name, *parameters = (part.strip() for part in item.split(";"))
        if name == value:
            weights = [part[2:].strip() for part in parameters if part.startswith("q=")]
            try:
                return float(weights[0]) if weights else 1.0
            except ValueError:
                return 1.0
    return 0.0
