"""What the SDK gives back: the file, and what the server said about it."""

from __future__ import annotations

import io
import tempfile
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.clients.atomic import replaced_when_complete
from straightpcf.clients.sdk.job_info import JobInfo, Report
from straightpcf.points.errors import MissingDependency

__all__ = ["Denoised"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Denoised:
    """Hold one result, on disk at `path` if a target was named, else in memory as `content`.

    job: as the server told it at the end. source: the open3d cloud that was sent, if one was.
    """

    job: JobInfo
    request_id: str
    content: bytes | None = field(default=None, repr=False)
    path: Path | None = None
    source: Any = field(default=None, repr=False)

    @property
    def report(self) -> Report:
        """What was done: passes, noise, displacement, timings, warnings."""
        assert self.job.report is not None
        return self.job.report

    @property
    def filename(self) -> str:
        """The name that the server gives the file, without folders."""
        return Path(self.job.result.filename).name if self.job.result is not None else "cloud"

    @property
    def points(self) -> int:
        """How many points the cloud has."""
        return self.report.points

    @property
    def iterations(self) -> int:
        """How many passes were made."""
        return self.report.iterations

    @property
    def noise_before(self) -> float:
        """The noise's std as estimated before, in the cloud's own unit, NaN if unknown."""
        return self.report.noise_before

    @property
    def noise_after(self) -> float:
        """The noise's std as estimated after the last pass, in the cloud's own unit, NaN if unknown."""
        return self.report.noise_after

    @property
    def untouched(self) -> int:
        """How many points were NaN, infinite, meant "no data" or lay apart from all others, and passed through."""
        return self.report.untouched

    @cached_property
    def xyz(self) -> npt.NDArray[np.floating[Any]]:
        """The positions, (N, 3): of the array's own dtype if an array was sent, else float64."""
        if self.filename.endswith(".npy"):
            array = np.asarray(np.load(io.BytesIO(self.read()), allow_pickle=False))
            if array.dtype.names is None:  # else a table of records
                return array[:, :3]
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
        try:
            import open3d
        except ImportError as exc:
            raise MissingDependency.of("open3d", exc) from exc

        cloud = open3d.geometry.PointCloud(self.source) if self.source is not None else open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(np.asarray(self.xyz, dtype=np.float64))
        return cloud
