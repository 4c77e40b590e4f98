"""The page at `/`: static files held in memory, sent with strict headers; it talks to the REST API alone."""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.responses import Response

from straightpcf.points.errors import NotFound
from straightpcf.service.api.negotiate import asks_for

__all__ = ["install_page"]

ASSET_PREFIX = "/static/"  # needs no API key, like "/" itself

_FOLDER = Path(__file__).parent / "static"
_MEDIA_TYPES: Mapping[str, str] = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    "": "text/plain; charset=utf-8",  # LICENSE, README
}
_HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": (
        "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    # Names carry no version: ask every time, and be told 304.
    "Cache-Control": "no-cache",
    "Vary": "Accept-Encoding",
}


@dataclass(frozen=True)
class Asset:
    """Hold one file of the page, plain and packed."""

    body: bytes
    packed: bytes
    media_type: str
    etag: str


def install_page(app: FastAPI) -> None:
    """Serve the page at `/` and its parts below ASSET_PREFIX; files are read once, when the app is made."""
    assets = {path.relative_to(_FOLDER).as_posix(): _asset(path) for path in _FOLDER.rglob("*") if path.is_file()}

    async def page(request: Request) -> Response:
        return _response(request, assets["index.html"])

    async def part(request: Request) -> Response:
        found = assets.get(request.path_params["path"])
        if found is None:
            raise NotFound(f"the page has no part {request.path_params['path'][:100]!r}")
        return _response(request, found)

    app.router.add_route("/", page, methods=["GET"], name="page", include_in_schema=False)
    app.router.add_route(ASSET_PREFIX + "{path:path}", part, methods=["GET"], name="asset", include_in_schema=False)


def _asset(path: Path) -> Asset:
    body = path.read_bytes()
    return Asset(
        body=body,
        packed=gzip.compress(body, compresslevel=6, mtime=0),
        media_type=_MEDIA_TYPES[path.suffix],
        etag=hashlib.sha256(body).hexdigest()[:32],
    )


def _response(request: Request, asset: Asset) -> Response:
    """Send an asset, packed for whom it suits, or 304 to who has it."""
    is_packed = asks_for(",".join(request.headers.getlist("accept-encoding")), "gzip")
    # A packed body is another representation: it needs a tag of its own.
    headers = {**_HEADERS, "ETag": f'"{asset.etag}{"-gz" if is_packed else ""}"'}
    had = ",".join(request.headers.getlist("if-none-match"))
    if asset.etag in had or had.strip() == "*":  # whichever: RFC 9110, 13.1.2
        return Response(status_code=304, headers=headers)
    if is_packed:
        headers["Content-Encoding"] = "gzip"
    return Response(asset.packed if is_packed else asset.body, media_type=asset.media_type, headers=headers)
