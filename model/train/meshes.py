"""Training clouds of triangle meshes in files: closed bodies, sampled as evenly as PUNet's training split.

python -m straightpcf.model.train.meshes meshes.npz parts/*.stl bodies/*.off

Shapes that somebody designed or scanned are unlike those made in code. What is no single closed body is left out, and
said: a surface that ends has no far side, and bodies in one file run into each other, with walls where none is seen.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from straightpcf.model.train.archive import write_archive
from straightpcf.model.train.command import archive_to_write, errors_in_one_line, seed_number
from straightpcf.model.train.solids import even_clouds
from straightpcf.points.errors import InvalidOptions, MalformedFile, MissingDependency

if TYPE_CHECKING:
    from trimesh import Trimesh

__all__ = ["SUFFIXES", "write_meshes"]

Floats = npt.NDArray[np.float64]

SUFFIXES = (".obj", ".off", ".ply", ".stl")


def write_meshes(path: Path, meshes: Sequence[Path], *, seed: int = 0) -> dict[Path, str]:
    """Write an .npz of the closed bodies among `meshes`, named by their files: `<stem>/<resolution>`, float32.

    With them the normals of their triangles, `<stem>/normals`, of the points at the finest of RESOLUTIONS. All in the
    frame where the bounding sphere has radius 1. Returns what was left out, and why. Raises InvalidOptions where two
    files have one stem, another suffix than SUFFIXES, or nothing is left, MalformedFile, MissingDependency, OSError.
    """
    files: dict[str, Path] = {}
    for file in meshes:
        if file.suffix.lower() not in SUFFIXES:
            raise InvalidOptions(f"{file} is no mesh that is read here: {', '.join(SUFFIXES)}")
        if (other := files.setdefault(file.stem, file)) is not file:
            raise InvalidOptions(f"{other} and {file} would both be the shape {file.stem}")
    arrays: dict[str, npt.NDArray[np.float32]] = {}
    left_out: dict[Path, str] = {}
    for shape, file in files.items():
        mesh = _read(file)
        if why := _why_not(mesh):
            left_out[file] = why
            continue
        arrays |= even_clouds(np.random.default_rng([seed, len(arrays)]), shape, partial(_sample, mesh))
    if not arrays:
        raise InvalidOptions("none of the meshes is a single closed body: " + "; ".join(_told(left_out)))
    write_archive(path, arrays, save=np.savez_compressed)
    return left_out


def _read(path: Path) -> Trimesh:
    try:
        import trimesh
    except ImportError as exc:
        raise MissingDependency("meshes need the extra 'train': pip install 'straightpcf[train]'") from exc
    with path.open("rb"):  # an OSError of its own, by the file's name
        pass
    try:
        mesh = trimesh.load_mesh(path, skip_materials=True)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    except Exception as exc:  # trimesh raises whatever its readers do: ValueError, KeyError, IndexError, ...
        raise MalformedFile(f"{path} cannot be read as a mesh: {exc}") from exc
    if not mesh.area > 0:  # NaN, too
        raise MalformedFile(f"{path} holds no triangles with an area")
    return mesh


def _why_not(mesh: Trimesh) -> str | None:
    """Say why a mesh is nothing to train on, if it is not; its vertices that lie in one place are one."""
    if not mesh.is_watertight:
        return "its surface is not closed"
    if (bodies := mesh.body_count) > 1:
        return f"it is {bodies} bodies"
    return None


def _sample(mesh: Trimesh, rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    """Draw points by area, (count, 3), and the normals of their triangles."""
    from trimesh.sample import sample_surface

    xyz, triangles, *_ = sample_surface(mesh, count, seed=rng)
    return np.asarray(xyz, np.float64), np.asarray(mesh.face_normals[triangles])


def _told(left_out: Mapping[Path, str]) -> list[str]:
    return [f"{file}: {why}" for file, why in left_out.items()]


@errors_in_one_line()
def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=archive_to_write, help="the .npz to write")
    parser.add_argument("meshes", type=Path, nargs="+", help=f"files of triangles: {', '.join(SUFFIXES)}")
    parser.add_argument("--seed", type=seed_number, default=0)
    options = parser.parse_args()
    for line in _told(write_meshes(options.path, options.meshes, seed=options.seed)):
        sys.stdout.write(f"left out {line}\n")


if __name__ == "__main__":
    _main()
