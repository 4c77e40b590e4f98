"""The composition root: settings in, a running server out."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import uvicorn
from fastapi import FastAPI

import straightpcf
from straightpcf.service.api.errors import install_error_handlers
from straightpcf.service.api.request_id import RequestIdMiddleware
from straightpcf.service.api.rest import router
from straightpcf.service.backends.base import Backend
from straightpcf.service.backends.local import LocalBackend
from straightpcf.service.backends.worker import WorkerSpec
from straightpcf.service.engine import Engine, Limits
from straightpcf.service.settings import Settings
from straightpcf.service.spool import Spool

__all__ = ["create_app", "serve"]


def create_app(settings: Settings, *, backend: Backend | None = None) -> FastAPI:
    """Wire one server together; nothing starts before the app's lifespan does."""
    limits = Limits(
        max_bytes=settings.max_bytes,
        max_points=settings.max_points,
        max_jobs=settings.max_jobs,
        max_wait_seconds=settings.max_wait_seconds,
    )
    engine = Engine(backend or _local_backend(settings), limits=limits)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        with Spool(settings.data_dir) as app.state.spool:
            await engine.start()
            try:
                yield
            finally:
                await engine.stop()

    app = FastAPI(
        title="StraightPCF",
        version=straightpcf.__version__,
        summary="Hand it a noisy point cloud, get the same points back on the surface.",
        lifespan=lifespan,
    )
    app.state.engine = engine
    app.state.weights = settings.weights.name if settings.weights else "shipped"
    app.add_middleware(RequestIdMiddleware)
    install_error_handlers(app)
    app.include_router(router)
    return app


def serve(settings: Settings) -> None:
    """Serve until SIGINT or SIGTERM, then let running requests finish; raises what keeps every worker from starting."""
    backend = _local_backend(settings)
    config = uvicorn.Config(
        create_app(settings, backend=backend),
        host=settings.host,
        port=settings.port,
        timeout_graceful_shutdown=settings.shutdown_seconds,
        lifespan="on",
        ws="none",
    )
    server = uvicorn.Server(config)

    def end() -> None:
        server.should_exit = True

    backend.on_failure = end
    server.run()
    if backend.failure is not None:
        raise backend.failure


def _local_backend(settings: Settings) -> LocalBackend:
    return LocalBackend([WorkerSpec(device=settings.device, weights=settings.weights, threads=settings.threads)])
