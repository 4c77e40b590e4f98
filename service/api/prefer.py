"""The Prefer header (RFC 7240): respond-async and wait=N."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

__all__ = ["Preference", "parse_prefer"]

# What stands between commas, and of it a preference with its value, which parameters may follow (RFC 7240, 2). A comma
# in quotes is none; where quotes do not end, the rest is in them. Nothing is tried twice: a header may be long.
_ITEM = re.compile(r'(?:"(?:\\.|[^"\\])*+"?+|[^",]++)++')
_PREFERENCE = re.compile(r'\s*+([^\s=;"]++)\s*+(?:=\s*+("(?:\\.|[^"\\])*+"|[^\s;"]*+)\s*+)?+(?:;|$)')
_ESCAPED = re.compile(r"\\(.)")


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
    """Read every Prefer header of a request; what is unknown or malformed is ignored, as the RFC asks.

    So is respond-async with a value, which it has none of ("=false"), and all but the first of what is said twice.
    """
    said: dict[str, str] = {}
    for item in (item for value in values for item in _ITEM.findall(value)):
        if found := _PREFERENCE.match(item):
            word = found[2] or ""
            said.setdefault(found[1].lower(), _ESCAPED.sub(r"\1", word[1:-1]) if word.startswith('"') else word)
    wait = said.get("wait", "")
    is_wait = wait.isascii() and wait.isdigit()
    return Preference(said.get("respond-async") == "", float(wait[:9]) if is_wait else None)
