"""Clouds of several objects that lie far from each other: each is filtered as if it were alone (docs/filter.md).

A cloud's frame, its noise, its passes and the size in which its patches are shown are those of one object. Of two that
lie ten radii apart patches are as small beside the whole as a street's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label
from scipy.sparse.csgraph import connected_components

from straightpcf.model.calibration import FEWEST_POINTS
from straightpcf.model.distinct import Distinct, box_of, cell_of
from straightpcf.model.normalize import CloudFrame
from straightpcf.model.result import DenoiseResult, FinishedPatch
from straightpcf.model.run import Run
from straightpcf.points.options import DenoiseOptions

if TYPE_CHECKING:
    from straightpcf.model.filter import Filter

__all__ = ["RunOfObjects", "begin", "separate_objects"]

Floats = npt.NDArray[np.float64]

# Cells along the longest side of a cloud, the finest in which half of the points have so many others with them: in
# coarser ones what is apart touches, in finer ones a surface falls into pieces.
_CELLS, _LEAST_SHARED = (64, 32, 16, 8), 10
_MOST_PIECES = 256  # what falls into more large ones is no shelf of objects
_BLOCK = 2**16  # points whose cells are looked up at once


def separate_objects(xyz: Floats) -> list[npt.NDArray[np.int64]]:
    """Return the rows of each object among points of the unit ball (N, 3); of one where all belong together.

    Objects are what empty cells of a grid part and whose bounding spheres do not meet: legs of a chair, plates over
    each other or a street's houses are parts of one. Each is looked at again by itself. Groups of fewer than
    FEWEST_POINTS belong to the nearest object.
    """
    whole = [np.arange(len(xyz))]
    numbers = _pieces(xyz)
    if not numbers.any():  # as of nearly every cloud: spare it the sorting
        return whole
    pieces = _rows_of(numbers)
    large = [rows for rows in pieces if len(rows) >= FEWEST_POINTS]
    if not 2 <= len(large) <= _MOST_PIECES:
        return whole
    while True:
        frames = [CloudFrame.of(xyz[rows]) for rows in large]
        centres, radii = np.array([f.centre for f in frames]), np.array([f.radius for f in frames])
        apart = np.linalg.norm(centres[:, None] - centres, axis=2)
        count, joined = connected_components(apart <= radii[:, None] + radii, directed=False)
        if count == 1:
            return whole
        if count == len(large):
            break
        large = [np.concatenate([large[piece] for piece in pair]) for pair in _rows_of(joined)]
    members = [[rows] for rows in large]
    for rows in pieces:
        if len(rows) < FEWEST_POINTS:
            nearest = np.argmin(np.linalg.norm(centres - xyz[rows].mean(axis=0), axis=1) - radii)
            members[nearest].append(rows)
    parted = [np.sort(np.concatenate(of)) for of in members]
    # By itself each has finer cells, which may part it: two that lie near each other beside a third one.
    return [rows[part] for rows in parted for part in separate_objects(xyz[rows])]


def _rows_of(labels: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """Return the rows that have each label, 0 to the largest, of which all are taken."""
    return np.split(np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels))[:-1])


def _pieces(xyz: Floats) -> npt.NDArray[np.int64]:
    """Number the pieces into which empty cells part points (N, 3): (N,), all 0 where points are too few to tell."""
    low, high = box_of(xyz)
    side = float((high - low).max())
    for cells in _CELLS if side > 0 else ():
        blocks = (xyz[start : start + _BLOCK] - low for start in range(0, len(xyz), _BLOCK))
        indices = (np.minimum(block * (cells / side), cells - 1).astype(np.int64) for block in blocks)
        flat = np.concatenate([np.ravel_multi_index(tuple(index.T), (cells,) * 3) for index in indices])
        points = np.bincount(flat, minlength=cells**3)
        if np.median(points[flat]) > _LEAST_SHARED:
            numbers, _ = label(points.reshape((cells,) * 3) > 0, structure=np.ones((3, 3, 3)))
            return np.asarray(numbers.reshape(-1)[flat] - 1, dtype=np.int64)
    return np.zeros(len(xyz), dtype=np.int64)


def begin(owner: Filter, points: npt.ArrayLike, options: DenoiseOptions) -> Run | RunOfObjects:
    """Begin a cloud's way through a filter: of its one object, or of each of several.

    Raises as `Filter.denoise` does.
    """
    run = Run(owner, points, options)
    objects = _objects_of(run) if owner.zoom else []
    return RunOfObjects(run, objects) if len(objects) > 1 else run


def _objects_of(whole: Run) -> list[npt.NDArray[np.int64]]:
    """Return the rows of the cloud that each of several objects has; none where all belong together."""
    if len(whole.points.xyz) == 1:  # a frame of no size
        return []
    if whole.points.repeated and (objects := _objects_in_few_places(whole)):
        return objects
    if len(whole.points.xyz) < 2 * FEWEST_POINTS:
        return []
    objects = separate_objects(whole.frame.enter(whole.points.xyz))
    if len(objects) == 1:
        return []
    return [whole.rows[whole.points.copies(rows.astype(np.int32))] for rows in objects]


def _objects_in_few_places(whole: Run) -> list[npt.NDArray[np.int64]]:
    """Do what `_objects_of` does where the cells of the cloud, made for its size, leave an object too few places.

    Three objects of radius 1 that lie 1e5 apart have cells of 0.1 to 0.2, and in them less than 500 places each.
    """
    cloud, place = whole.xyz[whole.rows], whole.points.inverse
    objects = separate_objects(whole.frame.enter(cloud)) if len(cloud) >= 2 * FEWEST_POINTS else []
    hidden = False
    for rows in objects if len(objects) > 1 else ():
        alone = cloud[rows]
        if len(Distinct(alone).xyz) < FEWEST_POINTS:  # copies, which are no object
            return []
        hidden |= len(np.unique(place[rows])) < FEWEST_POINTS <= len(Distinct(alone, cell=cell_of(alone)).xyz)
    return [whole.rows[rows] for rows in objects] if hidden else []


class RunOfObjects:
    """Several objects of one cloud on their way through the filter, pass by pass; as `Run` for who looks on."""

    def __init__(self, whole: Run, objects: list[npt.NDArray[np.int64]]) -> None:
        """Take the cloud, not begun, and which of its rows each object has."""
        self._xyz, self._passed_through = whole.xyz, whole.passed_through()  # not what it has of the cloud as one
        self._rows = objects
        self._runs = [Run(whole.filter, whole.xyz[rows], whole.options) for rows in self._rows]

    def patches(self) -> Iterator[FinishedPatch]:
        """Run pass after pass, in each pass object after object; see `Run.patches`."""
        shares = np.array([len(rows) for rows in self._rows]) / sum(map(len, self._rows))
        progress = np.zeros(len(shares))
        passes = {number: groupby(run.patches(), lambda p: p.iteration) for number, run in enumerate(self._runs)}
        while passes:
            for number in list(passes):
                _, found = next(passes[number], (0, None))
                if found is None:
                    del passes[number]
                    progress[number] = 1.0
                    continue
                for patch in found:
                    progress[number] = patch.progress
                    done = min(1.0, float(progress @ shares))
                    yield replace(patch, indices=self._rows[number][patch.indices], progress=done)

    def result(self, seconds: float) -> DenoiseResult:
        """Put the objects back among the other rows.

        The passes and distances are those of the object that took most, the largest of such; noise is the root mean
        square over all points.
        """
        parts = [run.result(seconds) for run in self._runs]
        sizes = np.array([len(rows) for rows in self._rows])
        longest = max(range(len(parts)), key=lambda number: (parts[number].iterations, sizes[number]))
        out = self._xyz.copy()
        for rows, part in zip(self._rows, parts, strict=True):
            out[rows] = part.xyz
        before, after = (
            float(np.sqrt(np.average(np.square(noise), weights=sizes)))
            for noise in zip(*((part.noise_before, part.noise_after) for part in parts), strict=True)
        )
        said = [warning for part in parts for warning in part.warnings]
        warnings = [
            *self._passed_through,
            f"the cloud is {len(parts)} objects far from each other: each was filtered as if it were alone",
            *(f"in one of them {warning}" for warning in said),
        ]
        return DenoiseResult(
            out,
            parts[longest].iterations,
            before,
            after,
            parts[longest].distances,
            len(out) - sum(map(len, self._rows)) + sum(part.untouched for part in parts),
            seconds,
            tuple(warnings),
        )
