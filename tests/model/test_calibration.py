"""The rule for another pass is fitted to what was seen, and travels with the weights."""

from __future__ import annotations

import numpy as np
import pytest

from straightpcf.model.calibration import Calibration
from straightpcf.model.train.calibrate import Trace, calibrate, passes
from straightpcf.points.errors import MalformedFile


def traces() -> list[Trace]:
    """Clouds that want n passes for n % of noise: d falls as it is taken away, and a pass too many does harm."""
    random = np.random.default_rng(0)
    made = []
    for cloud in range(12):
        for percent in (1, 2, 3):
            left = [max(percent - n, 0) for n in range(5)]
            distances = [0.5 + 0.12 * noise + 0.005 * random.standard_normal() for noise in left]
            moves = [0.003 + 0.003 * noise for noise in left[:4]]
            chamfer = [1.0 + abs(n - percent) for n in range(5)]
            made.append(Trace(f"{cloud}", percent / 100, tuple(distances), tuple(moves), tuple(chamfer)))
    return made


def test_the_fitted_rule_makes_the_best_number_of_passes() -> None:
    recorded = traces()
    calibration = calibrate(recorded)
    assert [passes(calibration, t) for t in recorded] == [round(100 * t.noise_std) for t in recorded]
    assert calibrate(recorded) == calibration
    assert calibration.noise_std(np.array([calibration.distances[1]]))[0] == pytest.approx(0.02)


def test_a_calibration_survives_its_metadata_and_a_broken_one_is_refused() -> None:
    calibration = calibrate(traces())
    assert Calibration.from_metadata(calibration.to_metadata()) == calibration
    for broken in ({"rule": [1.0]}, {"distances": [0.5, 0.4], "noise": [0.0, 0.1]}, {"settled": 0.1}, 7):
        with pytest.raises(MalformedFile):
            Calibration.from_metadata({"calibration": broken})
