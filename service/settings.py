"""Read what an operator may set: the only place of the server that looks at the environment."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from straightpcf.points.errors import InvalidOptions
from straightpcf.points.options import DECIMAL, MIN_TILE_POINTS, check_threads

__all__ = ["ENVIRONMENT_PREFIX", "Settings"]

ENVIRONMENT_PREFIX = "STRAIGHTPCF_"
# What the CLI's other commands, the kernels and install.sh read.
_OF_OTHERS = frozenset({f"{ENVIRONMENT_PREFIX}{name}" for name in ("URL", "KEY", "NO_KERNELS", "TORCH")})
# What Kubernetes tells every pod of a Service whose name begins with straightpcf; PORT is a setting if it is a number.
_SERVICE_LINK = re.compile(r"\w*_(SERVICE_(HOST|PORT\w*)|PORT_\d+_(TCP|UDP|SCTP)(_(PROTO|PORT|ADDR))?)")
_SERVICE_URL = re.compile(r"(tcp|udp|sctp)://.+:\d+")
_ROOT_PATH = re.compile(r"(/[\w.~-]+)*", re.ASCII)
_ORIGIN = re.compile(r"[a-z][a-z0-9+.-]*://([a-z0-9._-]+|\[[0-9a-f:.]+\])(:[0-9]+)?", re.ASCII)  # as browsers send it
_HOST = re.compile(r"[a-z0-9._-]*[a-z0-9_-]|([0-9a-f.]*:){2}[0-9a-f:.]*", re.ASCII)  # no dot at its end; IPv6
_POSITIVE = (
    "max_bytes", "max_points", "max_jobs", "max_queued_points", "max_jobs_per_key", "max_spool_bytes",
    "max_sync_seconds", "upload_idle_seconds", "download_idle_seconds", "result_ttl_seconds",
    "shutdown_seconds",
)  # fmt: skip
_SECONDS = (
    "max_sync_seconds", "upload_idle_seconds", "download_idle_seconds", "result_ttl_seconds", "row_ttl_seconds",
    "shutdown_seconds",
)  # fmt: skip
_MAX_SECONDS = 1e9  # three decades; infinitely far ahead there is no date
_MAX_WHOLE = 2**63 - 1  # what SQLite and gRPC hold


def _default_data_dir() -> Path:
    return _at_home("data_dir", Path("~/.local/share/straightpcf"))


def _at_home(setting: str, path: Path) -> Path:
    """Read ~ as a shell does, which does not in a service's file, nor behind an equals sign."""
    try:
        return path.expanduser()
    except RuntimeError as exc:  # a container's user that nobody has listed
        raise InvalidOptions(
            f"{setting} is {path}, and that home is not known (HOME is not set?): give a path"
        ) from exc


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Configure one server; each field is STRAIGHTPCF_<NAME> in the environment.

    grpc_port: None for no gRPC. 0, here and for port: any free one.
    max_bytes: of one request body.  max_points: of one cloud.
    max_jobs, max_queued_points: waiting and running at once, over all keys; more are answered "busy".
    max_jobs_per_key: waiting and running for one key.  rate_per_minute: requests of one key, 0 for any number.
    max_spool_bytes: inputs, results and patches on the disk, or to come.  min_free_bytes: what it must then have left.
    max_sync_seconds: how long POST /denoise waits before it answers 202.
    upload_idle_seconds: how long a body that has not come to its end may bring nothing.
    download_idle_seconds: how long a peer may take nothing of its answer over HTTP.
    result_ttl_seconds: how long a finished job's files are kept.  row_ttl_seconds: and then what is known of it.
    api_keys: comma-separated, or api_keys_file: one a line; without any, everyone may do everything.
    root_path: where a proxy, which takes it off, has the server: "/straightpcf" for https://host/straightpcf/.
    allowed_hosts: comma-separated names by which a server without keys on loopback may be asked beside loopback's own.
    cors_origins: comma-separated origins whose pages may call the server; none by default.
    device: "auto" | "cpu" | "cuda" | "cuda:N"; several, with commas between, have a worker each.
    weights: None for the shipped ones.  threads: None for one for each CPU it may use.
    tile_points: of a cloud, cut into patches at once; None for the filter's own default.
    shutdown_seconds: how long running requests may finish after SIGTERM.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    grpc_port: int | None = None
    data_dir: Path = field(default_factory=_default_data_dir)
    max_bytes: int = 512 * 2**20
    max_points: int = 5_000_000
    max_jobs: int = 1000
    max_queued_points: int = 200_000_000
    max_jobs_per_key: int = 1000
    rate_per_minute: int = 0
    max_spool_bytes: int = 50 * 2**30
    min_free_bytes: int = 256 * 2**20
    max_sync_seconds: float = 300.0
    upload_idle_seconds: float = 60.0
    download_idle_seconds: float = 600.0
    result_ttl_seconds: float = 3600.0
    row_ttl_seconds: float = 86400.0
    api_keys: str = ""
    api_keys_file: Path | None = None
    root_path: str = ""
    allowed_hosts: str = ""
    cors_origins: str = ""
    device: str = "auto"
    weights: Path | None = None
    threads: int | None = None
    tile_points: int | None = None
    shutdown_seconds: int = 30

    def __post_init__(self) -> None:
        """Refuse limits that would admit nothing."""
        for name in ("data_dir", "api_keys_file", "weights"):
            if (path := getattr(self, name)) is not None:
                object.__setattr__(self, name, _at_home(name, path))
        for name in _POSITIVE:
            if getattr(self, name) <= 0:
                raise InvalidOptions(f"{name} is {getattr(self, name)}; it must be above 0")
        check_threads(self.threads)
        if self.tile_points is not None and self.tile_points < MIN_TILE_POINTS:
            raise InvalidOptions(f"tile_points is {self.tile_points}; it must be at least {MIN_TILE_POINTS}")
        for name in ("rate_per_minute", "min_free_bytes", "row_ttl_seconds"):
            if getattr(self, name) < 0:
                raise InvalidOptions(f"{name} is {getattr(self, name)}; it must not be negative")
        for name in _SECONDS:
            if not getattr(self, name) <= _MAX_SECONDS:  # NaN is not, either
                raise InvalidOptions(f"{name} is {getattr(self, name)}; it must be at most {_MAX_SECONDS:.0f}")
        for name in (spec.name for spec in dataclasses.fields(self)):
            if isinstance(value := getattr(self, name), int) and value > _MAX_WHOLE:
                raise InvalidOptions(f"{name} is {str(value)[:40]}; it must be at most {_MAX_WHOLE}")
        for name in ("port", "grpc_port"):
            if not 0 <= (getattr(self, name) or 0) < 2**16:
                raise InvalidOptions(f"{name} is {getattr(self, name)}; it must be in 0..65535 (0: any free one)")
        if self.port and self.port == self.grpc_port:
            raise InvalidOptions(f"port and grpc_port are both {self.port}; each must be one of its own")
        if not _ROOT_PATH.fullmatch(self.root_path):
            raise InvalidOptions(
                f"root_path is {self.root_path[:80]!r}; it must be like /straightpcf, with no / at its end"
            )

    def origins(self) -> tuple[str, ...]:
        """Return cors_origins; raises InvalidOptions for one that no browser sends."""
        found = _listed(self.cors_origins)
        for origin in found:
            usual = {"https": ":443", "http": ":80"}.get(origin.partition(":")[0])
            is_sent = _ORIGIN.fullmatch(origin) and not (usual and origin.endswith(usual))
            if not is_sent and origin not in ("*", "null"):
                raise InvalidOptions(
                    f"cors_origins: no browser sends {origin[:80]!r}; it must be like https://host or http://host:8080"
                )
        return found

    def hosts(self) -> tuple[str, ...]:
        """Return allowed_hosts; raises InvalidOptions for what is no name or address by itself."""
        found = tuple(host.removeprefix("[").removesuffix("]") for host in _listed(self.allowed_hosts))
        for host in found:
            if not _HOST.fullmatch(host):
                raise InvalidOptions(
                    f"allowed_hosts: {host[:80]!r} is no name or address by itself, as host or 10.0.0.1: no port, no /"
                )
        return found

    def keys(self) -> tuple[str, ...]:
        """Return the API keys; raises InvalidOptions for a key that no header carries, and where none is left.

        Only in a file does "#" begin a comment.
        """
        found = _usable_keys(self.api_keys.split(","), "api_keys")
        if self.api_keys.strip() and not found:
            raise InvalidOptions("api_keys holds no key; leave it out for a server that asks for none")
        if self.api_keys_file is not None:
            try:
                lines = self.api_keys_file.read_text(encoding="utf-8-sig").splitlines()  # as Notepad saves it, too
            except (OSError, UnicodeDecodeError) as exc:
                raise InvalidOptions(f"api_keys_file {self.api_keys_file}: {exc}") from exc
            lines = [line for line in lines if not line.lstrip().startswith("#")]
            found += _usable_keys(lines, f"api_keys_file {self.api_keys_file}")
            if not found:
                raise InvalidOptions(f"api_keys_file {self.api_keys_file} holds no key")
        return tuple(dict.fromkeys(found))

    @classmethod
    def from_environment(cls, environment: Mapping[str, str], **overrides: Any) -> Settings:
        """Read STRAIGHTPCF_* variables; an override that is not None wins. Raises InvalidOptions on unknown names."""
        kinds = {spec.name: str(spec.type) for spec in dataclasses.fields(cls)}
        values: dict[str, Any] = {}
        for variable, text in environment.items():
            if not variable.startswith(ENVIRONMENT_PREFIX) or _is_of_others(variable, text):
                continue
            name = variable.removeprefix(ENVIRONMENT_PREFIX).lower()
            if name not in kinds:
                raise InvalidOptions(f"{variable} is no setting; known: {', '.join(sorted(kinds))}")
            if text.strip():
                values[name] = _parse(variable, kinds[name], text)
            # Compose files leave a setting blank to say nothing; keys that are wanted and missing are a fault.
            elif name == "api_keys_file":
                raise InvalidOptions(f"{variable} is blank; name a file, or leave it out for a server without keys")
        values |= {name: value for name, value in overrides.items() if value is not None}
        return cls(**values)


def _is_of_others(variable: str, text: str) -> bool:
    if variable in _OF_OTHERS or _SERVICE_LINK.fullmatch(variable):
        return True
    return variable.endswith("_PORT") and _SERVICE_URL.fullmatch(text) is not None


def _listed(text: str) -> tuple[str, ...]:
    return tuple(item.strip().lower() for item in text.split(",") if item.strip())


def _usable_keys(texts: Iterable[str], setting: str) -> list[str]:
    """Leave out blanks; the error must not tell the key, for it ends in a log."""
    keys = [key for key in map(str.strip, texts) if key]
    for number, key in enumerate(keys, 1):
        if not (key.isascii() and key.isprintable()):
            raise InvalidOptions(f"{setting}: key {number} of {len(keys)} is not printable ASCII; no header carries it")
    return keys


def _parse(variable: str, kind: str, text: str) -> Any:
    readers = {"int": int, "float": float, "Path": Path, "str": str}
    read = readers[kind.removesuffix(" | None")]
    try:
        if read in (int, float) and not DECIMAL.fullmatch(text):
            raise ValueError(text)
        return read(text)
    except ValueError:
        raise InvalidOptions(f"{variable} is {text[:40]!r}; it must be {kind}") from None
