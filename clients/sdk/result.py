"""What the SDK gives back: the file, and what the server said about it."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from email.message import Message
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from straightpcf.clients.atomic import replaced_when_complete

__all__ = ["Denoised"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Denoised:
    """Hold one result, on disk at `path` if a target was named, else in memory as `content`.

    noise_before, noise_after: the server's estimates in the cloud's own unit, NaN if unknown.
    untouched: points that were NaN or infinite and passed through.
    """

    filename: str
    request_id: str
    points: int
    iterations: int
    noise_before: float
    noise_after: float
    untouched: int
    content: bytes | None = field(default=None, repr=False)
    path: Path | None = None
    source: Any = field(default=None, repr=False)

    @classmethod
    def from_headers(cls, headers: Mapping[str, str], **held: Any) -> Denoised:
        """Read the headers of a successful response."""
        return cls(
            filename=_filename(headers.get("Content-Disposition", "")),
            request_id=headers.get("X-Request-Id", ""),
            points=int(headers["X-Points"]),
            iterations=int(headers["X-Iterations"]),
            noise_before=float(headers["X-Noise-Before"]),
            noise_after=float(headers["X-Noise-After"]),
            untouched=int(headers["X-Untouched"]),
            **held,
        )

    @cached_property
    def xyz(self) -> npt.NDArray[np.floating[Any]]:
        """The positions, (N, 3): of the array's own dtype if an array was sent, else float64."""
        if self.filename.endswith(".npy"):
            return np.asarray(np.load(io.BytesIO(self.read()), allow_pickle=False))
        from straightpcf.points.formats import read_cloud

        if self.path is not None:
            return read_cloud(self.path, name=self.filename)[0].xyz
        with tempfile.TemporaryDirectory() as folder:
            path = self.save(Path(folder) / "cloud")
            return read_cloud(path, name=self.filename)[0].xyz

    def read(self) -> bytes:
        """Return the whole result file."""
        if self.content is not None:
            return self.content
        assert self.path is not None
        return self.path.read_bytes()

    def save(self, path: str | Path) -> Path:
        """Write the result file, complete or not at all."""
        path = Path(path)
        with replaced_when_complete(path) as unfinished:
            unfinished.write_bytes(self.read())
        return path

    def to_open3d(self) -> Any:
        """Return an open3d cloud: a copy of the one that was sent, if one was, at the new positions."""
        import open3d

        cloud = open3d.geometry.PointCloud(self.source) if self.source is not None else open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(np.asarray(self.xyz, dtype=np.float64))
        return cloud


def _filename(disposition: str) -> str:
    message = Message()
    message["Content-Disposition"] = disposition
    name = message.get_filename() or "cloud"
    return Path(unquote(name)).name
