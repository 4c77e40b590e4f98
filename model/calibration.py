"""What the DistanceModule's number means for one set of weights: a noise level, and how many passes it asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile

__all__ = ["Calibration"]


@dataclass(frozen=True)
class Calibration:
    """The table and the limits that `auto` uses; measured by `model.train.calibrate`, kept with the weights.

    distances, noise: equally long, rising: the median d at a known noise std (unit-sphere frame).
    Another pass is made while all of this holds: d was above `noisy` at the start; the last pass moved its points
    by more than `settled` (median, in the frame the network sees); it left d above `still_noisy`, or brought it down
    to less than `falls` of what it was; fewer than `most` were made. d after a pass cannot decide alone: on thin and
    intricate shapes it stays high, and hardly falls, when the noise is gone.
    """

    distances: tuple[float, ...] = (0.0, 1.0)
    noise: tuple[float, ...] = (0.0, 0.02)
    noisy: float = 0.67
    settled: float = 0.008
    still_noisy: float = 0.6
    falls: float = 0.75
    most: int = 4

    def __post_init__(self) -> None:
        """Refuse tables that cannot be looked up in."""
        if len(self.distances) != len(self.noise) or len(self.noise) < 2 or np.any(np.diff(self.distances) <= 0):
            raise MalformedFile("the calibration's distances must rise and be as many as its noise levels, 2 at least")

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any]) -> Calibration:
        """Read the `calibration` entry of a checkpoint's metadata; the defaults where there is none."""
        entry = metadata.get("calibration")
        if entry is None:
            return cls()
        try:
            values: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in entry.items()}
            return cls(**values)
        except (AttributeError, TypeError) as exc:
            raise MalformedFile(f"the weights' calibration does not fit: {exc}") from exc

    def to_metadata(self) -> dict[str, Any]:
        """Return what `from_metadata` reads."""
        return {"calibration": asdict(self)}

    def noise_std(self, distances: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Translate d into a noise std in the frame the network sees."""
        return np.interp(distances, self.distances, self.noise)

    def passes_left(self, moves: Sequence[float], distances: Sequence[float]) -> int:
        """Say how many passes to go: 0, 1, or 2 for "one or more".

        moves: the median displacement of each pass made; distances: d before each of them, and now.
        """
        done = len(moves)
        if done >= self.most or (done > 0 and not self._noise_is_left(moves, distances)):
            return 0
        return 1 if done == self.most - 1 else 2

    def _noise_is_left(self, moves: Sequence[float], distances: Sequence[float]) -> bool:
        before, after = distances[len(moves) - 1 :][:2]
        works = after > self.still_noisy or after < self.falls * before
        return distances[0] > self.noisy and moves[-1] > self.settled and works
