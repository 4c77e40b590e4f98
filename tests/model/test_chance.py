"""Training clouds whose points lie by chance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from straightpcf.model.train.chance import write_chance
from straightpcf.model.train.data import PatchSource
from straightpcf.points.errors import InvalidOptions
from tests.clouds import sphere


@pytest.fixture
def even(tmp_path: Path) -> Path:
    shapes = {f"s{n}/{count}": sphere(count).astype(np.float32) for n in range(6) for count in (1000, 4000)}
    np.savez(path := tmp_path / "even.npz", **shapes, **{"s0/normals": shapes["s0/4000"]})  # type: ignore[arg-type]
    return path


def test_the_finest_clouds_are_thinned_and_stand_for_the_surface(even: Path, tmp_path: Path) -> None:
    write_chance(path := tmp_path / "chance.npz", even, [1000, 2000])
    with np.load(path) as thinned, np.load(even) as whole:
        np.testing.assert_array_equal(thinned["s0/surface"], whole["s0/4000"])
        np.testing.assert_array_equal(thinned["s0/normals"], whole["s0/normals"])
        assert "s1/normals" not in thinned
        points = thinned["s0/2000"]
        assert len(np.unique(points, axis=0)) == 2000
        assert {*map(bytes, points)} <= {*map(bytes, whole["s0/4000"])}
        assert not np.array_equal(points, thinned["s1/2000"])
    assert len(PatchSource.read(path).clouds) == 10  # one of six shapes is held out
    assert len(PatchSource.read(path, validation=True).clouds) == 2


@pytest.mark.parametrize("count", [999, 4001])
def test_more_points_than_there_are_or_fewer_than_a_patch_has_are_refused(
    even: Path, tmp_path: Path, count: int
) -> None:
    with pytest.raises(InvalidOptions, match=f"s0 can have 1000 to 4000 points, not {count}"):
        write_chance(tmp_path / "chance.npz", even, [count])


def test_how_many_points_a_cloud_has_is_not_believed_of_its_name(tmp_path: Path) -> None:
    np.savez(data := tmp_path / "named.npz", **{"s0/9000": sphere(2000)})  # type: ignore[arg-type]
    with pytest.raises(InvalidOptions, match="s0 can have 1000 to 2000 points, not 3000"):
        write_chance(tmp_path / "chance.npz", data, [3000])
