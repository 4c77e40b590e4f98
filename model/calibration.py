"""What the DistanceModule's number means for one set of weights: a noise level, and how many passes it asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile

__all__ = ["Calibration", "signs"]


@dataclass(frozen=True)
class Calibration:
    """The table and the limits that `auto` uses; measured by `model.train.calibrate`, kept with the weights.

    distances, noise: equally long, rising: the median d at a known noise std (unit-sphere frame).
    rule: the weights of `signs` and a constant; another pass is made while their sum is above 0 and fewer than `most`
    were made. d after a pass cannot decide alone: on thin and intricate shapes it stays high, and hardly falls,
    when the noise is gone.
    """

    distances: tuple[float, ...] = (0.0, 1.0)
    noise: tuple[float, ...] = (0.0, 0.02)
    rule: tuple[float, ...] = (0.7, -0.8, 0.6, 0.95, -0.05)
    most: int = 4

    def __post_init__(self) -> None:
        """Refuse tables that cannot be looked up in."""
        if len(self.distances) != len(self.noise) or len(self.noise) < 2 or np.any(np.diff(self.distances) <= 0):
            raise MalformedFile("the calibration's distances must rise and be as many as its noise levels, 2 at least")
        if len(self.rule) != 5:
            raise MalformedFile(f"the calibration's rule has {len(self.rule)} numbers; it must have 5")

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
        if done == 0:
            return 2
        if done >= self.most or float(np.dot(self.rule, [*signs(moves, distances), 1.0])) <= 0:
            return 0
        return 1 if done == self.most - 1 else 2


def signs(moves: Sequence[float], distances: Sequence[float]) -> tuple[float, float, float, float]:
    """Return what tells whether noise is left after len(moves) passes, each about 0 at the limit.

    d now; d now in terms of d before the last pass; how far that pass moved its points; d at the start.
    """
    before, now = distances[len(moves) - 1 :][:2]
    return now - 0.6, now / max(before, 1e-6) - 0.8, 100 * moves[-1] - 0.8, distances[0] - 0.8
