"""Turn what a user hands over into one HTTP request; touches no network."""

from __future__ import annotations

import asyncio
import io
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import InvalidCloud
from straightpcf.points.formats import format_for, format_named
from straightpcf.points.options import DenoiseOptions

__all__ = ["Call", "Source", "denoise_call"]

CHUNK_BYTES = 2**18

# An open3d cloud is recognised by its `points`, so that open3d need not be here.
Source: TypeAlias = str | Path | bytes | npt.NDArray[Any] | Any


@dataclass(frozen=True, kw_only=True)
class Call:
    """Describe one request; the body can be opened again for every attempt."""

    method: Literal["GET", "POST"]
    path: str
    params: dict[str, str] = field(default_factory=dict)
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes | Path | None = None

    @contextmanager
    def open_body(self) -> Iterator[bytes | IO[bytes] | None]:
        """Open the body for the sync client."""
        if isinstance(self.body, Path):
            with self.body.open("rb") as file:
                yield file
        else:
            yield self.body

    def stream_body(self) -> bytes | AsyncIterator[bytes] | None:
        """Open the body for the async client, files read off the event loop."""
        return _read_chunks(self.body) if isinstance(self.body, Path) else self.body


def denoise_call(
    source: Source, target: Path | None, *, iterations: int | str, seed: int, strength: float, format: str | None
) -> Call:
    """Build the request of one cloud; raises InvalidOptions, InvalidCloud, UnknownFormat before anything is sent."""
    options = DenoiseOptions.parse(iterations=str(iterations), seed=str(seed), strength=str(strength))
    name, body = _name_and_body(source)
    if format is None and target is not None and target.suffix.lower() != Path(name or "").suffix.lower():
        format = format_for(target.name).name
    params = {"iterations": str(options.iterations), "seed": str(options.seed), "strength": str(options.strength)}
    if name is not None:
        params["filename"] = name
    if format is not None:
        params["format"] = format_named(format).name
    size = body.stat().st_size if isinstance(body, Path) else len(body)
    headers = {"Content-Type": "application/octet-stream", "Content-Length": str(size)}
    return Call(method="POST", path="/denoise", params=params, headers=headers, body=body)


def _name_and_body(source: Source) -> tuple[str | None, bytes | Path]:
    if isinstance(source, str | Path):
        path = Path(source)
        return path.name, path
    if isinstance(source, bytes | bytearray | memoryview):
        return None, bytes(source)
    return "cloud.npy", _npy(np.asarray(getattr(source, "points", source)))


def _npy(xyz: npt.NDArray[Any]) -> bytes:
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind != "f":
        raise InvalidCloud(f"an array of points must be (N, 3) floating point, got {xyz.shape} {xyz.dtype}")
    buffer = io.BytesIO()
    np.save(buffer, xyz, allow_pickle=False)
    return buffer.getvalue()


async def _read_chunks(path: Path) -> AsyncIterator[bytes]:
    with await asyncio.to_thread(path.open, "rb") as file:
        while chunk := await asyncio.to_thread(file.read, CHUNK_BYTES):
            yield chunk
