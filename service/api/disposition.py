"""What a Content-Disposition calls a file (RFC 6266, RFC 8187)."""

from __future__ import annotations

import re
from urllib.parse import quote, unquote

from python_multipart.multipart import parse_options_header

__all__ = ["disposition", "disposition_name"]

# Within quotes, where a blank or a comma says nothing; left out is what readers take for more than it is: " \ % ; * '
_PLAIN = re.compile(r"[\w.~ !#$&()+,=@\[\]{}^`-]+", re.ASCII)
# To the end where it is not closed: to look for the end anew from each of its quotes takes minutes.
_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*+"?')
_EXTENDED = re.compile(r";\s*filename\*\s*=\s*(UTF-8|ISO-8859-1)'[\w-]*'([\w!#$&+.^`|~%-]+)", re.ASCII | re.IGNORECASE)


def disposition(name: str) -> str:
    """Return a header that calls a file to be saved by any name, as ASCII; `curl -OJ` reads the plain form only."""
    if _PLAIN.fullmatch(name):
        return f'attachment; filename="{name}"'
    return f"attachment; filename*=utf-8''{quote(name, safe='')}"


def disposition_name(header: str) -> str | None:
    """Return the name of the file, or None; `filename*`, which can say any name, wins over `filename`.

    header: as Starlette gives it, a character a byte. RFC 7578 wants no `filename*` in forms, but clients send it.
    """
    if extended := _EXTENDED.search(_QUOTED.sub('""', header)):
        return unquote(extended[2], encoding=extended[1], errors="replace")
    name = parse_options_header(header)[1].get(b"filename")
    return None if name is None else name.decode("utf-8", errors="replace")
