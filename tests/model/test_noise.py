"""What is read of a cloud before a pass, by a DistanceModule that says what it is told to."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from straightpcf.model.calibration import Calibration
from straightpcf.model.noise import NoiseReader
from straightpcf.model.normalize import HIGH_NOISE, CloudFrame, patch_scales, zoom_of
from straightpcf.model.survey import survey
from straightpcf.model.tiles import Tiling
from tests.clouds import far_group, noisy, sphere, torus

_POINTS = 10_000


class Says:
    """A processor that reads a noise std of a quarter of the points, and another of all of them shown at half size."""

    def __init__(self, far: float, near: float, *, largest: float = 0.02) -> None:
        self.far, self.near, self.largest = far, near, largest  # the default calibration's
        self.asked: list[npt.NDArray[np.int64]] = []  # of which seeds' patches, each time

    def distances(self, positions: npt.NDArray[np.float64], cut: Any, scales: npt.NDArray[np.float64]) -> Any:
        self.asked.append(cut.seeds)
        noise = self.far if len(positions) < _POINTS else self.near
        return np.minimum(noise * scales / self.largest, 1.0)

    survey = staticmethod(survey)
    mapper = map


def tile(xyz: npt.NDArray[np.float64]) -> Tiling:
    return Tiling(xyz, [np.arange(len(xyz))], coverage=3.0, seed=0, device="cpu")


@pytest.mark.parametrize(
    ("far", "near", "high"), [(0.039, 0.039, True), (0.039, 0.032, False), (0.034, 0.039, False), (0.038, 0.035, True)]
)
def test_noise_is_high_where_it_is_read_so_far_around_and_near(far: float, near: float, *, high: bool) -> None:
    xyz = torus(_POINTS)
    positions = CloudFrame.of(xyz).enter(xyz)
    reader = NoiseReader(Says(far, near), Calibration(), tile, zoom=True)  # type: ignore[arg-type]
    reading = reader.read(positions, tile(positions), None)
    assert reading.noise_std == pytest.approx(far)
    assert reading.high_noise is high
    assert not reading.high_noise or reading.noise_std > HIGH_NOISE


@pytest.mark.parametrize(
    ("told", "far", "shown"),
    [(0.021, 0.029, 0.025), (0.025, 0.025, 0.025), (0.027, 0.029, 0.029)],  # where the table ends nothing is told
)
def test_an_object_is_shown_in_the_size_of_what_is_read_of_it_near_and_far_around(
    told: float, far: float, shown: float
) -> None:
    positions = torus(_POINTS)
    table = Calibration(noise=(0.0, 0.028))
    reader = NoiseReader(Says(far, told, largest=0.028), table, tile, zoom=True)  # type: ignore[arg-type]
    reading = reader.read(positions, tile(positions), None)
    assert reading.noise_std == pytest.approx(far)
    assert reading.probes is not None
    assert 1 < reading.zoom < zoom_of(0.0, reading.probes.radii)  # neither limit has a part in it
    assert reading.zoom == pytest.approx(zoom_of(shown, reading.probes.radii))


_WIDE = Calibration(noise=(0.0, 0.06))


class SaysAtMost(Says):
    """Reads the noise there is, but no more than a share of a patch's radius, as of patches that are full of it."""

    def distances(self, positions: npt.NDArray[np.float64], cut: Any, scales: npt.NDArray[np.float64]) -> Any:
        return np.minimum(self.near, 0.16 * cut.radii) * scales / _WIDE.noise[-1]


@pytest.mark.parametrize("noise", [0.025, 0.035, 0.045])
def test_of_dense_points_noise_is_read_of_parts_whose_patches_show_it_all(noise: float) -> None:
    positions = sphere(100_000)  # patches of radius 0.2
    reader = NoiseReader(SaysAtMost(noise, noise), _WIDE, tile, zoom=True)  # type: ignore[arg-type]
    reading = reader.read(positions, tile(positions), None)
    assert not reading.scene
    assert reading.noise_std == pytest.approx(noise)


