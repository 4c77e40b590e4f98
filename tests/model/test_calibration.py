"""What d means is read off traces and travels with the weights; it decides how many passes are made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from straightpcf.model.calibration import Calibration
from straightpcf.model.filter import load_filter
from straightpcf.model.metrics import chamfer_distance
from straightpcf.model.train.calibrate import Trace, calibrate, loss, passes
from straightpcf.model.train.calibrate import trace as measured
from straightpcf.points.errors import MalformedFile
from tests.clouds import noisy, sphere


def trace(noise_std: float, *distances: float) -> Trace:
    return Trace("cloud", noise_std, distances, (1.0,) * len(distances))


def test_the_table_of_noise_levels_is_read_off_traces() -> None:
    recorded = [trace(std, d, d) for std, d in ((0.0, 0.1), (0.01, 0.5), (0.01, 0.7), (0.01, 0.6), (0.02, 0.9))]
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


def test_walls_that_a_pass_shows_get_four_passes() -> None:
    of_walls = (0.90, 0.57, 0.46, 0.44)
    assert Calibration().passes_left(of_walls) == 0
    assert Calibration().passes_left(of_walls, shown_walls=True) > 0
    assert Calibration().passes_left((*of_walls, 0.43), shown_walls=True) == 0


@pytest.mark.parametrize(
    ("distances", "noise_in_radii", "irregular", "most"),
    [
        ((0.34, 0.14), 0.010, False, 1),  # little noise, read of bends
        ((0.69, 0.15), 0.025, False, 2),
        ((0.69, 0.40), 0.025, False, 1),
        ((0.28, 0.17), 0.016, False, 2),  # a scan, with noise along its beams
        ((0.60, 0.26), 0.025, True, 1),
        ((0.95, 0.49), 0.050, True, 5),
        ((0.90, 0.82), 0.051, True, 1),  # fins
        ((0.96, 0.90), 0.051, True, 5),  # 8 % of noise
    ],
)
def test_few_points_get_no_more_passes_than_their_noise_asks_for(
    distances: tuple[float, ...], noise_in_radii: float, irregular: bool, most: int
) -> None:
    shipped = Calibration(starts=(0.21, 0.75, 0.9), polish=(0.35, 0.62), settled=(0.18, 0.3), stuck=0.64, most=5)
    stirred = (0.6,) * 4
    many = Trace("cloud", 0.01, (*distances, *stirred), (), noise_in_radii=noise_in_radii, irregular=irregular)
    counts = (1000, 400, 5000)
    assert [passes(shipped, replace(many, points=count)) for count in counts] == [most, 1, 5]


def test_of_dense_points_a_third_pass_is_made_where_the_second_leaves_more() -> None:
    distances = (0.58, 0.19, 0.12, 0.12, 0.12)
    few, dense = (
        Trace("cloud", 0.01, distances, (), noise_in_radii=radii, thicknesses=(0.0, 0.305, 0.043, 0.022, 0.02))
        for radii in (0.02, 0.06)
    )
    assert (passes(Calibration(), few), passes(Calibration(), dense)) == (2, 3)
    bent = replace(dense, thicknesses=(0.0, 0.131, 0.105, 0.108, 0.109))  # few points, of which bends are as thick
    assert passes(Calibration(), bent) == 2
    assert passes(Calibration(), Trace("thin", 0.01, (0.58, 0.3, 0.3), (), noise_in_radii=0.06)) == 1
    assert passes(Calibration(), Trace("clean", 0.0, (0.13, 0.12, 0.12), (), noise_in_radii=0.06)) == 1
    distances = (0.55, 0.325, 0.202, 0.171, 0.142, 0.132)  # `special_cube`, 50K, uniform noise of 3 %
    fitted = Calibration(starts=(0.21, 0.75), polish=(0.35, 0.76), settled=(0.18, 0.3), most=5)
    thicknesses = (0.0, 0.628, 0.394, 0.200, 0.049, 0.012)
    thick = Trace("uniform", 0.03, distances, (), noise_in_radii=0.046, thicknesses=thicknesses)
    assert passes(fitted, thick) == 5
    assert passes(fitted, replace(thick, noise_in_radii=0.02)) == 2
    fins = Trace(
        "fins", 0.005, (0.41, 0.21, 0.19, 0.19), (), noise_in_radii=0.052, thicknesses=(0.0, 0.075, 0.020, 0.018)
    )
    assert passes(fitted, fins) == 2


@pytest.mark.parametrize(
    ("start", "now", "thin_walls", "made"),
    [
        (0.31, 0.19, False, 2),  # a scan, noise of 1 % along its beams
        (0.30, 0.256, False, 1),  # a shape that d is as high of without noise
        (0.31, 0.20, True, 1),
        (0.66, 0.38, False, 2),
        (0.66, 0.43, False, 1),  # walls, or rods
        (0.79, 0.50, False, 2),  # a thin body with more noise
        (0.83, 0.60, False, 1),
        (0.83, 0.54, True, 1),
        (0.90, 0.70, True, 2),  # so much noise that a pass hardly shows
    ],
)
def test_a_second_pass_is_made_only_after_a_first_that_took_much(
    start: float, now: float, thin_walls: bool, made: int
) -> None:
    twice = Calibration(starts=(0.21,), polish=(), settled=())
    assert passes(twice, Trace("walls", 0.01, (start, now, 0.35, 0.35), (), thin_walls=thin_walls)) == made


@pytest.mark.parametrize(
    ("start", "now", "noise_in_radii", "goes_on"),
    [
        (0.839, 0.593, 0.155, True),  # `dino`, 50K points, 2 %: one pass left 2.4 times the CD of three
        (0.801, 0.568, 0.040, True),  # `solid010`, 10K, 2 %: 1.6 times
        (0.611, 0.391, 0.100, True),  # `dino`, 50K, uniform noise of 3 %: 2.4 times
        (0.816, 0.702, 0.035, False),  # stacked plates, 6,000 points by chance, 1 %
        (0.787, 0.580, 0.026, False),  # 2,000, 0.5 %
    ],
)
def test_what_a_first_pass_leaves_of_large_noise_is_no_sign_of_walls(
    start: float, now: float, noise_in_radii: float, *, goes_on: bool
) -> None:
    recorded = Trace("cloud", 0.02, (start, now, 0.21, 0.16), (), noise_in_radii=noise_in_radii)
    assert (passes(Calibration(starts=(0.45, 0.76)), recorded) > 1) == goes_on


def test_scenes_get_no_more_passes_than_their_own_limits_ask_for() -> None:
    fitted = Calibration(starts=(0.45, 0.75, 0.9), polish=(0.22, 0.62, 0.74, 0.92), settled=(0.18, 0.26, 0.2, 0.2))
    street = trace(0.0, 0.778, 0.30, 0.21, 0.15, 0.13, 0.12)
    assert passes(fitted, street) == 4
    assert passes(fitted.of_scenes(), street) == 2
    assert fitted.of_scenes().noise == fitted.noise


def test_what_the_first_pass_does_not_lower_is_no_noise() -> None:
    assert passes(Calibration(starts=(0.45,)), trace(0.0, 0.57, 0.48, 0.45, 0.44)) == 1
    nearly_clean = Calibration(starts=(0.45,), polish=(0.22,), settled=(0.18,))  # d of clean clouds is 0.12
    assert passes(nearly_clean, trace(0.0, 0.223, 0.16, 0.15)) == 2
    assert passes(Calibration(stuck=1.0, starts=(0.45,)), trace(0.0, 0.57, 0.48, 0.45, 0.44)) == 2
    assert passes(Calibration(), trace(0.0, 0.90, 0.80, 0.40, 0.20)) > 1  # so much noise that a pass hardly shows


def test_the_limits_are_those_under_which_recorded_clouds_end_best() -> None:
    smooth = [  # four passes are best, one more does harm
        Trace("smooth", 0.02, (0.87, 0.24, 0.15, 0.13, 0.12, 0.11), (9.0, 4.0, 3.0, 2.5, 2.0, 2.2)),
        Trace("smooth", 0.01, (0.58, 0.14, 0.12, 0.12, 0.11, 0.11), (5.0, 2.1, 2.0, 2.1, 2.2, 2.3)),
    ]
    intricate = [Trace("thin", 0.01, (0.71, 0.30, 0.24, 0.19, 0.16, 0.15), (5.0, 4.0, 6.0, 7.0, 8.0, 9.0))]
    fitted = calibrate([*smooth, *intricate])
    assert [passes(fitted, t) for t in smooth + intricate] == [4, 2, 1]
    assert loss(fitted, smooth + intricate) == pytest.approx(0)
    assert loss(Calibration(), smooth + intricate) > 0


def test_a_pass_that_makes_a_cloud_worse_than_its_input_costs_most() -> None:
    worse = Trace("thin", 0.01, (0.6, 0.15, 0.1, 0.1, 0.1, 0.1), (5.0, 4.9, 5.5, 6.0, 6.0, 6.0))
    others = Trace("smooth", 0.01, (0.6, 0.15, 0.1, 0.1, 0.1, 0.1), (9.0, 5.0, 4.5, 4.5, 4.5, 4.5))
    assert passes(calibrate([others]), others) == 2
    assert passes(calibrate([others, worse]), worse) == 1


def test_a_calibration_survives_its_metadata_and_a_broken_one_is_refused() -> None:
    calibration = calibrate([trace(0.0, 0.1, 0.1), trace(0.01, 0.6, 0.1)])
    assert Calibration.from_metadata(calibration.to_metadata()) == calibration
    older = {**calibration.to_metadata()["calibration"], "crowded": 0.042}
    assert Calibration.from_metadata({"calibration": older}) == calibration
    for broken in (
        {"polished": 0.2},
        {"distances": [0.5, 0.4], "noise": [0.0, 0.1]},
        {"limits": [0.1]},
        7,
        {"settled": [0.2]},
    ):
        with pytest.raises(MalformedFile):
            Calibration.from_metadata({"calibration": broken})


def test_a_trace_has_d_and_cd_before_each_pass_and_after_the_last() -> None:
    clean = sphere(400)
    rough = noisy(clean, 0.03)
    recorded = measured(load_filter(device="cpu", threads=1), "ball", clean, rough, 0.03, "laplace")
    assert (recorded.cloud, recorded.noise_std, recorded.noise_type) == ("ball", 0.03, "laplace")
    assert len(recorded.distances) == len(recorded.chamfer) == 6
    assert recorded.noise_in_radii > 0
    assert recorded.chamfer[0] == pytest.approx(chamfer_distance(rough, clean))
    assert min(recorded.chamfer) < recorded.chamfer[0]


def test_levels_of_one_size_but_of_two_types_of_noise_weigh_apart() -> None:
    good, bad = (0.3, 0.1, 0.1), (2.0, 1.0, 1.0)
    often = [Trace(f"cloud{n}", 0.01, good, bad) for n in range(9)]
    once = Trace("cloud", 0.01, good, (2.0, 1.5, 1.0), "uniform")
    assert passes(Calibration(), once) == 1
    assert loss(Calibration(), [*often, once]) == pytest.approx(np.log(1.5) / 2)
