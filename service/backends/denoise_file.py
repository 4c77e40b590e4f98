"""Denoise one file into another: the straight line that the worker and the command line share."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from straightpcf.points.formats import format_named, read_cloud, write_cloud
from straightpcf.service.backends.base import FileJob, FileReport

if TYPE_CHECKING:
    from straightpcf.model.filter import Filter

__all__ = ["denoise_file"]


def denoise_file(denoiser: Filter, job: FileJob, *, on_progress: Callable[[float], None] | None = None) -> FileReport:
    """Read, denoise and write; raises StraightPCFError, and whatever on_progress raises to stop the work."""
    cloud, source_format = read_cloud(job.source, name=job.name, max_points=job.max_points)
    target_format = source_format if job.format is None else format_named(job.format)
    if on_progress is not None:
        on_progress(0.0)
    result = denoiser.denoise(cloud.xyz, job.options, on_progress=on_progress)
    write_cloud(cloud.with_xyz(result.xyz), job.target, target_format)
    return FileReport(
        format=target_format.name,
        points=len(cloud),
        untouched=result.untouched,
        iterations=result.iterations,
        noise_before=result.noise_before,
        noise_after=result.noise_after,
        seconds=result.seconds,
        warnings=result.warnings,
    )
