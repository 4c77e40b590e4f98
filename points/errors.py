"""Every error of the project, one tree, the same in process and over the wire.

StraightPCFError
├── InvalidRequest          the request itself is wrong
│   ├── InvalidOptions      an option has a value outside its range
│   ├── UnknownFormat       no format recognises the file
│   ├── MissingDependency   the format or device needs an extra that is not installed
│   └── InvalidCloud        the file or array is no usable cloud
│       ├── MalformedFile   a file breaks its own format
│       ├── TooFewPoints    fewer usable points than the smallest patch
│       └── UnsupportedCloud  well-formed, but outside what we keep losslessly
├── TooLarge                a limit was passed
│   ├── TooManyPoints
│   └── TooManyBytes
├── Unauthorized            no key, or an unknown one
├── NotFound                no such thing, or not yours
├── MethodNotAllowed
├── MisdirectedRequest      for a host that this server is not
├── CrossOrigin             from a page of another site
├── RequestTimeout          its body stopped coming
├── JobNotFinished          its result is not there yet
├── JobExpired              its result is not there any more
├── JobCanceled
├── IdConflict              the id belongs to another request
├── IdempotencyConflict     the key belongs to another request
├── PreconditionFailed      the result is not the one that was meant
├── RangeNotSatisfiable
├── DeviceUnavailable       the requested device is not here
├── ServerBusy              try again later
│   ├── RateLimited         this key's requests per minute
│   ├── QuotaExceeded       this key's jobs
│   └── SpoolFull           the disk
└── InternalError           our fault
    └── ConnectionFailed    the server did not answer (raised by the SDK)

`code` is stable: the wire carries it, and the SDK raises the class that has it.
"""

from __future__ import annotations

from typing import ClassVar

__all__ = [
    "ERRORS_BY_CODE",
    "ConnectionFailed",
    "CrossOrigin",
    "DeviceUnavailable",
    "IdConflict",
    "IdempotencyConflict",
    "InternalError",
    "InvalidCloud",
    "InvalidOptions",
    "InvalidRequest",
    "JobCanceled",
    "JobExpired",
    "JobNotFinished",
    "MalformedFile",
    "MethodNotAllowed",
    "MisdirectedRequest",
    "MissingDependency",
    "NotFound",
    "PreconditionFailed",
    "QuotaExceeded",
    "RangeNotSatisfiable",
    "RateLimited",
    "RequestTimeout",
    "ServerBusy",
    "SpoolFull",
    "StraightPCFError",
    "TooFewPoints",
    "TooLarge",
    "TooManyBytes",
    "TooManyPoints",
    "Unauthorized",
    "UnknownFormat",
    "UnsupportedCloud",
]


