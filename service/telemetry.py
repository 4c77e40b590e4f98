"""Metrics in the Prometheus text format, on a registry of the app's own."""

from __future__ import annotations

import time
from collections.abc import Iterable

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.registry import Collector
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from straightpcf.service.engine import Engine, Usage
from straightpcf.service.jobs.record import STATES

__all__ = ["MetricsMiddleware", "Telemetry"]

_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class Telemetry:
    """Count requests, and read the engine when someone asks."""

    def __init__(self, engine: Engine) -> None:
        self.registry = CollectorRegistry()
        labels = ("method", "route", "status")
        self.requests = Counter("straightpcf_http_requests", "Requests answered.", labels, registry=self.registry)
        self.seconds = Histogram(
            "straightpcf_http_request_seconds", "From request to the end of the answer.", ("method", "route"),
            buckets=(0.005, 0.02, 0.1, 0.5, 1, 2, 5, 10, 30, 60, 300), registry=self.registry,
        )  # fmt: skip
        self.grpc_requests = Counter(
            "straightpcf_grpc_requests", "Calls answered.", ("method", "status"), registry=self.registry
        )
        self._engine = _EngineCollector(engine)
        self.registry.register(self._engine)

    async def endpoint(self, request: Request) -> Response:
        """Answer GET /metrics."""
        await self._engine.look()
        return Response(generate_latest(self.registry), media_type=CONTENT_TYPE_LATEST)


class _EngineCollector(Collector):
    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._usage = Usage(counts={}, points=0, bytes=0)

    async def look(self) -> None:
        """Ask what `collect`, which may not wait, then tells."""
        self._usage = await self._engine.usage()

    def collect(self) -> Iterable[Metric]:
        engine, usage = self._engine, self._usage
        jobs = GaugeMetricFamily("straightpcf_jobs", "Jobs in the store by state.", labels=["state"])
        for state in STATES:
            jobs.add_metric([state], usage.counts.get(state, 0))
        yield jobs
        for name, text, value in (
            ("queue_points", "Points that wait or run, as estimated when they came.", usage.points),
            ("spool_bytes", "Bytes of inputs, results and patches on the disk.", usage.bytes),
            ("ready", "1 while a worker is warm and nothing drains.", int(engine.ready)),
            ("workers", "Workers that are warm.", len(engine.backend.devices)),
            ("worker_restarts", "Workers that died and were replaced.", engine.backend.restarts),
        ):
            yield GaugeMetricFamily(f"straightpcf_{name}", text, value=value)


class MetricsMiddleware:
    """Measure every request; routes, not paths, and known methods, so that there are few labels."""

    def __init__(self, app: ASGIApp, *, telemetry: Telemetry) -> None:
        self._app, self._telemetry = app, telemetry

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began, status = time.monotonic(), 500

        async def send_and_see(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, send_and_see)
        finally:
            route = getattr(scope.get("route"), "path", "none")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self._telemetry.requests.labels(method, route, status).inc()
            self._telemetry.seconds.labels(method, route).observe(time.monotonic() - began)
