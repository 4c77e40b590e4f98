"""A whole server in its test's own process, over real sockets: the test chooses the moment of what happens."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import uvicorn

from straightpcf.service.app import create_app
from straightpcf.service.connection import connection_class
from straightpcf.service.engine import Engine
from straightpcf.service.settings import Settings
from tests.service.fakes import ObedientBackend


@asynccontextmanager
async def serving(folder: Path, backend: ObedientBackend, **settings: Any) -> AsyncIterator[tuple[Engine, str, int]]:
    """Serve until the block ends; yield the engine, the host and the port."""
    chosen = Settings(data_dir=folder, **{"shutdown_seconds": 1} | settings)
    app = create_app(chosen, backend=backend)
    http = connection_class(chosen)
    config = uvicorn.Config(
        app, port=0, root_path=chosen.root_path, log_config=None, http=http, ws="none", timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(config)
    task = asyncio.create_task(server.serve())
    while not server.started:
        assert not task.done(), task.exception()
        await asyncio.sleep(0.01)
    host, port = server.servers[0].sockets[0].getsockname()
    try:
        yield app.state.engine, host, port
    finally:
        server.should_exit = True
        await task


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])
