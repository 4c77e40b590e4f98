"""Who asks: API keys as bearer tokens (RFC 6750), and how often each may."""

from __future__ import annotations

import hashlib
import hmac
import math
import time
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPBearer

from straightpcf.points.errors import RateLimited, Unauthorized

__all__ = ["Gate", "owner_of", "owner_who_gives_back"]

_SECONDS = 60.0
# Says so in the OpenAPI document; it is the gate that checks.
_BEARER = HTTPBearer(
    scheme_name="key", description="An API key of this server; one without keys asks for none.", auto_error=False
)


class Gate:
    """Check keys and count requests; knows keys only by their sha256."""

    def __init__(self, keys: tuple[str, ...], *, rate_per_minute: int = 0) -> None:
        self._digests = [hashlib.sha256(key.encode()).digest() for key in keys]
        self._rate = rate_per_minute
        self._buckets: dict[str, tuple[float, float]] = {}  # owner -> requests left, at what time

    @property
    def open(self) -> bool:
        """Tell whether everyone may come in."""
        return not self._digests

    def admit(self, authorization: str | None, *, gives_back: bool = False) -> str:
        """Return the owner that a request's Authorization header stands for; raises Unauthorized, RateLimited.

        gives_back: it ends or deletes a job, which is counted, but never refused: the job would run on for nobody.
        """
        owner = "" if self.open else self._owner(authorization)
        if self._rate > 0:
            self._count(owner, gives_back)
        return owner

    def _owner(self, authorization: str | None) -> str:
        scheme, _, key = (authorization or "").partition(" ")
        if scheme.lower() != "bearer" or not key.strip():
            raise Unauthorized("this server wants an API key: Authorization: Bearer KEY")
        digest = hashlib.sha256(key.strip().encode()).digest()
        # Every key is compared, so that the time tells nothing about which one was near.
        if not any([hmac.compare_digest(digest, known) for known in self._digests]):
            raise Unauthorized("this server does not know that API key")
        return digest.hex()[:16]

    def _count(self, owner: str, gives_back: bool) -> None:
        """Take one request from the owner's bucket, which fills at the rate and holds a minute's worth."""
        now = time.monotonic()
        left, at = self._buckets.get(owner, (float(self._rate), now))
        left = min(float(self._rate), left + (now - at) * self._rate / _SECONDS)
        granted = left >= 1
        # What is refused takes nothing: whoever asks again too soon would never get in.
        self._buckets[owner] = (left - 1 if granted else left, now)
        if not granted and not gives_back:
            error = RateLimited(f"this key may send {self._rate} requests a minute")
            error.retry_after = math.ceil((1 - left) * _SECONDS / self._rate)
            raise error


def owner_of(request: Request, _: Annotated[object, Depends(_BEARER)]) -> str:
    """Return who asks, as a FastAPI dependency."""
    gate: Gate = request.app.state.gate
    return gate.admit(request.headers.get("authorization"))


def owner_who_gives_back(request: Request, _: Annotated[object, Depends(_BEARER)]) -> str:
    """Return who asks for the end of a job, however often."""
    gate: Gate = request.app.state.gate
    return gate.admit(request.headers.get("authorization"), gives_back=True)
