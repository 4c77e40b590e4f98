"""The Prefer header (RFC 7240): respond-async and wait=N."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["Preference", "parse_prefer"]


@dataclass(frozen=True)
class Preference:
    """Hold what a client prefers; wait in seconds."""

    respond_async: bool = False
    wait: float | None = None

    @property
    def stated(self) -> bool:
        """Tell whether there is any preference."""
        return self.respond_async or self.wait is not None

    def applied(self, *, finished: bool, longest: float = math.inf) -> dict[str, str]:
        """Return the Preference-Applied header: what was heeded by an answer that waited `longest` seconds at most."""
        said = ["respond-async"] if self.respond_async and not finished else []
        if self.wait is not None and (finished or self.wait <= longest):
            said.append(f"wait={self.wait:.0f}")
        return {"Preference-Applied": ", ".join(said)} if said else {}


def parse_prefer(values: list[str]) -> Preference:
    """Read every Prefer header of a request; what is unknown or malformed is ignored, as the RFC asks."""
    respond_async, wait = False, None
    for item in ",".join(values).split(","):
        name, _, value = item.partition(";")[0].partition("=")
        text = value.strip().strip('"')
        if name.strip().lower() == "respond-async":
            respond_async = True
        elif name.strip().lower() == "wait" and text.isascii() and text.isdigit() and wait is None:
            wait = float(text[:9])
    return Preference(respond_async, wait)
