"""What a client would rather have (RFC 9110, 12.5)."""

from __future__ import annotations

__all__ = ["asks_for"]


def asks_for(header: str, value: str, *, over: str | None = None) -> bool:
    """Say whether an Accept or Accept-Encoding header names a value, in any case, and not with the weight 0.

    over: the media type that is sent otherwise: neither its name nor, without that, a range (`*/*`) has more weight.
    """
    weights = _weights(header)
    weight = weights.get(value, 0.0)
    ranges = () if over is None else (over, f"{over.partition('/')[0]}/*", "*/*")  # the narrowest counts
    return weight > 0 and weight >= next((weights[name] for name in ranges if name in weights), 0.0)


def _weights(header: str) -> dict[str, float]:
    """Return the weight that each value is first named with: 1 where none that can be read is said."""
    weights: dict[str, float] = {}
    for item in header.lower().split(","):
        name, *parameters = (part.strip() for part in item.split(";"))
        told = [part[2:].strip() for part in parameters if part.startswith("q=")]
        try:
            weights.setdefault(name, float(told[0]) if told else 1.0)
        except ValueError:
            weights.setdefault(name, 1.0)
    return weights