class StraightPCFError(Exception):
    """Say what is wrong, where, and the limit; `code` names the kind and `retryable` whether to try again."""

    code: ClassVar[str] = "error"
    retryable: ClassVar[bool] = False

    def __init__(self, message: str, *, request_id: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.request_id = request_id
        self.retry_after: int | None = None  # seconds, where it is known what will have changed by then


class InvalidRequest(StraightPCFError):  # noqa: N818 - named for what is wrong, as the wire codes are
    """Report a request that can never succeed as it stands."""

    code = "invalid_request"


class InvalidOptions(InvalidRequest):
    """Report an option outside its range."""

    code = "invalid_options"


class UnknownFormat(InvalidRequest):
    """Report bytes or a name that no format recognises."""

    code = "unknown_format"


class MissingDependency(InvalidRequest):
    """Report an extra that is not installed."""

    code = "missing_dependency"

    @classmethod
    def of(cls, extra: str, exc: ImportError) -> MissingDependency:
        """Name the extra that brings what an import missed, or could not load: a library that it wants is not here."""
        if isinstance(exc, ModuleNotFoundError):
            return cls(f"{exc.name} is not installed; pip install 'straightpcf[{extra}]' brings it")
        return cls(f"what straightpcf[{extra}] brings cannot be loaded: {exc}")


class InvalidCloud(InvalidRequest):
    """Report a file or an array that is no usable cloud."""

    code = "invalid_cloud"


class MalformedFile(InvalidCloud):
    """Report a file that breaks its own format, naming the place."""

    code = "malformed_file"


class TooFewPoints(InvalidCloud):
    """Report a cloud with fewer usable points than the smallest patch."""

    code = "too_few_points"


class UnsupportedCloud(InvalidCloud):
    """Report a well-formed file with something we could not give back losslessly."""

    code = "unsupported_cloud"


class TooLarge(StraightPCFError):  # noqa: N818
    """Report a limit that was passed."""

    code = "too_large"


class TooManyPoints(TooLarge):
    """Report more points than this server or format reader takes."""

    code = "too_many_points"


class TooManyBytes(TooLarge):
    """Report more bytes than this server takes."""

    code = "too_many_bytes"


class DeviceUnavailable(StraightPCFError):  # noqa: N818
    """Report a device that was asked for and is not here."""

    code = "device_unavailable"


class ServerBusy(StraightPCFError):  # noqa: N818
    """Report a full queue; try again later."""

    code = "server_busy"
    retryable = True


class RateLimited(ServerBusy):
    """Report more requests than a key may send in a minute."""

    code = "rate_limited"


class QuotaExceeded(ServerBusy):
    """Report more jobs than a key may hold at once."""

    code = "quota_exceeded"


class SpoolFull(ServerBusy):
    """Report a disk with no room for another job."""

    code = "spool_full"


class Unauthorized(StraightPCFError):  # noqa: N818
    """Report a missing or unknown API key."""

    code = "unauthorized"


class NotFound(StraightPCFError):  # noqa: N818
    """Report something that is not here, or belongs to another key."""

    code = "not_found"


class MethodNotAllowed(StraightPCFError):  # noqa: N818
    """Report a method that the path does not have."""

    code = "method_not_allowed"


class MisdirectedRequest(StraightPCFError):  # noqa: N818
    """Report a request for a host that this server does not answer for."""

    code = "misdirected_request"


class CrossOrigin(StraightPCFError):  # noqa: N818
    """Report what a page of another origin would have a server without keys do."""

    code = "cross_origin"


class RequestTimeout(StraightPCFError):  # noqa: N818
    """Report a body that stopped coming in before its end."""

    code = "request_timeout"
    retryable = True


class JobNotFinished(StraightPCFError):  # noqa: N818
    """Report a job whose result is asked for too early."""

    code = "job_not_finished"


class JobExpired(StraightPCFError):  # noqa: N818
    """Report a job whose files have been removed."""

    code = "job_expired"


class JobCanceled(StraightPCFError):  # noqa: N818
    """Report work that was canceled."""

    code = "job_canceled"


class IdConflict(StraightPCFError):  # noqa: N818
    """Report a job id that another request has taken."""

    code = "id_conflict"


class IdempotencyConflict(StraightPCFError):  # noqa: N818
    """Report an idempotency key that came with another request before."""

    code = "idempotency_conflict"


class PreconditionFailed(StraightPCFError):  # noqa: N818
    """Report that If-Match names another result than there is."""

    code = "precondition_failed"


class RangeNotSatisfiable(StraightPCFError):  # noqa: N818
    """Report a byte range outside the file."""

    code = "range_not_satisfiable"


class InternalError(StraightPCFError):
    """Report a fault of ours."""

    code = "internal_error"


class ConnectionFailed(InternalError):  # noqa: N818
    """Report a server that did not answer, or broke off."""

    code = "connection_failed"
    retryable = True


def _tree(cls: type[StraightPCFError]) -> dict[str, type[StraightPCFError]]:
    codes = {cls.code: cls}
    for child in cls.__subclasses__():
        codes |= _tree(child)
    return codes


ERRORS_BY_CODE = _tree(StraightPCFError)
