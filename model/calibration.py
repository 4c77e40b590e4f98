"""What the DistanceModule's number means for one set of weights: a noise level, and how many passes it asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from straightpcf.points.errors import MalformedFile

__all__ = ["DENSE_FROM_RADII", "FEWEST_POINTS", "FEW_POINTS", "Calibration"]

# d of noise that one pass takes most of: hardly any, little, and what leaves more of thin bodies (1.5 to 2 %).
_LEAST_NOISE_DISTANCE, _LITTLE_NOISE_DISTANCE, _ONE_PASS_DISTANCE = 0.45, 0.75, 0.87
# Up to this d, which says as much of shape as of noise, a second pass that is not due is made all the same where what
# it would take of the shape (the coherent part of its step, `model.coherence`) is less than the first share of what
# points have moved, squared, and one that is due is not from the second on.
_FAINT_DISTANCE, _LITTLE_TAKEN, _MUCH_TAKEN = 0.35, 0.009, 0.02
_NOISE_COHERENCE_OF_SCENES = 0.12  # below it a scene gets a pass that is not due
# What `stuck` is at least where no walls were seen, but for little noise. It rises there by so much for each radius of
# a patch that the noise is above so many: of dense points a pass leaves more, and walls are read as little in radii.
_STUCK_WITHOUT_WALLS, _STUCK_BY_RADIUS, DENSE_FROM_RADII = 0.7, 8.0, 0.03
# Of dense points two and three passes leave more of uniform noise and of noise along beams, which read as little. d is
# as high of fins without noise: what tells is how thick the surface is beside how far apart its points are, and that
# the last pass has made it thinner, or that it is so thick: of few points bends are as thick as a little noise.
_LEFT_THICKNESS, _THINNED, _THICK = 0.03, 0.75, 0.3
# d says little of walls that a pass has begun to part: each of the next ones parts them farther.
_PASSES_OF_SHOWN_WALLS = 4
# Of few points bends look like noise, and passes pull them flat; the fewest get one. So do others where a patch's noise
# in its radii, times the points, is less than the first, or less than the second where they lie by chance; or where the
# first leaves more than this share of d, and this d. Else they get two, up to the second. Shape is also what leaves
# nearly all of d, up to a larger one at the start than of many points.
FEWEST_POINTS, FEW_POINTS = 500, 5000
_NOISE_OF_FEW, _LARGE_NOISE_OF_FEW = 14.0, 0.04
_LEFT_OF_FEW, _SETTLED_OF_FEW = 0.5, 0.17
_STUCK_OF_FEW, _LOUD_DISTANCE = 0.75, 0.93
_FORMER = "crowded"  # a limit that older weights have: the thickness of the surface took its place


@dataclass(frozen=True)
class Calibration:
    """The table and the limits that `auto` uses; measured by `model.train.calibrate`, kept with the weights.

    distances, noise: equally long, rising: the median d at a known noise std (unit-sphere frame).
    starts: d at the start above which a cloud gets a second, a third, ... pass, as the paper gives 1, 2 and 3.
    polish, settled: equally long; where d was above polish[i] at the start, pass i + 2 is made all the same if d is
    below settled[i] by then. On thin and intricate shapes d stays higher when the noise is gone, and further passes
    pull their sides together.
    stuck: where a second pass is due, but d after the first is more than this share of d at the start, walls close
    together were read, not noise, or rods, or what is left of shapes without any: further passes would join them.
    stirred: d above which noise is left whatever was done. most: passes in all.
    scene_starts, scene_polish, scene_settled: what scenes have instead, which `calibrate` does not fit: their further
    passes thin poles and wires, and d does not tell.
    """

    distances: tuple[float, ...] = (0.0, 1.0)
    noise: tuple[float, ...] = (0.0, 0.02)
    starts: tuple[float, ...] = (0.76, 0.905)
    polish: tuple[float, ...] = (0.45, 0.76, 0.905)
    settled: tuple[float, ...] = (0.2, 0.2, 0.2)
    stuck: float = 0.61
    stirred: float = 0.5
    most: int = 4
    scene_starts: tuple[float, ...] = (0.45, 0.815, 0.945)
    scene_polish: tuple[float, ...] = (0.22, 0.62, 0.86, 0.92)
    scene_settled: tuple[float, ...] = (0.18, 0.18, 0.22, 0.22)

    def __post_init__(self) -> None:
        """Refuse tables that cannot be looked up in."""
        if len(self.distances) != len(self.noise) or len(self.noise) < 2 or np.any(np.diff(self.distances) <= 0):
            raise MalformedFile("the calibration's distances must rise and be as many as its noise levels, 2 at least")
        for of, polish, settled in (("", self.polish, self.settled), ("scene_", self.scene_polish, self.scene_settled)):
            if len(polish) != len(settled):
                raise MalformedFile(
                    f"the calibration has {len(polish)} of {of}polish and {len(settled)} of {of}settled"
                )

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any]) -> Calibration:
        """Read the `calibration` entry of a checkpoint's metadata; the defaults where there is none."""
        entry = metadata.get("calibration")
        if entry is None:
            return cls()
        try:
            values: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in entry.items()}
            values.pop(_FORMER, None)
            return cls(**values)
        except (AttributeError, TypeError) as exc:
            raise MalformedFile(f"the weights' calibration does not fit: {exc}") from exc

    def to_metadata(self) -> dict[str, Any]:
        """Return what `from_metadata` reads."""
        return {"calibration": asdict(self)}

    def noise_std(self, distances: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Translate d into a noise std in the frame the network sees."""
        return np.interp(distances, self.distances, self.noise)

    def of_scenes(self) -> Calibration:
        """Return the calibration that scenes have."""
        return replace(self, starts=self.scene_starts, polish=self.scene_polish, settled=self.scene_settled)

    def passes_left(
        self,
        distances: Sequence[float],
        noise_in_radii: float = 0.0,
        *,
        points: int = FEW_POINTS,
        irregular: bool = False,
        thin_walls: bool = False,
        shown_walls: bool = False,
        thicknesses: Sequence[float] = (),
    ) -> int:
        """Say how many passes to go: 0, 1, or 2 for "one or more".

        distances: d before each pass that was made, and now; noise_in_radii: the noise at the start, of a patch, 0 of a
        scene; points: how many there are; irregular: whether they lie on their surface by chance, or in lines;
        thin_walls: whether points seemed to be on walls close together before the first pass; shown_walls: whether they
        seem to be since, where strong noise hid them; thicknesses: of the surface (`Reading`), as many as distances.
        """
        done, start, now = len(distances) - 1, distances[0], distances[-1]
        due = max(1 + sum(start > limit for limit in self.starts), _PASSES_OF_SHOWN_WALLS if shown_walls else 1)
        stuck = self.stuck
        if not thin_walls:
            little = _LEAST_NOISE_DISTANCE <= start < _LITTLE_NOISE_DISTANCE
            stuck = stuck if little else max(stuck, _STUCK_WITHOUT_WALLS)
            stuck += _STUCK_BY_RADIUS * max(0.0, noise_in_radii - DENSE_FROM_RADII)
        if done == 1 < due and start < _ONE_PASS_DISTANCE and now > stuck * start:
            return 0
        polished = 1 + sum(start > limit for limit in self.polish)
        dense = polished == 2 and noise_in_radii > DENSE_FROM_RADII and not thin_walls
        polishing = due <= done < polished and now < self.settled[done - 1]
        left = dense and _has_left(thicknesses)
        most = self._most_of_few(distances, noise_in_radii, points, irregular) if points < FEW_POINTS else self.most
        if done >= most or not (done < due or polishing or left or now > self.stirred):
            return 0
        return 1 if done == most - 1 or (polishing and done == polished - 1 and not dense) else 2

    def asks_for_shape(self, distances: Sequence[float], points: int) -> bool:
        """Say whether the number of passes of an object depends on what the next one would take of its shape."""
        return len(distances) == 2 and distances[0] < _FAINT_DISTANCE and points >= FEW_POINTS

    def passes_by_shape(self, left: int, taken: float) -> int:
        """Say how many passes to go, 0, 1 or 2, where `passes_left` says `left`.

        taken: of the mean square of how far points have moved, the share that is the coherent part of the next step.
        """
        if left == 0:
            return 1 if taken < _LITTLE_TAKEN else 0
        return left if taken < _MUCH_TAKEN else 0

    def passes_of_scene_by_coherence(self, coherence: float) -> int:
        """Say how many passes of a scene to go, 0 or 1, where `passes_left` says 0, by the coherence of its step."""
        return 1 if coherence < _NOISE_COHERENCE_OF_SCENES else 0

    def _most_of_few(self, distances: Sequence[float], noise_in_radii: float, points: int, irregular: bool) -> int:
        if points < FEWEST_POINTS:
            return 1
        if noise_in_radii == 0.0:  # a scene
            return self.most
        start, left = distances[0], distances[1] if len(distances) > 1 else 0.0
        if left > _STUCK_OF_FEW * start and start < _LOUD_DISTANCE:
            return 1
        if noise_in_radii >= _LARGE_NOISE_OF_FEW:
            return self.most
        little = irregular or noise_in_radii * points < _NOISE_OF_FEW
        return 1 if little or left > max(_LEFT_OF_FEW * start, _SETTLED_OF_FEW) else 2


def _has_left(thicknesses: Sequence[float]) -> bool:
    """Say of a surface after two passes and more whether the last one has left noise that another one takes."""
    if len(thicknesses) <= 2:
        return False
    before, now = thicknesses[-2:]
    return now > _THICK or _LEFT_THICKNESS < now < _THINNED * before
