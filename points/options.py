"""The one vocabulary of a denoising request, shared by the library, the CLI, the SDK and the server."""

from __future__ import annotations

import re
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Literal, TypeVar

from straightpcf.points.errors import InvalidOptions

__all__ = ["DECIMAL", "MAX_ITERATIONS", "MAX_THREADS", "MIN_TILE_POINTS", "DenoiseOptions", "check_threads"]

MAX_ITERATIONS = 10
MAX_THREADS = 1024  # more than machines have CPUs; a thread is begun for each
MIN_TILE_POINTS = 10_000  # half of it, the smallest tile, still has whole patches
_ITERATIONS, _SEED, _STRENGTH = f'"auto" or 1..{MAX_ITERATIONS}', f"an integer in 0..{2**32 - 1}", "in 0..1"
# Python reads more: 1_000, and the digits of every script.
DECIMAL = re.compile(r"\s*[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?\s*", re.ASCII | re.IGNORECASE)
_T = TypeVar("_T", int, float)


@dataclass(frozen=True, kw_only=True)
class DenoiseOptions:
    """Describe what to do with one cloud.

    iterations: passes of the whole filter, 1..10, or "auto": decided from the cloud itself.
    seed: picks the first patch seed; the same seed gives the same bytes.
    strength: 0..1, the share of the displacement that is applied (1 = the filter's own result).
    normals: "keep" those of the file, or "recompute" them at the new positions.
    Raises InvalidOptions naming the value and the limit.
    """

    iterations: int | Literal["auto"] = "auto"
    seed: int = 0
    strength: float = 1.0
    normals: Literal["keep", "recompute"] = "keep"

    def __post_init__(self) -> None:
        """Validate every field; numbers of other libraries, as numpy's scalars, become Python's."""
        if self.iterations != "auto":
            passes = _whole("iterations", self.iterations, range(1, MAX_ITERATIONS + 1), _ITERATIONS)
            object.__setattr__(self, "iterations", passes)
        object.__setattr__(self, "seed", _whole("seed", self.seed, range(2**32), _SEED))
        if isinstance(self.strength, bool) or not (isinstance(self.strength, Real) and 0 <= self.strength <= 1):
            raise InvalidOptions(f"strength is {_shown(self.strength)}; it must be {_STRENGTH}")
        object.__setattr__(self, "strength", float(self.strength))
        if self.normals not in ("keep", "recompute"):
            raise InvalidOptions(f'normals is {_shown(self.normals)}; it must be "keep" or "recompute"')

    @classmethod
    def parse(
        cls,
        *,
        iterations: str | None = None,
        seed: str | None = None,
        strength: str | None = None,
        normals: str | None = None,
    ) -> DenoiseOptions:
        """Read options from text, as forms, query strings and command lines carry them; None keeps the default."""
        default = cls()
        return cls(
            iterations=default.iterations if iterations is None else _iterations(iterations),
            seed=default.seed if seed is None else _number("seed", int, seed, _SEED),
            strength=default.strength if strength is None else _number("strength", float, strength, _STRENGTH),
            normals=default.normals if normals is None else normals.strip().lower(),  # type: ignore[arg-type]
        )


def check_threads(threads: int | None) -> None:
    """Raise InvalidOptions where CPU threads are no whole number in 1..MAX_THREADS; None is one for each CPU."""
    if threads is not None:
        _whole("threads", threads, range(1, MAX_THREADS + 1), f"a whole number in 1..{MAX_THREADS}")


def _whole(name: str, value: object, allowed: range, limit: str) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral) or int(value) not in allowed:
        raise InvalidOptions(f"{name} is {_shown(value)}; it must be {limit}")
    return int(value)


def _shown(value: object) -> str:
    try:
        return repr(value)[:80]
    except ValueError:  # Python writes no whole number of more than 4300 digits
        return f"a {type(value).__name__} of too many digits"


def _iterations(text: str) -> int | Literal["auto"]:
    return "auto" if text.strip().lower() == "auto" else _number("iterations", int, text, _ITERATIONS)


def _number(name: str, kind: type[_T], text: str, limit: str) -> _T:
    try:
        if not DECIMAL.fullmatch(text):
            raise ValueError(text)
        return kind(text)
    except ValueError:
        raise InvalidOptions(f"{name} is {text[:40]!r}; it must be {limit}") from None
