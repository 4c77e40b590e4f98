"""The composition root: settings in, a running server out."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import os
import resource
import signal
import socket
import sys
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from types import FrameType
from typing import TYPE_CHECKING

import uvicorn
from fastapi import Depends, FastAPI
from fastapi_offline import FastAPIOffline
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

import straightpcf
from straightpcf.points.errors import InvalidOptions, MissingDependency
from straightpcf.service.admission import Limits
from straightpcf.service.api.auth import Gate, owner_of
from straightpcf.service.api.cors import CorsMiddleware
from straightpcf.service.api.errors import install_error_handlers
from straightpcf.service.api.hosts import HostMiddleware, is_loopback
from straightpcf.service.api.intake import Coming
from straightpcf.service.api.jobs import router as jobs_router
from straightpcf.service.api.openapi import complete_document
from straightpcf.service.api.request_id import RequestIdMiddleware
from straightpcf.service.api.rest import router
from straightpcf.service.api.target import TargetMiddleware
from straightpcf.service.backends.base import Backend
from straightpcf.service.backends.local import LocalBackend
from straightpcf.service.backends.worker import WorkerSpec
from straightpcf.service.connection import connection_class, tell_briefly
from straightpcf.service.engine import Engine
from straightpcf.service.jobs.database import check_database
from straightpcf.service.jobs.folders import JobFolders
from straightpcf.service.jobs.full_disk import DISK_TROUBLES, full_disk_as_spool_full
from straightpcf.service.settings import Settings
from straightpcf.service.telemetry import MetricsMiddleware, Telemetry
from straightpcf.service.web import install_page

if TYPE_CHECKING:
    from straightpcf.service.api.grpc import GrpcServer

__all__ = ["create_app", "serve"]

# What no server can do without: its own files, a worker's pipes, some connections; and the database's -wal, which
# SQLite lets grow to 4 MiB and more. With less it would be ready, and every job would fail, or none ever end.
_LEAST = (
    (resource.RLIMIT_NOFILE, 64, "may have {} files open (ulimit -n, LimitNOFILE)"),
    (resource.RLIMIT_FSIZE, 2**24, "may make a file of {} bytes at most (ulimit -f, LimitFSIZE)"),
)

logger = logging.getLogger("uvicorn.error")


def create_app(settings: Settings, *, backend: Backend | None = None) -> FastAPI:
    """Wire one server together; nothing starts before the app's lifespan does."""
    engine = Engine(backend or _local_backend(settings), limits=_limits(settings), data_dir=settings.data_dir)
    telemetry = Telemetry(engine)
    gate = Gate(settings.keys(), rate_per_minute=settings.rate_per_minute)
    coming = Coming(engine)
    grpc = _grpc_server(settings, engine, coming, gate, telemetry)

    app = FastAPIOffline(  # /docs has its scripts here: many servers have no way out
        redoc_url=None,  # would ask its maker's server for a picture
        favicon_url="static/icon.svg",  # beside /docs, wherever a proxy has that
        title="StraightPCF",
        version=straightpcf.__version__,
        summary="Hand it a noisy point cloud, get the same points back on the surface.",
        lifespan=lambda _: _running(engine, grpc),
    )
    for route in app.routes:  # of the document and of /docs
        if isinstance(route, Route) and route.methods:
            route.methods.add("HEAD")  # as everywhere
    app.state.engine = engine
    app.state.coming = coming
    app.state.gate = gate
    app.state.weights = _weights_name(settings)
    install_error_handlers(app)
    origins, hosts = settings.origins(), settings.hosts()
    if gate.open and is_loopback(settings.host):
        app.add_middleware(HostMiddleware, hosts=hosts, origins=origins)
    app.add_middleware(MetricsMiddleware, telemetry=telemetry)
    app.add_middleware(RequestIdMiddleware)
    if origins:
        app.add_middleware(CorsMiddleware, origins=origins)
    app.add_middleware(TargetMiddleware)
    app.include_router(router)
    app.include_router(jobs_router)
    install_page(app)
    complete_document(app)
    app.add_api_route(
        "/metrics", telemetry.endpoint, include_in_schema=False, dependencies=[Depends(owner_of)], methods=["GET"]
    )
    return app


@asynccontextmanager
async def _running(engine: Engine, grpc: GrpcServer | None) -> AsyncIterator[None]:
    tell_briefly(asyncio.get_running_loop())
    await engine.start()
    try:
        if grpc is not None:
            await grpc.start()
        yield
    finally:
        if grpc is not None:
            engine.drain()
            await grpc.stop(patience_seconds=engine.patience_seconds)
        await engine.stop()