class SaysWhere(Says):
    """Reads one noise std where x is above a limit, another where it is below."""

    def __init__(self, loud: float, quiet: float, limit: float) -> None:
        super().__init__(loud, quiet)
        self.limit = limit

    def distances(self, positions: npt.NDArray[np.float64], cut: Any, scales: npt.NDArray[np.float64]) -> Any:
        noise = np.where(positions[cut.seeds, 0] > self.limit, self.far, self.near)
        return np.minimum(noise * scales / _WIDE.noise[-1], 1.0)


@pytest.mark.parametrize(
    ("loud", "quiet", "limit", "count", "uneven"),
    [
        (0.024, 0.008, 0.2, 20_000, True),
        (0.024, 0.008, 0.5, 20_000, True),
        (0.008, 0.008, 0.0, 20_000, False),
        (0.024, 0.014, 0.0, 20_000, False),  # as much as walls differ from what is smooth
        (0.024, 0.008, 0.95, 20_000, False),  # hardly anywhere
        (0.009, 0.003, 0.0, 20_000, False),  # no patch is shown smaller for it
        (0.024, 0.008, 0.0, 2000, False),  # too few patches to tell
    ],
)
def test_noise_is_uneven_where_patches_differ_by_more_than_shape(
    loud: float, quiet: float, limit: float, count: int, *, uneven: bool
) -> None:
    xyz = torus(count)
    positions = CloudFrame.of(xyz).enter(xyz)
    reader = NoiseReader(SaysWhere(loud, quiet, limit), _WIDE, tile, zoom=True)  # type: ignore[arg-type]
    tiling = tile(positions)
    reading = reader.read(positions, tiling, None)
    assert reading.uneven is uneven
    (cut,) = tiling.cuts()
    zooms = np.broadcast_to(reader.zooms(positions, cut, reading), cut.seeds.shape)
    noise = np.where(positions[cut.seeds, 0] > limit, loud, quiet)
    assert (zooms <= reading.zoom).all()
    assert (zooms[noise == quiet] == reading.zoom).all()
    if uneven:
        np.testing.assert_allclose((zooms * noise)[noise == loud], min(0.03, reading.zoom * loud))
        assert not reading.known_distances  # they were shown in another size


def ring(*, towards_one_side: float = 0.0) -> npt.NDArray[np.float64]:
    """Return a thin torus of so many points that its patches are as small as a scene's; more of them on one side."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, 2 * np.pi, (2, 240_000))
    kept = rng.uniform(0, 1 + towards_one_side, len(u)) < 1 + towards_one_side * np.cos(u)
    u, v = u[kept][:100_000], v[kept][:100_000]
    across = 0.95 + 0.05 * np.cos(v)
    return np.stack([across * np.cos(u), across * np.sin(u), 0.05 * np.sin(v)], axis=1)


@pytest.mark.parametrize(
    ("noise", "towards_one_side", "scene"),
    [(0.01, 0.0, False), (0.003, 0.0, True), (0.01, 0.9, True)],  # too little for parts; denser here than there
)
def test_an_object_of_very_many_points_is_no_scene_where_its_noise_asks_for_parts(
    noise: float, towards_one_side: float, *, scene: bool
) -> None:
    xyz = ring(towards_one_side=towards_one_side)
    positions = CloudFrame.of(xyz).enter(xyz)
    reader = NoiseReader(SaysWhere(noise, noise, 0.0), _WIDE, tile, zoom=True)  # type: ignore[arg-type]
    reading = reader.read(positions, tile(positions), None)
    assert reading.scene is scene
    assert (reading.parts != (1,)) is not scene
    assert reading.noise_std == pytest.approx(noise)
    assert reader.read(positions, tile(positions), reading).scene is scene  # with less noise, too


def bent_and_flat() -> npt.NDArray[np.float64]:
    """Return a flat field beside a ball, far from the origin's other side, as a scene: noise of 0.02 across each."""
    rng = np.random.default_rng(0)
    field = np.column_stack([rng.uniform(0, 4, 20_000), rng.uniform(-4, 4, 20_000), np.zeros(20_000)])
    ball = 0.4 * sphere(4000) + [-3, 0, 0]
    return noisy(np.concatenate([field, ball, far_group(60.0)]), 0.02)


