"""The path of a CUDA device, run on the CPU: what it gives is what the host's path gives."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from straightpcf.model import device_patches
from straightpcf.model import on_device as device_path
from straightpcf.model.device_patches import cut_patches_on
from straightpcf.model.filter import Filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.on_device import Capture, Graphs, OnDevice
from straightpcf.model.outliers import isolated
from straightpcf.model.spread import ROUNDS, spread
from straightpcf.model.tiles import Tiling, split
from straightpcf.points.errors import TooLarge
from straightpcf.points.options import DenoiseOptions
from tests.clouds import noisy, sphere, torus

Again = Callable[[], torch.Tensor]


def capture_by_calling(run: Again) -> tuple[Callable[[], object], torch.Tensor]:
    """Stand in for a CUDA graph: replaying runs the computation on what its inputs hold, into the same tensor."""
    out = run().clone()
    return lambda: out.copy_(run()), out


@pytest.fixture(scope="module")
def network() -> StraightPCF:
    torch.manual_seed(0)
    return StraightPCF(width=32, distance_width=32)


def on_device(
    network: torch.nn.Module,
    *,
    batch: int = 4,
    capture: Capture = capture_by_calling,
    coverage: float = 3,
    tile_points: int | None = None,
) -> Filter:
    model = Filter(network, threads=1, coverage=coverage, tile_points=tile_points)  # type: ignore[arg-type]
    model.processor = OnDevice(model, "cpu", batch=batch, capture=capture)
    return model


@pytest.mark.parametrize("count", [500, 3000, 4400])  # one patch, fewer than a batch, a last batch that is not full
def test_a_device_gives_what_the_host_gives(network: StraightPCF, count: int) -> None:
    cloud = noisy(torus(count), 0.01)
    options = DenoiseOptions(iterations=3)
    expected = Filter(network, threads=1, coverage=3).denoise(cloud, options)
    result = on_device(network).denoise(cloud, options)
    apart = np.linalg.norm(result.xyz - expected.xyz, axis=1)
    assert (apart < 1e-4).mean() > 0.98  # spreading: at its rim a patch lacks some of the neighbours
    assert apart.mean() < 5e-5
    np.testing.assert_allclose(result.distances, expected.distances, atol=1e-4)


@pytest.mark.slow
def test_a_cloud_in_tiles_is_spread_too(network: StraightPCF) -> None:
    cloud = noisy(torus(11_000), 0.01)
    options = DenoiseOptions(iterations=2)
    expected = Filter(network, threads=1, coverage=2, tile_points=10_000).denoise(cloud, options)
    result = on_device(network, batch=16, coverage=2, tile_points=10_000).denoise(cloud, options)
    apart = np.linalg.norm(result.xyz - expected.xyz, axis=1)
    assert (apart < 1e-4).mean() > 0.98


def test_neighbours_of_a_patch_spread_points_as_neighbours_of_the_cloud_do(network: StraightPCF) -> None:
    ball = sphere(8000, 0)
    tiling = Tiling(ball, split(ball, 10_000), coverage=3, seed=0)
    moved = on_device(network).processor.spread(ball, tiling, 1.0, ROUNDS)
    apart = np.linalg.norm(moved - spread(ball, 1.0), axis=1)
    assert (apart < 1e-5).mean() > 0.99
    assert apart.mean() < 0.002 * np.linalg.norm(moved, axis=1).mean()


@pytest.mark.parametrize("count", [700, 8000])  # one patch, several
def test_points_in_the_air_are_found_among_their_patches_as_in_the_whole_cloud(
    network: StraightPCF, count: int
) -> None:
    ball, air = sphere(count, 0), np.random.default_rng(0).uniform(-3, 3, (30, 3))
    cloud = np.vstack([ball, air]) / 6
    tiling = Tiling(cloud, split(cloud, 10_000), coverage=3, seed=0)
    spacings = on_device(network).processor.spacings(cloud, tiling, 8)
    assert spacings is not None
    distances, nearest = cKDTree(cloud).query(cloud, k=np.arange(2, 10))
    expected = distances[:, -1], np.median(distances[nearest, -1], axis=1)
    assert (np.isclose(spacings, expected).mean(axis=1) > 0.99).all()
    np.testing.assert_array_equal(isolated(cloud, spacings=spacings), isolated(cloud))
    assert isolated(cloud)[-30:].any()


def test_a_shape_is_captured_when_it_comes_again_and_reads_fresh_inputs() -> None:
    captured = []

    def compute(rows: int, x: torch.Tensor, owned: torch.Tensor, *distance: torch.Tensor) -> torch.Tensor:
        return x[:, :rows] * owned[:, None, None] * (distance[0][:, :, None] if distance else 1)

    def capture(run: Again) -> tuple[Callable[[], object], torch.Tensor]:
        captured.append(run)
        return capture_by_calling(run)

    graphs = Graphs(compute, capture)
    for turn in range(4):
        x, owned = torch.rand(2, 1000, 3), torch.tensor([turn, 1])
        torch.testing.assert_close(graphs(400, x, owned), x[:, :448] * owned[:, None, None])
        distance = torch.rand(2, 1)
        expected = x[:, :960] * (owned[:, None] * distance)[:, :, None]
        torch.testing.assert_close(graphs(950, x, owned, distance), expected)
        graphs(700, torch.rand(2, 700, 3), owned)  # patches of small clouds have a size each: no graphs for them
        assert len(captured) == (2 if turn else 0)


def test_the_graph_that_was_used_last_is_given_up_last() -> None:
    captured = []

    def capture(run: Again) -> tuple[Callable[[], object], torch.Tensor]:
        captured.append(run)
        return capture_by_calling(run)

    graphs = Graphs(lambda rows, x: x[:, :rows], capture)

    def call(batch: int) -> None:
        for _ in range(2):
            graphs(1000, torch.rand(batch, 1000, 3))

    for batch in range(1, 17):
        call(batch)
    call(1)
    assert len(captured) == 16
    call(17)  # one more than are kept: that of 2 goes
    call(1)
    assert len(captured) == 17
    call(2)
    assert len(captured) == 18


def test_patches_that_own_about_as_many_points_go_together(
    network: StraightPCF, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = sphere(8000, 0)
    cut = next(Tiling(ball, split(ball, 10_000), coverage=3, seed=0).cuts())
    processor, made = OnDevice(Filter(network, threads=1), "cpu", batch=4, capture=capture_by_calling), []
    monkeypatch.setattr(processor, "_moves", lambda rows, x, *_: made.append(rows) or x[:, :rows])
    finished = dict(
        processor.displacements(
            ball, cut, np.ones(len(cut.seeds)), {}, lambda patch, moves: (patch, len(moves)), agree=False
        )
    )
    assert finished == dict(enumerate(cut.owned.tolist()))
    assert made == np.sort(cut.owned)[[3, 7, 11, 15, 19, 23]].tolist()


def test_where_capturing_fails_the_work_goes_on_without_graphs(network: StraightPCF) -> None:
    def refuse(run: Again) -> tuple[Callable[[], object], torch.Tensor]:
        raise RuntimeError("operation not permitted when stream is capturing")

    cloud = noisy(torus(4400), 0.01)
    with pytest.warns(UserWarning, match="not permitted"):
        result = on_device(network, capture=refuse).denoise(cloud, DenoiseOptions(iterations=1))
    expected = Filter(network, threads=1, coverage=3).denoise(cloud, DenoiseOptions(iterations=1))
    np.testing.assert_allclose(result.xyz, expected.xyz, atol=1e-5)


class _SmallMemory(torch.nn.Module):
    """A network that runs out of memory above so many patches."""

    def __init__(self, network: StraightPCF, most: int) -> None:
        super().__init__()
        self.network, self.most = network, most
        self.distance_module = network.distance_module

    def first_velocities(self, x: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = self.network.first_velocities(x, turns)
        return found

    def forward(self, x: torch.Tensor, **how: Any) -> tuple[torch.Tensor, torch.Tensor]:
        if len(x) > self.most:
            raise torch.OutOfMemoryError(f"{len(x)} patches")
        moved, distance = self.network(x, **how)
        return moved, distance


def test_out_of_memory_halves_the_batch_and_goes_on(network: StraightPCF) -> None:
    cloud, options = noisy(torus(3000), 0.01), DenoiseOptions(iterations=1)
    small = on_device(_SmallMemory(network, 3), batch=8)
    expected = Filter(network, threads=1, coverage=3).denoise(cloud, options).xyz
    np.testing.assert_allclose(small.denoise(cloud, options).xyz, expected, atol=1e-6)
    assert isinstance(small.processor, OnDevice)
    assert small.processor.batch == 2
    with pytest.raises(TooLarge, match="patch of 1000"):
        on_device(_SmallMemory(network, 0), batch=8).denoise(cloud, options)


def test_out_of_memory_halves_the_batch_of_what_reads_and_spreads_too(
    network: StraightPCF, monkeypatch: pytest.MonkeyPatch
) -> None:
    def most(call: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
        def small(x: torch.Tensor, *how: Any) -> torch.Tensor:
            if len(x) > 3:
                raise torch.OutOfMemoryError(f"{len(x)} patches")
            return call(x, *how)

        return small

    ball = sphere(3000, 0)
    tiling = Tiling(ball, split(ball, 10_000), coverage=3, seed=0)
    cut = next(tiling.cuts())
    scales = np.ones(len(cut.seeds))
    of = Filter(network, threads=1)
    large, small = (OnDevice(of, "cpu", batch=8, capture=capture_by_calling) for _ in range(2))
    monkeypatch.setattr(small, "_network", SimpleNamespace(distance=most(network.distance_module)))
    np.testing.assert_allclose(small.distances(ball, cut, scales), large.distances(ball, cut, scales), atol=1e-6)
    assert small.batch == 2
    expected = large.spread(ball, tiling, 1.0, ROUNDS)
    small.batch = 8
    monkeypatch.setattr(device_path, "knn", most(device_path.knn))
    np.testing.assert_array_equal(small.spread(ball, tiling, 1.0, ROUNDS), expected)
    assert small.batch == 2


def test_a_cloud_that_a_device_cannot_hold_is_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*given: Any) -> torch.Tensor:
        raise torch.OutOfMemoryError("all gone")

    monkeypatch.setattr(device_patches, "squared_distances", full)
    with pytest.raises(TooLarge, match="cpu has no memory for 2000 points"):
        cut_patches_on(torch.device("cpu"), sphere(2000, 0), coverage=3, seed=0)