def serve(settings: Settings) -> None:
    """Serve until SIGINT, SIGTERM or SIGHUP, then let running requests finish.

    Raises what keeps every worker from starting.
    """
    backend = _local_backend(settings)
    app = create_app(settings, backend=backend)
    for name in ("stdout", "stderr"):  # which whoever starts it may have closed: uvicorn's log wants both
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
    config = uvicorn.Config(
        _quiet_when_cut_off(app),
        host=settings.host,
        port=settings.port,
        root_path=settings.root_path,
        timeout_graceful_shutdown=settings.shutdown_seconds,
        workers=1,  # said, so that uvicorn does not read WEB_CONCURRENCY, which may be no number
        lifespan="on",
        http=connection_class(settings),
        ws="none",
    )
    server = _Server(config, app.state.engine)

    def end() -> None:
        server.should_exit = True

    backend.on_failure = end
    if app.state.gate.open and not is_loopback(settings.host):
        logger.warning(
            "NO API KEYS ARE SET and this server listens on %s: everyone who reaches it may use it and see every job. "
            "Set STRAIGHTPCF_API_KEYS or STRAIGHTPCF_API_KEYS_FILE.",
            settings.host,
        )
    _check_start(settings)
    signal.signal(signal.SIGTERM, _end_well)  # uvicorn raises it anew when all is over
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # of a terminal that is closed; nohup
        signal.signal(signal.SIGHUP, lambda number, frame: signal.raise_signal(signal.SIGTERM))
    server.run()
    if backend.failure is not None:
        raise backend.failure


class _Server(uvicorn.Server):
    """Tell the engine of a signal at once: /readyz says "draining" while requests finish."""

    def __init__(self, config: uvicorn.Config, engine: Engine) -> None:
        super().__init__(config)
        self._engine = engine

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to shut down; at a second Ctrl-C wait for nothing more."""
        self._engine.drain()
        super().handle_exit(sig, frame)
        if self.force_exit:
            self._engine.hurry()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Shut the app down in a hurry, too: uvicorn leaves out its end then, and with it that of the workers."""
        await super().shutdown(sockets)
        if self.force_exit and not self.lifespan.shutdown_event.is_set():
            await self.lifespan.shutdown()


def _end_well(number: int, frame: FrameType | None) -> None:
    sys.exit(0)


def _quiet_when_cut_off(app: ASGIApp) -> ASGIApp:
    """Show no traceback of a request that is cut off when the server ends; uvicorn says in a line how many they are."""

    async def quiet(scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await app(scope, receive, send)
        except asyncio.CancelledError:
            if scope["type"] != "http":
                raise

    return quiet


def _grpc_server(
    settings: Settings, engine: Engine, coming: Coming, gate: Gate, telemetry: Telemetry
) -> GrpcServer | None:
    if settings.grpc_port is None:
        return None
    try:
        from straightpcf.service.api.grpc import GrpcServer
    except ImportError as exc:
        raise MissingDependency(f"gRPC needs an extra: pip install 'straightpcf[grpc]' ({exc})") from exc
    return GrpcServer(
        engine,
        coming=coming,
        gate=gate,
        telemetry=telemetry,
        weights=_weights_name(settings),
        host=settings.host,
        port=settings.grpc_port,
    )


def _weights_name(settings: Settings) -> str:
    return settings.weights.name if settings.weights else "shipped"


def _check_start(settings: Settings) -> None:
    """Raise InvalidOptions for what would otherwise end the server in the middle of its start, or keep it from work."""
    for kind, least, told in _LEAST:
        most, _ = resource.getrlimit(kind)
        if most != resource.RLIM_INFINITY and most < least:
            raise InvalidOptions(f"this process {told.format(most)}; a server needs {least}")
    try:
        with full_disk_as_spool_full():
            JobFolders(settings.data_dir).close()
            with tempfile.TemporaryFile(dir=settings.data_dir):
                pass
            check_database(settings.data_dir / "jobs.sqlite3")
    except DISK_TROUBLES as exc:
        raise InvalidOptions(f"data_dir is {settings.data_dir}, which cannot hold jobs: {exc}") from exc
    if settings.weights is not None and not settings.weights.is_file():
        raise InvalidOptions(f"weights is {settings.weights}, which is no file")
    try:
        family = socket.getaddrinfo(settings.host or "0.0.0.0", 0, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((settings.host, 0), family=family).close()
    except (OSError, UnicodeError) as exc:
        raise InvalidOptions(f"host is {settings.host[:80]!r}, where this machine cannot listen: {exc}") from exc
    for name in ("port", "grpc_port"):
        if port := getattr(settings, name):
            try:
                socket.create_server((settings.host, port), family=family).close()
            except OSError as exc:
                raise InvalidOptions(f"{name} is {port}, which cannot be had: {exc}") from exc


def _limits(settings: Settings) -> Limits:
    return Limits(**{limit.name: getattr(settings, limit.name) for limit in dataclasses.fields(Limits)})


def _local_backend(settings: Settings) -> LocalBackend:
    return LocalBackend(
        [
            WorkerSpec(
                device=device.strip(),
                weights=settings.weights,
                threads=settings.threads,
                tile_points=settings.tile_points,
            )
            for device in settings.device.split(",")
        ]
    )
