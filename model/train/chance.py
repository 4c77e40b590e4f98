"""Training clouds whose points lie by chance, few or many, of the shapes of an archive, whose own lie evenly.

python -m straightpcf.model.train.chance chance.npz --data punet_train.npz --resolutions 2500 5000 10000

Points drawn from a mesh or a formula lie so, and an even cloud thinned at random nearly does.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from straightpcf.model.patches import PATCH_SIZE
from straightpcf.model.train.archive import opened, read_array, split_name, write_archive
from straightpcf.model.train.command import archive_to_write, errors_in_one_line, positive, seed_number
from straightpcf.points.errors import InvalidOptions

__all__ = ["write_chance"]

RESOLUTIONS = (2500, 5000, 10_000)


def write_chance(path: Path, data: Path, resolutions: Sequence[int] = RESOLUTIONS, *, seed: int = 0) -> None:
    """Write an .npz of each shape of `data`, its finest cloud thinned at random: `<shape>/<resolution>`, float32.

    With them, what is known of the finest, which stands for the surface: `<shape>/surface`, and `<shape>/normals` where
    `data` has them. The shapes keep their names, so those that are held out there are held out here. Raises
    InvalidOptions for a resolution below a patch's 1000 points, or above a shape's finest, MalformedFile.
    """
    arrays = {}
    with opened(data) as archive:
        finest: dict[str, int] = {}
        for shape, what in (split_name(name, data) for name in archive.files):
            if what.isdecimal():
                finest[shape] = max(finest.get(shape, 0), int(what))
        for number, (shape, points) in enumerate(sorted(finest.items())):
            surface = read_array(archive, f"{shape}/{points}", data)
            if wrong := [count for count in resolutions if not PATCH_SIZE <= count <= len(surface)]:
                raise InvalidOptions(f"{shape} can have {PATCH_SIZE} to {len(surface)} points, not {wrong[0]}")
            rng = np.random.default_rng([seed, number])
            for count in resolutions:
                arrays[f"{shape}/{count}"] = surface[rng.choice(len(surface), count, replace=False)]
            arrays[f"{shape}/surface"] = surface
            if (normals := f"{shape}/normals") in archive:
                arrays[normals] = read_array(archive, normals, data)
    if not arrays:
        raise InvalidOptions(f"{data} has no clouds called <shape>/<points>")
    write_archive(path, arrays)


@errors_in_one_line()
def _main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("path", type=archive_to_write, help="the .npz to write")
    parser.add_argument("--data", type=Path, required=True, help="clean clouds")
    parser.add_argument("--resolutions", type=positive, nargs="+", default=RESOLUTIONS)
    parser.add_argument("--seed", type=seed_number, default=0)
    options = parser.parse_args()
    write_chance(options.path, options.data, options.resolutions, seed=options.seed)


if __name__ == "__main__":
    _main()
