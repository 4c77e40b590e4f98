"""A proxy that has a server under a path of its own, as nginx or Traefik do: it takes the path off."""

from __future__ import annotations

import socket
import socketserver
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

__all__ = ["behind_proxy"]


@contextmanager
def behind_proxy(url: str, path: str) -> Iterator[str]:
    """Pass on what is asked for below a path; yield the address of that path, without a slash at its end."""
    upstream = urlsplit(url)
    assert upstream.hostname
    address, prefix = (upstream.hostname, upstream.port), path.encode()

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            method, target, version = self.rfile.readline().split()
            if not target.startswith(prefix + b"/"):
                self.wfile.write(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
                return
            with socket.create_connection(address) as server:
                # One request a connection, so that there is one line to rewrite.
                server.sendall(b"%b %b %b\r\nConnection: close\r\n" % (method, target.removeprefix(prefix), version))
                while (line := self.rfile.readline()) not in (b"\r\n", b""):
                    if not line.lower().startswith(b"connection:"):
                        server.sendall(line)
                server.sendall(line)
                threading.Thread(target=_pump, args=(self.rfile.read1, server.sendall), daemon=True).start()
                _pump(server.recv, self.connection.sendall)

    class Proxy(socketserver.ThreadingTCPServer):
        daemon_threads = True

    with Proxy(("127.0.0.1", 0), Handler) as proxy:
        threading.Thread(target=proxy.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{proxy.server_address[1]}{path}"
        finally:
            proxy.shutdown()


def _pump(read: Callable[[int], bytes], write: Callable[[bytes], object]) -> None:
    try:
        while data := read(65536):
            write(data)
    except (OSError, ValueError):  # either end has gone
        return
