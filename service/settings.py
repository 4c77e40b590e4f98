"""Read what an operator may set: the only place that looks at the environment."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from straightpcf.points.errors import InvalidOptions

__all__ = ["ENVIRONMENT_PREFIX", "Settings"]

ENVIRONMENT_PREFIX = "STRAIGHTPCF_"


def _default_data_dir() -> Path:
    return Path.home() / ".local" / "share" / "straightpcf"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Configure one server; each field is STRAIGHTPCF_<NAME> in the environment.

    max_bytes: of one request body.  max_points: of one cloud.
    max_jobs: accepted at once, waiting and running; more are answered "busy".
    max_wait_seconds: from acceptance until a worker takes the job; longer is answered "busy".
    device: "auto" | "cpu" | "cuda".  weights: None for the shipped ones.  threads: None for torch's own choice.
    shutdown_seconds: how long running requests may finish after SIGTERM.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    data_dir: Path = field(default_factory=_default_data_dir)
    max_bytes: int = 512 * 2**20
    max_points: int = 5_000_000
    max_jobs: int = 32
    max_wait_seconds: float = 300.0
    device: str = "auto"
    weights: Path | None = None
    threads: int | None = None
    shutdown_seconds: int = 30

    def __post_init__(self) -> None:
        """Refuse limits that would admit nothing."""
        for name in ("max_bytes", "max_points", "max_jobs", "max_wait_seconds", "threads", "shutdown_seconds"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise InvalidOptions(f"{name} is {value}; it must be above 0")
        if not 0 <= self.port < 2**16:
            raise InvalidOptions(f"port is {self.port}; it must be in 0..65535 (0: any free one)")

    @classmethod
    def from_environment(cls, environment: Mapping[str, str], **overrides: Any) -> Settings:
        """Read STRAIGHTPCF_* variables; an override that is not None wins. Raises InvalidOptions on unknown names."""
        kinds = {spec.name: str(spec.type) for spec in dataclasses.fields(cls)}
        values: dict[str, Any] = {}
        for variable, text in environment.items():
            if not variable.startswith(ENVIRONMENT_PREFIX):
                continue
            name = variable.removeprefix(ENVIRONMENT_PREFIX).lower()
            if name not in kinds:
                raise InvalidOptions(f"{variable} is no setting; known: {', '.join(sorted(kinds))}")
            values[name] = _parse(variable, kinds[name], text)
        values |= {name: value for name, value in overrides.items() if value is not None}
        return cls(**values)


def _parse(variable: str, kind: str, text: str) -> Any:
    readers = {"int": int, "float": float, "Path": Path, "str": str}
    try:
        return readers[kind.removesuffix(" | None")](text)
    except ValueError:
        raise InvalidOptions(f"{variable} is {text[:40]!r}; it must be {kind}") from None
