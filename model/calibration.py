"""What the DistanceModule's number means for one set of weights: a noise level, and how many passes it asks for."""

from __future__ import annotations

from collections.abc import Mapping
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
    one_pass: d up to which one pass is enough; stop: d below which a cloud counts as clean after a pass.
    most: never more passes than this.
    """

    distances: tuple[float, ...] = (0.0, 1.0)
    noise: tuple[float, ...] = (0.0, 0.02)
    one_pass: float = 0.6
    stop: float = 0.3
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

    def passes_left(self, distance: float, *, done: int) -> int:
        """Say how many passes to go, given the cloud's median d before the next one: 0, 1, or 2 for "at least"."""
        if done >= self.most or (done > 0 and distance < self.stop):
            return 0
        return 1 if distance < self.one_pass or done == self.most - 1 else 2
