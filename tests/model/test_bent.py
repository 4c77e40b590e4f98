"""More parts where an object is nothing but bent: sheets, bodies and walls that are known exactly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from straightpcf.model.bent import off_quadrics, parts_of_object
from straightpcf.model.normalize import parts_of
from straightpcf.model.patches import Patches
from straightpcf.model.tiles import Tiling
from tests.clouds import torus

_POINTS = 10_000
Floats = npt.NDArray[np.float64]


def _square(rng: np.random.Generator) -> Floats:
    return np.column_stack([rng.uniform(-0.7, 0.7, (_POINTS, 2)), np.zeros(_POINTS)])


def _saddle(rng: np.random.Generator) -> Floats:
    x, y = rng.uniform(-0.65, 0.65, (2, _POINTS))
    return np.column_stack([x, y, x**2 - y**2])


def _hemisphere(rng: np.random.Generator) -> Floats:
    xyz = rng.standard_normal((_POINTS, 3))
    xyz[:, 2] = np.abs(xyz[:, 2])
    return np.asarray(xyz / np.linalg.norm(xyz, axis=1, keepdims=True))


def _hills(rng: np.random.Generator) -> Floats:
    x, y = rng.uniform(-0.7, 0.7, (2, _POINTS))
    return np.column_stack([x, y, 0.2 * np.sin(4 * x) * np.cos(5 * y)])


def _slab(rng: np.random.Generator) -> Floats:
    """Two squares, nearer to each other than noise lets them be told apart."""
    return _square(rng) + np.where(rng.random(_POINTS) < 0.5, 0.07, 0.0)[:, None] * [0, 0, 1]


def _torus(_: np.random.Generator) -> Floats:
    return torus(_POINTS)


def _gaussian(rng: np.random.Generator) -> Floats:
    return rng.standard_normal((_POINTS, 3))


def _laplace(rng: np.random.Generator) -> Floats:
    return rng.laplace(scale=0.5**0.5, size=(_POINTS, 3))


def _parts(
    shape: Callable[[np.random.Generator], Floats],
    noise_std: float,
    *,
    kind: Callable[[np.random.Generator], Floats] = _gaussian,
    read: float | None = None,
) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...], list[int]]:
    """Return the parts of a shape with noise; those without this and of what is only bent; what was looked at."""
    rng = np.random.default_rng(5)
    xyz = shape(rng) + noise_std * kind(rng)
    noise_std, looked = read or noise_std, []

    def tile(some: Floats) -> Tiling:
        return Tiling(some, [np.arange(len(some))], coverage=3.0, seed=0, device="cpu")

    def look(parts: int) -> tuple[Floats, Patches]:
        looked.append(parts)
        some = xyz[tile(xyz).subsamples(parts)[0]]
        return some, tile(some).probes(24)[0]

    radii = tile(xyz).probes(24)[0].radii
    usual, bent = (parts_of(noise_std, radii, _POINTS, bent=so) for so in (False, True))
    return parts_of_object(noise_std, radii, _POINTS, look), usual, bent, looked


@pytest.mark.parametrize(
    ("shape", "noise_std"),
    [(_square, 0.03), (_saddle, 0.03), (_square, 0.04), (_saddle, 0.04), (_hemisphere, 0.04), (_hemisphere, 0.05)],
)
def test_a_sheet_is_filtered_in_more_parts(shape: Callable[[np.random.Generator], Floats], noise_std: float) -> None:
    parts, usual, bent, looked = _parts(shape, noise_std)
    assert parts == bent
    assert max(parts) > max(usual)
    assert looked[-1] == parts[0]  # as its own patches are


def test_where_layers_are_to_be_feared_a_sheet_may_bend_more_within_a_patch_of_a_part() -> None:
    assert _parts(_hills, 0.03)[0] == _parts(_hills, 0.03)[1]
    assert _parts(_hills, 0.04)[0] == _parts(_hills, 0.04)[2]


def test_as_much_noise_as_is_read_of_bodies_with_the_training_noise_does_not_excuse_what_is_off_quadrics() -> None:
    """1.35 and 1.27 noise stds off them, as a little of a head with 3 % may be that is read as 3.3 %."""
    for read, taken in ((0.037, False), (0.0395, True)):
        parts, usual, bent, _ = _parts(_square, 0.05, read=read)
        assert parts == (bent if taken else usual)
        assert usual != bent


@pytest.mark.parametrize(("shape", "noise_std"), [(_torus, 0.03), (_torus, 0.04), (_slab, 0.03), (_slab, 0.04)])
def test_a_body_and_walls_are_not(shape: Callable[[np.random.Generator], Floats], noise_std: float) -> None:
    parts, usual, bent, _ = _parts(shape, noise_std)
    assert parts == usual != bent


def test_walls_that_are_read_as_noise_are_told_by_the_kurtosis() -> None:
    """What is off a quadric is no more than the noise that was read: noise and walls together."""
    walls = _parts(_slab, 0.03, read=(0.03**2 + 0.035**2) ** 0.5)
    assert walls[0] == walls[1] != walls[2]


@pytest.mark.parametrize("shape", [_square, _slab])
def test_noise_with_long_tails_hides_walls_from_it(shape: Callable[[np.random.Generator], Floats]) -> None:
    parts, usual, bent, _ = _parts(shape, 0.03, kind=_laplace)
    assert parts == usual != bent


def test_so_much_noise_that_it_may_be_walls_is_left_to_the_usual_rule() -> None:
    parts, usual, bent, looked = _parts(_square, 0.045, read=0.056)
    assert parts == usual != bent
    assert looked == []


def test_nothing_is_looked_at_where_patches_reach_far_beside_the_noise() -> None:
    parts, _, _, looked = _parts(_square, 0.01)
    assert parts == (1,)
    assert looked == []


def off_quadric(points: Floats) -> tuple[float, float]:
    """Return the std and the kurtosis of a patch of all points off a quadric."""
    around = np.linalg.norm(points - points.mean(axis=0), axis=1)
    rows = np.argsort(around, kind="stable").astype(np.int32)[None]
    patch = Patches(rows[0, :1].astype(np.int64), rows, np.array([len(points)]), around.max(keepdims=True))
    stds, kurtoses = off_quadrics(points, patch)
    return float(stds.item()), float(kurtoses.item())


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32), st.floats(1e-3, 1e3), st.floats(-1, 1), st.floats(-1, 1), st.floats(1e-4, 0.05))
def test_off_a_quadric_is_what_noise_is(seed: int, size: float, bend: float, twist: float, noise_std: float) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1, 1, (2, 1000))
    xyz = np.column_stack([x, y, 0.2 * bend * x * x + 0.1 * twist * x * y + noise_std * rng.standard_normal(1000)])
    turn = Rotation.random(random_state=seed % 2**31).as_matrix()
    std, kurtosis = off_quadric(size * xyz @ turn.T + rng.standard_normal(3) * size)
    # Within four standard errors of either; heights over a plane that leans differ by its cosine.
    assert std / size == pytest.approx(noise_std, rel=0.12)
    assert kurtosis == pytest.approx(3, abs=0.75)


def test_points_on_a_quadric_are_not_off_it() -> None:
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 1000))
    std, kurtosis = off_quadric(np.column_stack([x, y, 0.1 * x * y]))
    assert std < 1e-4  # over the plane that fits them best, which leans a little
    assert np.isfinite(kurtosis)
    assert off_quadric(np.ones((1000, 3))) == (0.0, 0.0)
