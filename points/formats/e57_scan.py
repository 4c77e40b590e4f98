"""One scan of an E57 file: where its pose puts its points, and what is to be written where they move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from straightpcf.points.cloud import NORMALS
from straightpcf.points.errors import MalformedFile, UnsupportedCloud
from straightpcf.points.formats.colours import RGB
from straightpcf.points.formats.e57_file import E57File, E57Points, child, number
from straightpcf.points.formats.e57_write import ChangedPoints

__all__ = ["CALLED", "CARTESIAN", "NORMAL", "SPHERICAL", "STATES", "Columns", "E57Scan"]

Columns = dict[str, npt.NDArray[Any]]
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
STATES = ("cartesianInvalidState", "sphericalInvalidState")  # 0: valid; 1: a direction alone; 2: nothing
NORMAL = ("normalX", "normalY", "normalZ")  # of the extension for surface normals
# As other formats call what E57 has a name of its own for.
CALLED = dict(zip(("colorRed", "colorGreen", "colorBlue", *NORMAL), (*RGB, *NORMALS[0]), strict=True))


@dataclass(frozen=True)
class E57Scan:
    """Say where `size` points of a cloud are in a file: in `rows` (size,) of a scan; None: they are all it has."""

    element: ElementTree.Element
    points: E57Points
    rows: npt.NDArray[np.int64] | None
    size: int

    @classmethod
    def read(cls, file: E57File, element: ElementTree.Element, points: E57Points) -> tuple[E57Scan, Columns]:
        """Return a scan and its columns (size,) of what is a point, places and normals in the file's frame."""
        columns, rows = _placed(points.read(file), element)
        return cls(element, points, rows, len(columns[CARTESIAN[0]])), columns

    def change(
        self,
        file: E57File,
        new: npt.NDArray[np.float64],
        old: npt.NDArray[np.float64],
        changed: npt.NDArray[np.bool_],
    ) -> ChangedPoints:
        """Return what is to be written anew of a scan of which the numbers of `changed`, shaped as `new`, are others.

        new, old: (size, 3) places in the file's frame, or (size, 6), with normals, where these are new, too.
        """
        rotation, _ = _pose(self.element)
        local, picked = self._in_own_frame(new[:, :3]), np.flatnonzero(changed[:, :3].any(axis=1))
        rows = self._rows_of(picked)
        names = {field.name for field in self.points.fields}
        found: list[tuple[tuple[str, ...], npt.NDArray[np.int64], npt.NDArray[np.float64]]] = []
        if names.issuperset(CARTESIAN):
            found.append((CARTESIAN, rows, local[picked]))
        if names.issuperset(SPHERICAL):
            azimuths = self.points.read(file, only=SPHERICAL[1:2])[SPHERICAL[1]][rows]
            found.append((SPHERICAL, rows, _as_spherical(local[picked], azimuths)))
        if new.shape[1] > 3:
            turned = np.flatnonzero(changed[:, 3:].any(axis=1))
            found.append((NORMAL, self._rows_of(turned), new[turned, 3:] @ rotation))
        values = {
            name: (at, column) for called, at, table in found for name, column in zip(called, table.T, strict=True)
        }
        return ChangedPoints(self.points, values, self._bounds(new[:, :3], local, old[:, :3]))

    def _rows_of(self, points: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        return points if self.rows is None else self.rows[points]

    def _in_own_frame(self, xyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        rotation, translation = _pose(self.element)
        return (xyz - translation) @ rotation

    def _bounds(
        self, new: npt.NDArray[np.float64], now: npt.NDArray[np.float64], old: npt.NDArray[np.float64]
    ) -> dict[ElementTree.Element, float]:
        """Return what the scan says of the bounds of its points, and is to say: new, old: (size, 3); now: new, its own.

        Those of E2807 are in the scan's own frame; pye57 writes the file's. They stay in the frame that they are in.
        """
        was = self._in_own_frame(old)
        spherical = _as_spherical(now, np.zeros(len(now)))
        own, of_file = (self._ends("cartesianBounds", ("x", "y", "z"), xyz) for xyz in (was, old))
        is_of_file = _off(of_file) < _off(own)  # of no numbers neither is
        box = self._ends("cartesianBounds", ("x", "y", "z"), new if is_of_file else now)
        return box | self._ends("sphericalBounds", ("range", "", "elevation"), spherical)  # azimuths go round

    def _ends(
        self, where: str, names: tuple[str, ...], values: npt.NDArray[np.float64]
    ) -> dict[ElementTree.Element, float]:
        """Return the least and largest of (size, 3) values for the elements that the scan has for them."""
        found = {}
        for name, column in zip(names, values.T, strict=True):
            known = column[np.isfinite(column)]
            for end, bound in (("Minimum", np.min), ("Maximum", np.max)):
                if len(known) and (element := child(self.element, where, name + end)) is not None:
                    found[element] = float(bound(known))
        return found


def _off(bounds: dict[ElementTree.Element, float]) -> float:
    """Return how far bounds are from what their elements say, altogether; NaN where one says no number."""
    off = 0.0
    for element, bound in bounds.items():
        try:
            off += abs(float(element.text or 0) - bound)
        except ValueError:
            return np.nan
    return off


def _as_spherical(xyz: npt.NDArray[np.float64], near: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return ranges, azimuths and elevations (N, 3), the azimuths less than half a turn from those of `near` (N,)."""
    x, y, z = xyz.T
    flat = np.hypot(x, y)
    azimuth = np.arctan2(y, x)
    azimuth += 2 * np.pi * np.rint((near - azimuth) / (2 * np.pi))
    return np.stack([np.hypot(flat, z), azimuth, np.arctan2(z, flat)], axis=1)


def _placed(columns: Columns, scan: ElementTree.Element) -> tuple[Columns, npt.NDArray[np.int64] | None]:
    """Return a scan's columns, (M,) each, of what is a point, with places and normals in the file's frame.

    And which rows these were; None: all.
    """
    xyz, spherical = _popped(columns, CARTESIAN), _popped(columns, SPHERICAL)
    states = [columns.pop(name) == 0 for name in STATES if name in columns]
    if xyz is None and spherical is not None:
        reach, turn, up = spherical.T
        flat = reach * np.cos(up)
        xyz = np.stack([flat * np.cos(turn), flat * np.sin(turn), reach * np.sin(up)], axis=1)
    if xyz is None:
        held = ", ".join(columns)[:200] or "nothing else"
        raise UnsupportedCloud(f"a scan of the E57 file has no positions, cartesian or spherical, but {held}")
    rotation, translation = _pose(scan)
    with np.errstate(over="ignore", invalid="ignore"):  # of one that is infinite little is left
        columns |= zip(CARTESIAN, (xyz @ rotation.T + translation).T, strict=True)
    if all(name in columns for name in NORMAL):
        normals = np.stack([columns[name] for name in NORMAL], axis=1)
        columns |= zip(NORMAL, (normals @ rotation.T).astype(normals.dtype).T, strict=True)
    if not states or (valid := np.logical_and.reduce(states)).all():
        return columns, None
    return {name: values[valid] for name, values in columns.items()}, np.flatnonzero(valid)


def _popped(columns: Columns, names: tuple[str, ...]) -> npt.NDArray[np.float64] | None:
    """Take three columns out, together (N, 3) float64; None where they are not all there."""
    found = [columns.pop(name, None) for name in names]
    there = [column.astype(np.float64) for column in found if column is not None]
    return np.stack(there, axis=1) if len(there) == len(names) else None


def _pose(scan: ElementTree.Element) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return a scan's rotation (3, 3), of a unit quaternion, and its translation (3,): p' = R p + t (E2807, 8.4.3)."""
    pose = child(scan, "pose")
    turned = np.array([number(pose, "rotation", axis, default=float(axis == "w")) for axis in "wxyz"])
    moved = np.array([number(pose, "translation", axis) for axis in "xyz"])
    length = np.linalg.norm(turned)
    if not (0 < length < np.inf and np.isfinite(moved).all()):
        raise MalformedFile(
            f"a pose of the E57 file has the rotation {turned.tolist()} and the translation {moved.tolist()}"
        )
    w, x, y, z = (turned / length).tolist()
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]), moved  # fmt: skip
