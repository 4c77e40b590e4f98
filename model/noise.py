"""How noisy a cloud is, read by the DistanceModule, and how the pass that comes shows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from straightpcf.model.bent import parts_of_object
from straightpcf.model.calibration import DENSE_FROM_RADII, Calibration
from straightpcf.model.low_noise import noise_on_surfaces
from straightpcf.model.normalize import (
    HIGH_NOISE,
    is_dense_object,
    is_scene,
    noise_in_radii,
    parts_of,
    patch_scales,
    zoom_of,
    zoom_of_each,
    zoom_of_flat,
    zoom_of_rest,
)
from straightpcf.model.patches import Patches
from straightpcf.model.planes import across_planes, thickness_of, thickness_ratios
from straightpcf.model.processor import Floats, Processor
from straightpcf.model.raster import height_axis
from straightpcf.model.reading import Reading, ScenePatches
from straightpcf.model.spacing import Sampling
from straightpcf.model.tiles import Tiling
from straightpcf.model.views import View

__all__ = ["NoiseReader"]

# d says no more than the largest noise of the calibration's table, and of a dense cloud it says too little before that.
# From this share of it on, noise is read again of points fewer and nearer: of patches as large, in an object made
# smaller. What is read there counts where it is above what the table knew: thin walls look like noise when small.
_REREAD_ZOOMS, _REREAD_PROBES, _REREAD_POINTS = (0.5, 0.25), 24, 2500
_REREAD_FROM, _REREAD_ABOVE = 0.4, 0.95
# A part of the points has larger patches. Noise above such a share of its patches' radii is read of more and more parts
# until it is below the other: the more the patches of dense points are full of it, the less of it d says.
_DENSE_RADII, _TOLD_RADII = 0.15, 0.12
# Where patches reach far, thin walls and bends are read as noise, so what is high there is read once more, of more of
# the points shown at half their size, in patches no larger than this.
_NEAR_RADIUS = 0.15
# Of d after a pass: below it, what still has height is walls. With more noise left (0.42) a smooth body looks so, too.
_UNCOVERED_BELOW = 0.35
# Noise, in radii of a patch, above which it is not asked: of dense points a pass leaves layers of uniform noise, and it
# joins no walls there.
_UNCOVERED_UP_TO_RADII = 0.045
# Where one patch in ten reads so many times the noise of another one in ten, noise is not the same all over an object.
_UNEVEN_RATIO, _ENOUGH_PROBES = 2.0, 10
_MOST_POINTS_SHARE = 0.8  # of a scene's points have no more noise than is believed of any: see `restraint`
# Where half of a scene's points have their nearest in a plane, no more noise is believed than twice what four fifths of
# these show.
_SEEN_SHARE, _SEEN_RATIO = 0.5, 2.0
# Of what surfaces leave of half of a scene's points: more is not believed of any place by its surfaces.
_MOST_ON_SURFACES_RATIO = 3.0
# A patch is flat where its points lie no farther from their plane than so many of its noise stds, and than such a share
# of how far they spread along it: the network sees noise in a tree, too.
_FLAT_PATCH_STDS, _FLAT_RATIO = 1.3, 0.4


class NoiseReader:
    """Reads clouds in the unit ball, (N, 3) float64, with one network on one processor."""

    def __init__(
        self,
        processor: Processor,
        calibration: Calibration,
        tile: Callable[[Floats], Tiling],
        *,
        zoom: bool,
        origin: Floats | None = None,
        device: str = "cpu",
    ) -> None:
        """tile: cuts some of the points into patches; zoom: whether the noise changes what a pass does; device: a name.

        origin: (3,), that of the cloud's own coordinates in the unit ball, where its scanner may have been.
        """
        self._processor, self._calibration, self._tile, self._zoom = processor, calibration, tile, zoom
        self._origin, self._device = origin, device
        self._largest_noise = float(calibration.noise[-1])

    def read(self, positions: Floats, tiling: Tiling, first: Reading | None, *, view: View | None = None) -> Reading:
        """Read the noise of a cloud; first: the reading before the first pass, None where this is it.

        view: the place that it was seen from, where that is known before the first pass.

        What is a scene is said once: patches shrink as the noise goes. Where the pass shows the whole cloud in another
        size than that of the reading, d is read in that size, too.
        """
        probes, numbers = tiling.probes()
        if first is None:
            axis = height_axis(positions) if self._zoom else None
            if view is None and axis is None and self._zoom:
                view = View.of(positions, probes, self._origin, self._device, mapper=self._processor.mapper)
            radii = (_quantile(probes.radii, probes.owned, share) for share in (0.1, 0.5, 0.9))
            scene = axis is not None or is_scene(*radii)
        else:
            axis, scene = first.height_axis, first.scene
        if scene:
            reading = replace(self._read_scene(positions, tiling, probes, axis, first=first is None), view=view)
            settled = first is not None or axis is not None or not self._zoom
            if settled or not is_dense_object(reading.noise_std, probes.radii, len(positions)):
                return reading
        return self._read_object(positions, tiling, probes, numbers, view, first)

    def with_walls(self, positions: Floats, reading: Reading, first: Reading) -> Reading:
        """Return the reading of what a pass has left, before another: walls that noise had hidden may show now."""
        covered = reading.distance >= _UNCOVERED_BELOW
        layered = first.parts != (1,) or first.noise_in_radii > _UNCOVERED_UP_TO_RADII
        if reading is first or reading.scene or covered or layered or reading.probes is None:
            return reading
        sampling = first.sampling.after_pass(positions, reading.probes, survey=self._processor.survey)
        return replace(reading, sampling=sampling)

    def of_scene(self, positions: Floats, cut: Patches, *, raster: bool) -> ScenePatches:
        """Look at patches of a scene: each has the usual size, and what is flat but for its noise a smaller one.

        So has every one of a raster, whose noise is in its heights alone.
        """
        scales = patch_scales(cut.radii, scene=True)
        distances = usual = self._processor.distances(positions, cut, scales)
        noise = self.noise_stds(distances, scales)
        thickness, width = np.array([thickness_of(positions[rows]) for rows in cut.index]).T
        thin = thickness < _FLAT_RATIO * width
        zoom = zoom_of_flat(noise * scales) if self._zoom else np.ones(len(scales))
        if (smaller := (zoom < 1) & (thin | raster)).any():
            zoomed = (zoom * scales)[smaller]
            read = self._processor.distances(positions, cut[smaller], zoomed)
            of_zoomed = self.noise_stds(read, zoomed)
            shown = raster | (thickness[smaller] < _FLAT_PATCH_STDS * of_zoomed)
            rows, distances = np.flatnonzero(smaller)[shown], usual.copy()
            scales[rows], distances[rows], noise[rows] = zoomed[shown], read[shown], of_zoomed[shown]
        return ScenePatches(usual, scales, distances, noise, thin & (thickness < _FLAT_PATCH_STDS * noise))

    def zooms(self, positions: Floats, cut: Patches, reading: Reading) -> Floats | float:
        """Return the factor by which a pass shows its patches larger: of each, (M,), or of all."""
        if not reading.uneven:
            return reading.zoom
        scales = patch_scales(cut.radii, scene=False)
        return zoom_of_each(self.noise_stds(self._processor.distances(positions, cut, scales), scales), reading.zoom)

    def noise_stds(self, distances: Floats, scales: Floats) -> Floats:
        """Return the noise std of patches shown at some scales, (M,), by what the DistanceModule says of them, (M,)."""
        return self._calibration.noise_std(distances) / scales

    def _read_object(
        self,
        positions: Floats,
        tiling: Tiling,
        probes: Patches,
        numbers: range,
        view: View | None,
        first: Reading | None,
    ) -> Reading:
        """Read the noise of an object; numbers: which patches of a whole cut the probes are, none of a tiled one."""
        scales = patch_scales(probes.radii, scene=False)
        distances = self._processor.distances(positions, probes, scales)
        if first is None:
            reading = self._first_of_object(positions, tiling, probes, view, distances, scales)
        else:
            reading = self._next_of_object(positions, tiling, probes, distances, scales, first)
        if reading.uneven or reading.parts != (1,):  # patches are shown in other sizes, or are others
            return reading
        if reading.zoom != 1.0:
            scales = patch_scales(probes.radii, scene=False, zoom=reading.zoom)
            distances = self._processor.distances(positions, probes, scales)
        return replace(reading, known_distances=dict(zip(numbers, distances.tolist(), strict=False)))

    def _first_of_object(
        self, positions: Floats, tiling: Tiling, probes: Patches, view: View | None, distances: Floats, scales: Floats
    ) -> Reading:
        """Say how the first pass shows an object; distances: what the DistanceModule says of its probes, (M,)."""
        noise = self._noise_std(distances, scales)
        sampling = Sampling.of(positions, probes, noise, survey=self._processor.survey)
        sampling = sampling if view is None else replace(sampling, irregular=True)
        in_radii = noise_in_radii(noise, probes.radii)
        distance = float(np.median(distances))
        reading = Reading(distance, noise, False, sampling, noise_in_radii=in_radii, view=view, probes=probes)
        if not self._zoom:
            return reading
        told = self._reread_dense(positions, tiling, noise, in_radii)
        noise = self._reread(positions, tiling, told)
        # Far around bends and walls are read as noise, too: shown as small as that asks for, they are lost. A first
        # reading at the end of the table says nothing of how much there is.
        shown = noise if told >= _REREAD_ABOVE * self._largest_noise else (told + noise) / 2
        # What lies along beams alone is shown as it is: larger, walls of it become two.
        zoom, radius = 1.0 if view else zoom_of(shown, probes.radii), float(np.median(probes.radii))
        return replace(
            reading,
            noise_std=noise,
            zoom=zoom,
            parts=parts_of_object(noise, probes.radii, len(positions), partial(self._part, positions, tiling)),
            high_noise=noise > HIGH_NOISE and self._has_high_noise(positions, tiling, noise, radius),
            uneven=_is_uneven(self.noise_stds(distances, scales), zoom),
        )

    def _next_of_object(
        self, positions: Floats, tiling: Tiling, probes: Patches, distances: Floats, scales: Floats, first: Reading
    ) -> Reading:
        """Say how a later pass shows an object; distances: as of `_first_of_object`."""
        noise, zoom, thickness = self._noise_std(distances, scales), 1.0, 0.0
        if first.noise_in_radii > DENSE_FROM_RADII:
            thicknesses = self._processor.survey(positions, probes, thickness_ratios)
            thickness = float(np.median(np.concatenate(list(thicknesses))))
        if self._zoom and first.high_noise and noise > _REREAD_FROM * self._largest_noise:
            zoom = zoom_of_rest(noise, self._read_at_zoom(positions, tiling, _REREAD_ZOOMS[0]))
        distance = float(np.median(distances))
        return Reading(distance, noise, False, first.sampling, zoom, probes=probes, thickness=thickness)

    def _reread_dense(self, positions: Floats, tiling: Tiling, noise: float, in_radii: float) -> float:
        """Return the noise of an object where it is so large in its patches' radii that they do not show all of it."""
        parts, limit = 2, _DENSE_RADII
        while in_radii > limit and len(positions) >= parts * _REREAD_POINTS:
            some, probes = self._part(positions, tiling, parts)
            noise = max(noise, self._read_part_at_zoom(some, probes, 1.0))
            in_radii, parts, limit = noise_in_radii(noise, probes.radii), 2 * parts, _TOLD_RADII
        return noise

    def _reread(self, positions: Floats, tiling: Tiling, noise: float) -> float:
        """Return the noise of an object where it may be more than the table knows."""
        most, enough = self._largest_noise, _REREAD_FROM
        for zoom in _REREAD_ZOOMS:
            if noise < enough * most:
                break
            again = self._read_at_zoom(positions, tiling, zoom)
            if again < _REREAD_ABOVE * most:
                break
            noise, most, enough = again, self._largest_noise / zoom, _REREAD_ABOVE
        return noise

    def _read_scene(
        self, positions: Floats, tiling: Tiling, probes: Patches, axis: int | None, *, first: bool
    ) -> Reading:
        """Read the noise std of half of a scene's points and of most, and in how many parts the pass filters it."""
        raster = axis is not None
        shown = self.of_scene(positions, probes, raster=raster)
        parts: tuple[int, ...] = (1,)
        most_on_surfaces = np.inf
        noise, noise_of_most = self._noise_of_scene(shown, probes)
        if not np.isfinite(noise_of_most) and first and self._zoom:
            noise, noise_of_most = self._reread_scene(positions, tiling, noise, raster=raster)
            parts = parts_of(noise, probes.radii, len(positions))
        if first and self._zoom and not raster:
            noise_of_most = min(noise_of_most, self._most_seen(positions, probes))
            most_on_surfaces = self._most_on_surfaces(positions, probes)
        distance = float(np.median(shown.usual_distances))
        return Reading(
            distance,
            noise,
            True,
            Sampling(irregular=True),
            parts=parts,
            noise_of_most=noise_of_most,
            most_on_surfaces=most_on_surfaces,
            height_axis=axis,
            probes=probes,
        )

    def _most_seen(self, positions: Floats, probes: Patches) -> float:
        """Return how much noise a scene may have by its planes, infinite where it shows few.

        In trees the DistanceModule reads noise, and more of it than the ground has; planes of a few points do not.
        """
        stds, are_planes = map(
            np.concatenate, zip(*self._processor.survey(positions, probes, across_planes), strict=True)
        )
        if are_planes.mean() < _SEEN_SHARE:
            return np.inf
        return _SEEN_RATIO * float(np.quantile(stds[are_planes], _MOST_POINTS_SHARE))

    def _most_on_surfaces(self, positions: Floats, probes: Patches) -> float:
        """Return how much noise is believed of any place of a scene by the few neighbours of points."""
        stds = np.concatenate(list(self._processor.survey(positions, probes, noise_on_surfaces)))
        return _MOST_ON_SURFACES_RATIO * _quantile(stds, probes.owned, 0.5)

    def noise_left(self, positions: Floats, first: Reading, probes: Patches) -> float:
        """Return the noise std of half of a scene's points after all passes, where it was read before: in `probes`.

        A pass cuts other patches, and a scene's noise is not the same all over: of few of them half of its points may
        seem to have more noise than before.
        """
        offsets = positions[probes.index] - positions[probes.seeds, None]
        moved = replace(probes, radii=np.linalg.norm(offsets, axis=2).max(axis=1))
        noise, _ = self._noise_of_scene(self.of_scene(positions, moved, raster=first.height_axis is not None), moved)
        return noise

    def _noise_of_scene(self, shown: ScenePatches, probes: Patches) -> tuple[float, float]:
        """Return the noise std of half of a scene's points and of most: infinite where that is beyond the table."""
        noise, noise_of_most = (_quantile(shown.noise_stds, probes.owned, share) for share in (0.5, _MOST_POINTS_SHARE))
        as_shown = _quantile(shown.noise_stds * shown.scales, probes.owned, _MOST_POINTS_SHARE)
        return noise, np.inf if as_shown >= _REREAD_ABOVE * self._largest_noise else noise_of_most

    def _reread_scene(self, positions: Floats, tiling: Tiling, noise: float, *, raster: bool) -> tuple[float, float]:
        """Do what `_noise_of_scene` does where it is more than the table knows: of a quarter of the points, or less."""
        noise_of_most = np.inf
        for zoom in _REREAD_ZOOMS:
            some, probes = self._part(positions, tiling, _parts(positions, zoom))
            again, noise_of_most = self._noise_of_scene(self.of_scene(some, probes, raster=raster), probes)
            noise = max(noise, again)
            if np.isfinite(noise_of_most):
                break
        return noise, max(noise, noise_of_most)

    def _has_high_noise(self, positions: Floats, tiling: Tiling, noise: float, radius: float) -> bool:
        """Say whether an object with patches of a radius, whose noise was read far around, has that much."""
        zoom = _REREAD_ZOOMS[0]
        thinned = max(zoom, radius * zoom / _NEAR_RADIUS)
        if _parts(positions, thinned) == _parts(positions, zoom):  # what was read reaches no farther
            return True
        near = self._read_part_at_zoom(*self._part(positions, tiling, _parts(positions, thinned)), zoom)
        return (noise + near) / 2 > HIGH_NOISE

    def _part(self, positions: Floats, tiling: Tiling, parts: int) -> tuple[Floats, Patches]:
        """Return one of so many parts of the points, and some of its patches."""
        some = positions[tiling.subsamples(parts)[0]] if parts > 1 else positions
        return some, (self._tile(some) if parts > 1 else tiling).probes(_REREAD_PROBES)[0]

    def _read_at_zoom(self, positions: Floats, tiling: Tiling, zoom: float) -> float:
        """Read the noise of an object shown smaller, of so few of its points that patches are as large as before."""
        return self._read_part_at_zoom(*self._part(positions, tiling, _parts(positions, zoom)), zoom)

    def _read_part_at_zoom(self, some: Floats, probes: Patches, zoom: float) -> float:
        """Read the noise of some points of an object shown smaller."""
        scales = patch_scales(probes.radii, scene=False, zoom=zoom)
        return self._noise_std(self._processor.distances(some, probes, scales), scales)

    def _noise_std(self, distances: Floats, scales: Floats) -> float:
        return float(np.median(self.noise_stds(distances, scales)))


def _is_uneven(noise_stds: Floats, zoom: float) -> bool:
    """Say of the noise stds of some patches whether noise, not only shape, differs, and some must be shown smaller."""
    low, high = np.quantile(noise_stds, (0.1, 0.9))
    uneven = high > _UNEVEN_RATIO * low and zoom_of_each(high, zoom) < zoom
    return bool(uneven) and len(noise_stds) >= _ENOUGH_PROBES


def _parts(positions: Floats, zoom: float) -> int:
    """Return of how many parts one, shown zoom times its size, has patches as large as all points; none too few."""
    return max(1, min(round(1 / zoom**2), len(positions) // _REREAD_POINTS))


def _quantile(values: Floats, owned: npt.NDArray[np.int64], share: float) -> float:
    """Return what a share of the points has, or less: values (M,) of patches that own (M,) points; none own any: even.

    Patches lie evenly in space, points do not: a LiDAR frame's few far ones have most of the patches.
    """
    order = np.argsort(values)
    below = np.cumsum(owned[order] if owned.any() else np.ones(len(order)))
    return float(values[order][np.searchsorted(below, share * below[-1])])