@pytest.mark.parametrize("raster", [False, True])
def test_what_is_flat_in_a_scene_is_shown_smaller_and_so_is_a_raster(*, raster: bool) -> None:
    xyz = bent_and_flat()
    frame = CloudFrame.of(xyz)
    positions, noise = frame.enter(xyz), 0.02 / frame.radius
    reader = NoiseReader(Says(noise, noise), Calibration(), tile, zoom=True)  # type: ignore[arg-type]
    (cut,) = tile(positions).cuts()
    shown = reader.of_scene(positions, cut, raster=raster)
    usual = 0.25 / cut.radii
    field = (xyz[cut.seeds, 0] > 1) & (noise * usual > 0.005)
    ball = np.linalg.norm(xyz[cut.seeds] + [3, 0, 0], axis=1) < 0.5
    assert shown.flat[field].all()
    assert not shown.flat[ball].any()
    assert (shown.scales[field] < 0.9 * usual[field]).all()
    assert ((shown.scales < 0.9 * usual)[ball] == raster).all()
    np.testing.assert_allclose(shown.noise_stds, noise)  # whatever the size in which it was read
    np.testing.assert_allclose(shown.distances, np.minimum(1, noise * shown.scales / 0.02))


@pytest.mark.parametrize("raster", [False, True])
def test_a_tree_in_a_scene_is_not_read_a_second_time(*, raster: bool) -> None:
    leaves = np.random.default_rng(1).uniform((-8.5, -0.5, -0.5), (-7.5, 0.5, 0.5), (4000, 3))
    xyz = np.concatenate([bent_and_flat(), leaves])
    frame = CloudFrame.of(xyz)
    positions = frame.enter(xyz)
    says = Says(0.02 / frame.radius, 0.02 / frame.radius)
    reader = NoiseReader(says, Calibration(), tile, zoom=True)  # type: ignore[arg-type]
    (cut,) = tile(positions).cuts()
    reader.of_scene(positions, cut, raster=raster)
    (every, again), tree = says.asked, cut.seeds[np.linalg.norm(xyz[cut.seeds] + [8, 0, 0], axis=1) < 0.9]
    assert len(tree) > 3
    assert np.isin(tree, every).all()
    assert (np.isin(tree, again) == raster).all()


def test_without_zoom_a_scenes_patches_have_the_usual_size() -> None:
    xyz = bent_and_flat()
    positions = CloudFrame.of(xyz).enter(xyz)
    reader = NoiseReader(Says(0.001, 0.001), Calibration(), tile, zoom=False)  # type: ignore[arg-type]
    (cut,) = tile(positions).cuts()
    shown = reader.of_scene(positions, cut, raster=False)
    np.testing.assert_allclose(shown.scales, patch_scales(cut.radii, scene=True))


def test_the_noise_left_in_a_scene_is_read_where_its_noise_was_read() -> None:
    xyz = bent_and_flat()
    frame = CloudFrame.of(xyz)
    says = SaysWhere(8e-4, 2e-4, (1.65 - frame.centre[0]) / frame.radius)  # of nearly half of the points it is loud
    reader = NoiseReader(says, _WIDE, tile, zoom=True)  # type: ignore[arg-type]
    positions = frame.enter(xyz)
    first = reader.read(positions, tile(positions), None)
    says.far, says.near = says.far / 2, says.near / 2
    other = Tiling(positions, [np.arange(len(xyz))], coverage=3.0, seed=2)
    assert reader.read(positions, other, first).noise_std == pytest.approx(2 * first.noise_std)  # of other patches
    assert first.probes is not None
    assert reader.noise_left(positions, first, first.probes) == pytest.approx(first.noise_std / 2)


@pytest.mark.parametrize("zoom", [True, False])
def test_without_zoom_a_raster_is_an_object_as_in_the_paper(*, zoom: bool) -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(50.0), np.arange(50.0)))
    xyz = np.column_stack([x, y, np.sin(x / 5) + np.cos(y / 7)])
    positions = CloudFrame.of(xyz).enter(xyz)
    reader = NoiseReader(Says(0.001, 0.001), Calibration(), tile, zoom=zoom)  # type: ignore[arg-type]
    reading = reader.read(positions, tile(positions), None)
    assert (reading.height_axis, reading.scene) == ((2, True) if zoom else (None, False))
