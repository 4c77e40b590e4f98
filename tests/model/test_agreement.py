"""What overlapping patches say of a point first is joined, and nothing else changes by it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from straightpcf.model.agreement import Agreement
from straightpcf.model.filter import Filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.on_device import OnDevice
from straightpcf.model.on_host import OnHost
from straightpcf.model.processor import First, Processor
from straightpcf.model.tiles import Tiling, split
from straightpcf.points.options import DenoiseOptions
from tests.clouds import noisy, sphere, torus
from tests.model.test_on_device import capture_by_calling


@pytest.fixture(scope="module")
def network() -> StraightPCF:
    torch.manual_seed(0)
    return StraightPCF(width=64, distance_width=64)


def test_what_is_nearer_to_its_seed_counts_for_more() -> None:
    agreement = Agreement(12, torch.tensor([[4, 7], [7, 9]]), torch.tensor([1.0, 2.0]), torch.tensor([1.0, 0.5]))
    x = torch.tensor([[[0.0, 0, 0], [0, 0.5, 0]], [[0, 0, 0], [0, 0, 1]]])
    velocities = torch.tensor([[[1.0, 0, 0], [2, 0, 0]], [[4, 0, 0], [8, 0, 0]]])
    distance = torch.tensor([[0.5], [0.25]])
    for patch in (slice(0, 1), slice(1, 2)):
        agreement.add(patch, x[patch], velocities[patch], distance[patch])
    first, second = agreement.velocities(slice(0, 2), distance)
    torch.testing.assert_close(first[0], velocities[0, 0])  # no other patch has it
    torch.testing.assert_close(second[1], velocities[1, 1])  # at the rim, but heard
    assert 0.5 * first[1, 0] == 0.25 * second[0, 0] / 2  # all patches are told the same step, of 0.5 to 1
    assert 0.5 < 0.5 * first[1, 0] < 0.75


def test_the_order_in_which_patches_are_heard_changes_no_bit() -> None:
    rng = torch.Generator().manual_seed(0)
    index = torch.stack([torch.randperm(90, generator=rng)[:60] for _ in range(12)])
    x, velocities = torch.rand(12, 60, 3, generator=rng), torch.rand(12, 60, 3, generator=rng)
    distance, scales = torch.rand(12, 1, generator=rng), torch.ones(12)
    one, other = (Agreement(90, index, scales, scales) for _ in range(2))
    one.add(slice(0, 12), x, velocities, distance)
    for patch in reversed(range(12)):
        some = slice(patch, patch + 1)
        other.add(some, x[some], velocities[some], distance[some])
    assert torch.equal(one.velocities(slice(0, 12), distance), other.velocities(slice(0, 12), distance))


def test_where_there_is_nowhere_to_go_nothing_is_divided_by_nothing() -> None:
    agreement = Agreement(2, torch.tensor([[0, 1]]), torch.ones(1), torch.zeros(1))  # all points in one place, d = 0
    agreement.add(slice(0, 1), torch.zeros(1, 2, 3), torch.ones(1, 2, 3), torch.zeros(1, 1))
    torch.testing.assert_close(
        agreement.velocities(slice(0, 1), torch.zeros(1, 1)), torch.ones(1, 2, 3), rtol=1e-4, atol=0
    )


class _Told:
    """A network whose patches say different things, and that notes how far it is told that points would go."""

    def __init__(self) -> None:
        self.told: list[torch.Tensor] = []

    def distance(self, x: torch.Tensor) -> torch.Tensor:
        return 0.2 + x.square().mean(dim=(1, 2))[:, None].clamp(max=0.5)

    def begin(self, x: torch.Tensor) -> torch.Tensor:
        return x.flip(2)

    def forward(
        self, x: torch.Tensor, owned: torch.Tensor, distance: torch.Tensor | None, first: First | None, rows: int
    ) -> torch.Tensor:
        assert distance is not None
        assert first is not None
        self.told += list(distance[:, :, None] * first[1])
        return 0 * x[:, :rows]


@pytest.mark.parametrize("on_device", [False, True])
def test_every_patch_is_told_the_same_step_of_a_point_in_its_own_scale(*, on_device: bool) -> None:
    cloud = torus(4000)
    cut = next(Tiling(cloud, split(cloud, 10_000), coverage=3, seed=0).cuts())
    scales = np.linspace(0.5, 2.0, len(cut.seeds))
    told = _Told()
    processor: Processor = OnHost(told, threads=1)
    if on_device:
        processor = OnDevice(told, "cpu", batch=len(cut.seeds), capture=capture_by_calling)
    made = list(processor.displacements(cloud, cut, scales, {}, lambda patch, _: patch, agree=True))
    heard, patches = made[: len(cut.seeds)], made[len(cut.seeds) :]
    assert heard == [None] * len(cut.seeds)
    assert sorted(patches) == list(range(len(cut.seeds)))
    steps: dict[int, list[torch.Tensor]] = {}
    for patch, told_steps in zip(patches, told.told, strict=True):
        for row, step in zip(cut.index[patch], told_steps / scales[patch], strict=True):
            steps.setdefault(int(row), []).append(step)
    several = [torch.stack(found) for found in steps.values() if len(found) > 1]
    assert len(several) > 2000
    assert max(float((found - found[0]).abs().max()) for found in several) < 1e-6


def test_a_cloud_of_one_patch_has_nothing_to_agree_on(network: StraightPCF) -> None:
    cloud, options = noisy(sphere(700, 0), 0.01), DenoiseOptions(iterations=2)
    alone = Filter(network, threads=1, agree=False).denoise(cloud, options)
    assert np.array_equal(Filter(network, threads=1).denoise(cloud, options).xyz, alone.xyz)


def test_threads_and_the_order_of_patches_change_no_bit(network: StraightPCF) -> None:
    cloud, options = noisy(torus(6000), 0.01), DenoiseOptions(iterations=2)
    one, two = (Filter(network, threads=threads).denoise(cloud, options).xyz for threads in (1, 2))
    assert np.array_equal(one, two)


def test_progress_moves_while_patches_are_heard(network: StraightPCF) -> None:
    cloud = noisy(torus(6000), 0.01)
    patches = list(Filter(network, threads=1).patches(cloud, DenoiseOptions(iterations=1)))
    progress = [patch.progress for patch in patches]
    before = [patch.progress for patch in patches if not len(patch.indices)]
    assert progress == sorted(progress)
    assert progress[-1] == 1.0
    assert len(before) > 10
    assert 0.3 < before[-1] < 0.4
