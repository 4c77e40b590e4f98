"""What d means is read off traces and travels with the weights; it decides how many passes are made."""

from __future__ import annotations

import numpy as np
import pytest

from straightpcf.model.calibration import Calibration
from straightpcf.model.train.calibrate import Trace, calibrate, passes
from straightpcf.points.errors import MalformedFile


def trace(noise_std: float, *distances: float) -> Trace:
    return Trace("cloud", noise_std, distances, (1.0,) * 5)


def test_the_table_of_noise_levels_is_read_off_traces() -> None:
    recorded = [trace(std, d) for std, d in ((0.0, 0.1), (0.01, 0.5), (0.01, 0.7), (0.01, 0.6), (0.02, 0.9))]
    calibration = calibrate(recorded)
    assert calibration.noise_std(np.array([0.0, 0.1, 0.6, 0.75, 1.0])) == pytest.approx([0, 0, 0.01, 0.015, 0.02])


@pytest.mark.parametrize(
    ("distances", "made"),
    [
        ((0.13, 0.12, 0.12, 0.12, 0.12), 1),  # clean
        ((0.30, 0.13, 0.12, 0.12, 0.12), 1),
        ((0.58, 0.14, 0.12, 0.12, 0.12), 2),  # noisy, then like a clean surface: polished once
        ((0.70, 0.30, 0.25, 0.19, 0.16), 1),  # thin and intricate: let be
        ((0.87, 0.23, 0.15, 0.13, 0.12), 3),
        ((0.87, 0.44, 0.24, 0.18, 0.16), 2),
        ((0.94, 0.55, 0.21, 0.15, 0.14), 4),
        ((0.93, 0.67, 0.34, 0.22, 0.18), 3),
        ((0.90, 0.80, 0.70, 0.60, 0.55), 4),  # noise is left, but four passes are all there are
    ],
)
def test_a_cloud_gets_the_passes_that_its_distances_ask_for(distances: tuple[float, ...], made: int) -> None:
    assert passes(Calibration(), trace(0.0, *distances)) == made


def test_a_calibration_survives_its_metadata_and_a_broken_one_is_refused() -> None:
    calibration = calibrate([trace(0.0, 0.1), trace(0.01, 0.6)])
    assert Calibration.from_metadata(calibration.to_metadata()) == calibration
    for broken in ({"polished": [1.0]}, {"distances": [0.5, 0.4], "noise": [0.0, 0.1]}, {"settled": 0.1}, 7):
        with pytest.raises(MalformedFile):
            Calibration.from_metadata({"calibration": broken})
