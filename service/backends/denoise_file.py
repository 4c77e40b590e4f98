"""Denoise one file into another: the straight line that the worker and the command line share."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import NORMALS, PointCloud
from straightpcf.points.errors import UnsupportedCloud
from straightpcf.points.formats import FORMATS, format_named, read_cloud, write_cloud
from straightpcf.points.formats.base import Format
from straightpcf.points.wire.patches import encode_end, encode_frame, encode_header
from straightpcf.service.backends.base import FileJob, FileReport

if TYPE_CHECKING:
    from straightpcf.model.filter import DenoiseResult, Filter

__all__ = ["denoise_file"]

PREVIEW_POINTS = 256
_NAMED = 10  # of what a conversion leaves behind

OnProgress = Callable[[float, int], None]
OnPreview = Callable[[int, list[int], list[list[float]]], None]


def denoise_file(
    denoiser: Filter,
    job: FileJob,
    *,
    on_progress: OnProgress | None = None,
    on_preview: OnPreview | None = None,
    heed: Callable[[], None] | None = None,
) -> FileReport:
    """Read, denoise and write; raises StraightPCFError, and whatever on_progress raises to stop the work.

    heed: called more often than that, and may raise as well (`Filter.heeding`).
    The target is on the disk, not only in its cache, when this returns.
    """
    from straightpcf.model.normals import recompute_normals

    began = time.monotonic()
    cloud, source_format = read_cloud(job.source, name=job.name or "the cloud", max_points=job.max_points)
    target_format = source_format if job.format is None else format_named(job.format)
    if job.options.normals == "recompute":
        if target_format is not source_format:  # which finds an array of normals where it was
            cloud = replace(cloud, attributes=cloud.in_columns())
        _check_normals(cloud, target_format)
    target_format.check(cloud)
    if on_progress is not None:
        on_progress(0.0, 0)
    was_read = time.monotonic()
    with denoiser.heeding(heed) if heed is not None else nullcontext():
        result = _filtered(denoiser, cloud, job, on_progress, on_preview)
    was_filtered = time.monotonic()
    clean = cloud.with_xyz(result.xyz)
    if job.options.normals == "recompute":
        clean = clean.with_normals(recompute_normals(clean.xyz, clean.old_normals(), workers=denoiser.threads))
    write_cloud(clean, job.target, target_format)
    size, sha256 = _settle(job.target)
    ended = time.monotonic()
    return FileReport(
        format=target_format.name,
        points=len(cloud),
        untouched=result.untouched,
        iterations=result.iterations,
        noise_before=result.noise_before,
        noise_after=result.noise_after,
        distances=result.distances,
        displacement=_displacement(cloud.xyz, result.xyz),
        seconds=ended - began,
        timings={"read": was_read - began, "filter": was_filtered - was_read, "write": ended - was_filtered},
        device=denoiser.device,
        bytes=size,
        sha256=sha256,
        warnings=(*result.warnings, *_left_behind(clean, source_format, target_format)),
    )


def _filtered(
    denoiser: Filter, cloud: PointCloud, job: FileJob, on_progress: OnProgress | None, on_preview: OnPreview | None
) -> DenoiseResult:
    """Filter a cloud, and tell of each patch as it is finished; the patches are in their file when this returns."""
    from straightpcf.model.objects import begin

    began = time.monotonic()
    run, preview = begin(denoiser, cloud.xyz, job.options), _Preview(len(cloud), on_preview)
    with _PatchFile(job.patches) if job.patches is not None else nullcontext() as patches:
        if patches is not None:
            patches.write(encode_header(len(cloud)))
        for patch in run.patches():
            if patches is not None and len(patch.indices):
                patches.write(
                    encode_frame(patch.indices, patch.xyz, iteration=patch.iteration, final=patch.final,
                                 progress=patch.progress)
                )  # fmt: skip
            preview.add(patch.iteration, patch.indices, patch.xyz)
            if on_progress is not None:
                on_progress(patch.progress, patch.iteration)
        preview.end()
        result = run.result(time.monotonic() - began)
        if patches is not None:
            patches.write(encode_end(result.iterations))
    return result


class _PatchFile:
    """Append frames, each whole and at once, so that a reader can follow the file."""

    def __init__(self, path: Path) -> None:
        self._file: IO[bytes] = path.open("wb", buffering=0)

    def __enter__(self) -> _PatchFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, frame: bytes) -> None:
        left = memoryview(frame)
        while left:  # a disk that is nearly full takes a part, and then raises
            left = left[self._file.write(left) :]


class _Preview:
    """Keep the positions of a few points, evenly spread over the rows, and tell them after every pass."""

    def __init__(self, points: int, tell: OnPreview | None) -> None:
        self._rows = np.unique(np.linspace(0, points - 1, min(points, PREVIEW_POINTS)).astype(np.int64))
        self._where = np.full(points if tell else 0, -1, dtype=np.int32)
        if tell:
            self._where[self._rows] = np.arange(len(self._rows))
        self._xyz = np.full((len(self._rows), 3), np.nan)
        self._iteration, self._tell = 0, tell

    def add(self, iteration: int, indices: npt.NDArray[np.int64], xyz: npt.NDArray[np.float64]) -> None:
        if self._tell is None:
            return
        if iteration != self._iteration:
            self.end()
            self._iteration = iteration
        place = self._where[indices]
        self._xyz[place[place >= 0]] = xyz[place >= 0]

    def end(self) -> None:
        """Tell what the pass has come to."""
        if self._tell is not None and self._iteration > 0:
            known = np.isfinite(self._xyz).all(axis=1)
            self._tell(self._iteration, self._rows[known].tolist(), self._xyz[known].tolist())


def _check_normals(cloud: PointCloud, target: Format) -> None:
    if not target.writes_normals:
        able = ", ".join(format.name for format in FORMATS if format.writes_normals)
        raise UnsupportedCloud(f"normals=recompute is for {able}; the result would be {target.name}")
    if not cloud.normal_names:
        known = ", or ".join(" ".join(names) for names in NORMALS)
        raise UnsupportedCloud(f"normals=recompute wants a file with normals ({known})")


def _left_behind(cloud: PointCloud, source: Format, target: Format) -> list[str]:
    lost = [] if source is target else target.left_behind(cloud)
    if not lost:
        return []
    some = ", ".join(name[:80] for name in lost[:_NAMED]) + (f" and {len(lost) - _NAMED} more" if lost[_NAMED:] else "")
    return [f"{target.name} has no place for what else the {source.name} file holds: {some}"]


def _displacement(before: npt.NDArray[np.float64], after: npt.NDArray[np.float64]) -> dict[str, float]:
    with np.errstate(invalid="ignore"):
        x, y, z = (after - before).T
        moved = np.hypot(np.hypot(x, y), z)  # squares of huge coordinates overflow
    moved = moved[np.isfinite(before).all(axis=1)]
    if not np.isfinite(moved).all():
        largest = np.abs(before[np.isfinite(before)]).max()
        raise UnsupportedCloud(
            f"coordinates of up to {largest:.3g} lead out of the range of float64 when they are moved"
        )
    p50, p90, p99, most = (float(value) for value in np.percentile(moved, [50, 90, 99, 100]))
    return {"p50": p50, "p90": p90, "p99": p99, "max": most, "mean": float((moved / len(moved)).sum())}


def _settle(path: Path) -> tuple[int, str]:
    """Return the size and sha256 of a file that is on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        return path.stat().st_size, hashlib.file_digest(file, "sha256").hexdigest()
