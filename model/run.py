"""One cloud on its way through the filter, pass after pass, and what comes of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from straightpcf.model.calibration import FEWEST_POINTS
from straightpcf.model.coherence import share_of_noise, summed_coherence
from straightpcf.model.cpus import use_one_thread_if_forked
from straightpcf.model.distinct import Distinct, cell_of
from straightpcf.model.layers import Layers
from straightpcf.model.neighbourhoods import INNER_SHARE
from straightpcf.model.noise import NoiseReader
from straightpcf.model.normalize import CloudFrame, patch_scales
from straightpcf.model.outliers import FAR_OUT, NEIGHBOURS, far_out, isolated, without_data
from straightpcf.model.patches import Patches
from straightpcf.model.reading import Reading
from straightpcf.model.restraint import restrained_step, trusted_noise_stds
from straightpcf.model.result import DenoiseResult, FinishedPatch
from straightpcf.model.spread import ROUNDS
from straightpcf.model.tiles import Tiling, split
from straightpcf.model.voxels import are_steps, edge_of_voxels, within_voxels
from straightpcf.points.cloud import as_positions
from straightpcf.points.errors import TooFewPoints
from straightpcf.points.options import DenoiseOptions

if TYPE_CHECKING:
    from straightpcf.model.filter import Filter

__all__ = ["MIN_POINTS", "Run"]

MIN_POINTS = 33  # a point and the 32 neighbours of its graph: the smallest patch
_COHERENCE_PROBES = 8  # patches of an object whose step is looked at
_PASSES_OF_LAYERS = 3  # `auto` makes of points in layers at least
_LITTLE_LEFT = 0.25  # d before a later pass of a scene, below which what lies in no surface takes no part in it
_PASSES_OF_SCENES = 3  # up to which `auto` asks whether what a scene's next pass takes is noise
_FEWEST_APART = 100  # points among which one may lie apart
_SPREAD_LIMIT = 0.5  # of the noise at the start, the farthest that a point goes along the surface between two passes
_HEARD, _MOVED = 7, 13  # what a pass takes until all patches have been heard, and from there on, in parts of its time
_Step = tuple[
    npt.NDArray[np.int32], npt.NDArray[np.float64], bool
]  # rows, how far they go, whether they were held back
_NOTHING: _Step = (np.empty(0, dtype=np.int32), np.empty((0, 3)), False)


@dataclass(frozen=True)
class _Shown:
    """Patches as a pass shows them.

    scales: (M,); known: d, of some of them by number; trusted_noise: the noise that is believed of each of a scene's,
    (M,), None of an object.
    """

    cut: Patches
    scales: npt.NDArray[np.float64]
    known: Mapping[int, float]
    trusted_noise: npt.NDArray[np.float64] | None


class Run:
    """One cloud on its way through the filter."""

    def __init__(self, owner: Filter, points: npt.ArrayLike, options: DenoiseOptions) -> None:
        use_one_thread_if_forked()
        xyz = as_positions(points).astype(np.float64, copy=False)
        self.filter, self.options, self.xyz = owner, options, xyz
        self.rows = np.flatnonzero(np.isfinite(xyz).all(axis=1))
        self.not_finite = len(xyz) - len(self.rows)
        self.rows = self.rows[~far_out(self._of_rows())]
        self.far_out_count = len(xyz) - self.not_finite - len(self.rows)
        self._first: Tiling | None = None  # of the points as they came
        self._take()
        self.without_data_count = self._set_aside(without_data(self.points.xyz, np.bincount(self.points.inverse)))
        self.apart_count = self._set_aside(self._apart())
        self.moved = np.zeros_like(self.points.xyz)  # in the unit-ball frame
        self.held_back = np.zeros(len(self.moved), dtype=bool)
        self.steps = ""  # what is said of points that are steps, and were moved to anywhere in these
        self.layers: Layers | None = None  # that the points lie in, as a depth camera's
        self.readings: list[Reading] = []  # before each pass, and after the last
        self.iterations, self._progress, self._rounds = 0, 0.0, ROUNDS  # of spreading, before all passes but the first
        self.noise_after = 0.0  # of what comes out, in the unit-ball frame
        origin = -self.frame.centre / (self.frame.radius or np.inf)  # nobody asks for that of one place
        self.reader = NoiseReader(
            owner.processor, owner.calibration, self._tiling, zoom=owner.zoom, origin=origin, device=owner.device
        )

    def _of_rows(self) -> npt.NDArray[np.float64]:
        """Return the rows that are filtered, without a copy where they are all."""
        return self.xyz if len(self.rows) == len(self.xyz) else self.xyz[self.rows]

    def _set_aside(self, places: npt.NDArray[np.bool_]) -> int:
        """Leave out the rows in some of the places, (U,); return how many these are."""
        if not places.any():
            return 0
        before, self._first = len(self.rows), None
        self.rows = self.rows[~places[self.points.inverse]]
        self._take()
        return before - len(self.rows)

    def _take(self) -> None:
        if len(self.rows) < MIN_POINTS:
            without_data = len(self.xyz) - self.not_finite - self.far_out_count - len(self.rows)
            others = f"{self.not_finite} not finite, {self.far_out_count} far out, {without_data} no data"
            raise TooFewPoints(f"{len(self.rows)} points to filter ({others}); at least {MIN_POINTS}")
        cloud = self._of_rows()
        self.frame = CloudFrame.of(cloud)
        self.points = Distinct(cloud, cell=cell_of(cloud))

    def _apart(self) -> npt.NDArray[np.bool_]:
        """Say which places lie apart from all others; where a cloud is too large to be looked at as one, none."""
        if self.frame.radius == 0.0 or not _FEWEST_APART <= len(self.points.xyz) <= self.filter.tile_points:
            return np.zeros(len(self.points.xyz), dtype=bool)
        positions = self.frame.enter(self.points.xyz)
        self._first = self._tiling(positions)
        self._first.expect_parts()
        spacings = self.filter.processor.spacings(positions, self._first, NEIGHBOURS)
        return isolated(positions, workers=self.filter.threads, spacings=spacings)

    def patches(self) -> Iterator[FinishedPatch]:
        """Run pass after pass; none where there is nothing to tell noise from."""
        if len(self.points.xyz) < MIN_POINTS:
            return
        planned = None if self.options.iterations == "auto" else self.options.iterations
        tiles = split(self.points.xyz, self.filter.tile_points)
        tiling: Tiling | None = None
        while True:
            positions = self.frame.enter(self.points.xyz)
            positions += self.moved
            spread_step = self._spread_step(positions, tiling, planned)
            positions += spread_step
            tiling, self._first = self._first or self._tiling(positions, tiles), None
            reading = self.reader.read(positions, tiling, self.readings[0] if self.readings else None)
            if not self.readings and (within := self._within_steps(positions, reading)) is not None:
                self.moved += within
                positions += within
                tiling = self._tiling(positions, tiles)
                reading = self.reader.read(positions, tiling, None, view=reading.view)
            self.readings.append(reading)
            left = self._passes_left(planned, positions)
            if left == 0:
                self.noise_after = self._noise_left(tiles)
                return
            if self.layers is None or not self.layers.wide:  # a pass leaves layers of them that look like walls
                self.readings[-1] = self.reader.with_walls(positions, reading, self.readings[0])
            self.iterations += 1
            self.moved += spread_step
            yield from self._pass(positions, tiling, left)

    def _within_steps(self, positions: npt.NDArray[np.float64], reading: Reading) -> npt.NDArray[np.float64] | None:
        """Return how far points go, (N, 3), to anywhere in their steps: a bent object's voxels, or wide layers."""
        if not self.filter.zoom or reading.probes is None:
            return None
        if edge := 0.0 if reading.scene else edge_of_voxels(self.points.xyz) / self.frame.radius:
            if not are_steps(edge, reading.noise_std):
                return None
            self.steps = "the points are voxels: each was taken to be anywhere in its cell"
            return within_voxels(len(positions), edge, self.options.seed)
        how = {"raster": reading.height_axis is not None, "in_lines": reading.sampling.in_lines}
        self.layers = layers = Layers.of(positions, reading.probes, **how, survey=self.filter.processor.survey)
        if layers is None or not layers.wide:
            return None
        self.steps = f"the points lie in layers along {'xyz'[layers.axis]}: each was taken to be anywhere in its own"
        return layers.anywhere_within(self.options.seed)

    def result(self, seconds: float) -> DenoiseResult:
        """Put the moved rows back among the others."""
        out = self.xyz.copy()
        if self.iterations:  # else even the sign of a zero stays
            out[self.rows] += self.options.strength * self.frame.radius * self.moved[self.points.inverse]
        untouched = len(out) - len(self.rows)
        warnings = self.passed_through()
        if held_back := np.count_nonzero(self.held_back[self.points.inverse]):
            warnings.append(f"{held_back} points are on walls closer together than points are, and were held back")
        if self.steps:
            warnings.append(self.steps)
        found = len(self.points.xyz)
        counted = f"{found} points" if found == len(self.rows) else f"all points lie in {found} places"
        if self.frame.radius == 0.0:
            warnings.append("all points coincide: nothing to filter")
        elif found < MIN_POINTS:
            warnings.append(f"{counted}: nothing is filtered where they are fewer than {MIN_POINTS}")
        elif found < FEWEST_POINTS:
            warnings.append(f"{counted}: of fewer than {FEWEST_POINTS}, shape may be taken for noise")
        before = self.frame.radius * (self.readings[0].noise_std if self.readings else 0.0)
        after = self.frame.radius * self.noise_after
        return DenoiseResult(out, self.iterations, before, after, self.distances, untouched, seconds, tuple(warnings))

    def passed_through(self) -> list[str]:
        """Return what is said of rows that are not filtered."""
        said = [f"{self.not_finite} points are not finite and were passed through"] if self.not_finite else []
        if self.far_out_count:
            farther = f"more than {FAR_OUT:.0e} times as far out as half of the others"
            said.append(f"{self.far_out_count} points are {farther} and were passed through")
        if self.without_data_count:
            said.append(f'{self.without_data_count} points are in a place that means "no data" and were passed through')
        if self.apart_count:
            said.append(f"{self.apart_count} points lie apart from all others and were passed through")
        return said

    def _noise_left(self, tiles: list[npt.NDArray[np.int64]]) -> float:
        """Return the noise std of what comes out: of a scene, and of points that go a part of their way, read anew."""
        first, strength = self.readings[0], self.options.strength
        if strength == 0.0 or (strength == 1.0 and not first.scene):
            return (self.readings[-1] if strength else first).noise_std
        positions = self.frame.enter(self.points.xyz) + strength * self.moved
        if first.scene and first.probes is not None:
            return self.reader.noise_left(positions, first, first.probes)
        return self.reader.read(positions, self._tiling(positions, tiles), first).noise_std

    @property
    def distances(self) -> tuple[float, ...]:
        """The DistanceModule's median before each pass and after the last."""
        return tuple(reading.distance for reading in self.readings)

    def _passes_left(self, planned: int | None, positions: npt.NDArray[np.float64]) -> int:
        if planned is not None:
            return planned - self.iterations
        first, calibration, points = self.readings[0], self.filter.calibration, len(positions)
        object_ = not (first.scene or first.sampling.of_place or self.layers)
        asked = object_ and calibration.asks_for_shape(self.distances, points)
        left = (calibration.of_scenes() if first.scene else calibration).passes_left(
            self.distances,
            first.noise_in_radii,
            points=points,
            irregular=first.sampling.irregular,
            thin_walls=first.sampling.thin_walls,
            shown_walls=self._rounds > ROUNDS,
            thicknesses=[reading.thickness for reading in self.readings],
        )
        if first.scene and first.height_axis is None and self.filter.zoom:
            left = self._passes_left_of_scene(left, positions)
        elif asked and (sums := self._sums_of_next(positions)) is not None:
            products, _, moved = sums
            left = calibration.passes_by_shape(left, products / max(moved, 1e-300))
        return max(left, _PASSES_OF_LAYERS - self.iterations) if self.layers else left

    def _passes_left_of_scene(self, left: int, positions: npt.NDArray[np.float64]) -> int:
        """Return `left`, or one more where that pass's step is noise's; 2 where that is not known yet."""
        most = _PASSES_OF_SCENES - self.iterations
        if most <= 0 or left > 1 or (left == 1 and most == 1):
            return left
        if left == 1 or self.iterations == 0:
            return 2
        sums = self._sums_of_next(positions)
        return left if sums is None else self.filter.calibration.passes_of_scene_by_coherence(sums[0] / sums[1])

    def _sums_of_next(self, positions: npt.NDArray[np.float64]) -> tuple[float, float, float] | None:
        """Return the `summed_coherence` of the next pass's step, of a few patches; None where they do not say."""
        reading = self.readings[-1]
        if reading.probes is None:
            return None
        if reading.scene:
            shown = self._shown(positions, reading.probes, reading)
        else:
            some = slice(None, None, max(1, len(reading.probes.seeds) // _COHERENCE_PROBES))
            known = dict(enumerate(list(reading.known_distances.values())[some]))
            cut = reading.probes[some]
            shown = _Shown(cut, patch_scales(cut.radii, scene=False), known, None)
        if not shown.cut.owned.any():  # as of a tiled cloud's probes
            inner = np.full(len(shown.cut.seeds), round(INNER_SHARE * shown.cut.index.shape[1]))
            shown = replace(shown, cut=replace(shown.cut, owned=inner))

        def summed(patch: int, displacement: npt.NDArray[np.float64]) -> tuple[float, float, float]:
            owned, step, _ = self._restrained_step(positions, shown, reading, patch, displacement)
            around = positions.take(shown.cut.index[patch], axis=0)
            return summed_coherence(step, self.moved[owned], positions[owned], around)

        found = self.filter.processor.displacements(
            positions, shown.cut, shown.scales, shown.known, summed, agree=False
        )
        products, squares, moved = np.sum([sums for sums in found if sums is not None], axis=0).tolist()
        return (products, squares, moved) if squares > 0 else None

    def _spread_step(
        self, positions: npt.NDArray[np.float64], tiling: Tiling | None, planned: int | None
    ) -> npt.NDArray[np.float64] | float:
        """Return how points go along the surface before the pass that comes, (N, 3); tiling: the last pass's.

        Not before the first, nor where chance laid them, or a scanner: scan lines are no clumps. d is read of the
        points so spread, also where no pass comes after.
        """
        if tiling is None or not self.filter.even or self.iterations == planned or self.readings[-1].sampling.irregular:
            return 0.0
        first, processor = self.readings[0], self.filter.processor
        noise = min(first.noise_std, first.sampling.noise_of_most)
        if self.iterations == 1 and first.probes is not None:
            self._rounds = first.sampling.spread_rounds(positions, first.probes, noise, survey=processor.survey)
        return processor.spread(positions, tiling, _SPREAD_LIMIT * noise, self._rounds)

    def _pass(self, positions: npt.NDArray[np.float64], tiling: Tiling, left: int) -> Iterator[FinishedPatch]:
        begun_at, share = self._progress, (1 - self._progress) / left  # so it never falls, however many come after all
        reading = self.readings[-1]
        heard, done, whole = 0, 0, len(reading.parts) * len(positions)  # points
        steps = [np.zeros_like(positions) for _ in reading.parts[1:]]  # all but the last, which is settled as it comes
        # The patches are cut from `positions`, so results may be written into self.moved as they come.
        for number, cut in self._cuts(positions, tiling, reading.parts):
            shown = self._shown(positions, cut, reading)
            finish = partial(self._step, positions, shown, reading)
            agree = self.filter.agree and len(cut.seeds) > 1
            unheard = iter(cut.owned.tolist())
            steps_made = self.filter.processor.displacements(
                positions, cut, shown.scales, shown.known, finish, agree=agree
            )
            for made in steps_made:
                owned, step, held_back = made or _NOTHING
                self.held_back[owned] |= held_back
                done += len(owned)
                if made is None or not agree:
                    heard += next(unheard)
                if number < len(steps):
                    steps[number][owned], owned = step, owned[:0]
                else:
                    self.moved[owned] += np.mean([step, *(other[owned] for other in steps)], axis=0)
                copies = self.points.copies(owned)
                indices = self.rows[copies]
                moved = self.moved[self.points.inverse[copies]]
                xyz = self.xyz[indices] + self.options.strength * self.frame.radius * moved
                self._progress = begun_at + (_HEARD * heard + _MOVED * done) / ((_HEARD + _MOVED) * whole) * share
                yield FinishedPatch(indices, xyz, self.iterations, left == 1, self._progress)

    def _shown(self, positions: npt.NDArray[np.float64], cut: Patches, reading: Reading) -> _Shown:
        """Say how a pass shows patches."""
        if not (reading.scene and self.filter.zoom):
            zoom = self.reader.zooms(positions, cut, reading)
            return _Shown(cut, patch_scales(cut.radii, scene=reading.scene, zoom=zoom), reading.known_distances, None)
        shown = self.reader.of_scene(positions, cut, raster=reading.height_axis is not None)
        trusted_noise = trusted_noise_stds(shown.noise_stds, shown.flat, self.readings[0].noise_of_most)
        return _Shown(cut, shown.scales, dict(enumerate(shown.distances.tolist())), trusted_noise)

    def _step(
        self,
        positions: npt.NDArray[np.float64],
        shown: _Shown,
        reading: Reading,
        patch: int,
        displacement: npt.NDArray[np.float64],
    ) -> _Step:
        """Do what `_restrained_step` does, and leave out what a scene's later passes would take of its shape."""
        owned, step, held_back = self._restrained_step(positions, shown, reading, patch, displacement)
        along_known_way = reading.height_axis is not None or self.readings[0].view is not None
        later = self.iterations > 1 and reading.distance < _LITTLE_LEFT
        if later and shown.trusted_noise is not None and not along_known_way:
            step *= share_of_noise(step, positions[owned], positions.take(shown.cut.index[patch], axis=0))[:, None]
        return owned, step, held_back

    def _restrained_step(
        self,
        positions: npt.NDArray[np.float64],
        shown: _Shown,
        reading: Reading,
        patch: int,
        displacement: npt.NDArray[np.float64],
    ) -> _Step:
        """Return the points that a patch owns, their step, and whether it was held back; on any thread."""
        owned, step = shown.cut.owned_points(patch), displacement / shown.scales[patch]
        if not self.filter.zoom or not (reading.scene or reading.sampling.restrains):
            return owned, step, False
        trusted = reading.sampling.noise_of_place if shown.trusted_noise is None else shown.trusted_noise[patch]
        moved, around = self.moved[owned], positions.take(shown.cut.index[patch], axis=0)
        step, held_back = restrained_step(
            step,
            moved,
            around,
            sampling=reading.sampling,
            trusted_noise=trusted,
            most_on_surfaces=self.readings[0].most_on_surfaces,
            height_axis=reading.height_axis,
            view=self.readings[0].view,
            noise_std=self.readings[0].noise_std,
        )
        return owned, step, held_back

    def _cuts(
        self, positions: npt.NDArray[np.float64], tiling: Tiling, parts: tuple[int, ...]
    ) -> Iterator[tuple[int, Patches]]:
        """Cut a pass once for each of some numbers of parts: the whole cloud, or part after part."""
        for number, count in enumerate(parts):
            if count == 1:
                yield from ((number, cut) for cut in tiling.cuts())
                continue
            for rows in tiling.subsamples(count):
                yield from ((number, cut.of_rows(rows)) for cut in self._tiling(positions[rows]).cuts())

    def _tiling(self, xyz: npt.NDArray[np.float64], tiles: list[npt.NDArray[np.int64]] | None = None) -> Tiling:
        owner = self.filter
        tiles = tiles or split(xyz, owner.tile_points)
        return Tiling(
            xyz,
            tiles,
            coverage=owner.coverage,
            seed=self.options.seed,
            device=owner.device,
            workers=owner.threads,
        )
