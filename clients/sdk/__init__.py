"""Talk to a running server: `Client(url).denoise("in.ply", "out.ply")`; needs no torch."""

from straightpcf.clients.sdk.client import AsyncClient, Client
from straightpcf.clients.sdk.response import Health, ServerInfo
from straightpcf.clients.sdk.result import Denoised

__all__ = ["AsyncClient", "Client", "Denoised", "Health", "ServerInfo"]
