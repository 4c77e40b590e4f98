"""What is read of a cloud before a pass, by a DistanceModule that says what it is told to."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.model.calibration import Calibration
from straightpcf.model.noise import NoiseReader
from straightpcf.model.normalize import LOUD_NOISE, CloudFrame
from straightpcf.model.tiles import Tiling
from tests.clouds import torus

_POINTS = 10_000


class Says:
    """A processor that reads a noise std of a quarter of the points, and another of all of them shown at half size."""

    def __init__(self, far: float, near: float) -> None:
        self.far, self.near = far, near

    def distances(self, here: npt.NDArray[np.float64], cut: Any, scales: npt.NDArray[np.float64]) -> Any:
        noise = self.far if len(here) < _POINTS else self.near
        return np.minimum(noise * scales / 0.02, 1.0)  # the default calibration

    def each(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        return map(function, items)


def tile(xyz: npt.NDArray[np.float64]) -> Tiling:
    return Tiling(xyz, [np.arange(len(xyz))], coverage=3.0, seed=0, device="cpu")


@pytest.mark.parametrize(
    ("far", "near", "loud"), [(0.039, 0.039, True), (0.039, 0.032, False), (0.034, 0.039, False), (0.038, 0.035, True)]
)
def test_noise_is_loud_where_it_is_read_so_far_around_and_near(far: float, near: float, *, loud: bool) -> None:
    xyz = torus(_POINTS)
    here = CloudFrame.of(xyz).enter(xyz)
    reader = NoiseReader(Says(far, near), Calibration(), tile, zoom=True)  # type: ignore[arg-type]
    reading = reader.read(here, tile(here), None)
    assert reading.noise_std == pytest.approx(far)
    assert reading.loud is loud
    assert not reading.loud or reading.noise_std > LOUD_NOISE
