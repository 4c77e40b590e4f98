"""Talk to a running server: `Client(url).denoise("in.ply", "out.ply")`; needs no torch."""

from straightpcf.clients.sdk.aio import AsyncClient, AsyncJob
from straightpcf.clients.sdk.client import Client, Job
from straightpcf.clients.sdk.events import Completed, Event, Log, Output, Preview, Progress, Queued, Started
from straightpcf.clients.sdk.job_info import JobInfo, Report, ResultInfo
from straightpcf.clients.sdk.response import Health, ServerInfo
from straightpcf.clients.sdk.result import Denoised

__all__ = [
    "AsyncClient",
    "AsyncJob",
    "Client",
    "Completed",
    "Denoised",
    "Event",
    "Health",
    "Job",
    "JobInfo",
    "Log",
    "Output",
    "Preview",
    "Progress",
    "Queued",
    "Report",
    "ResultInfo",
    "ServerInfo",
    "Started",
]
