"""The compiled loops and their plain torch twins compute the same function."""

from __future__ import annotations

import pytest
import torch

from straightpcf.model import ops
from straightpcf.model.kernels import cpu
from straightpcf.model.nets.straightpcf import VelocityModule

kernels = pytest.mark.skipif(cpu.load() is None, reason="no C++ compiler and no shipped kernels")


def relative_error(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).norm() / b.norm())


@kernels
@pytest.mark.parametrize(("count", "dims"), [(1000, 3), (1000, 64), (333, 32), (34, 16)])
def test_knn_finds_the_same_neighbours_as_topk(count: int, dims: int) -> None:
    x = torch.randn(2, count, dims, generator=torch.Generator().manual_seed(count))
    found = ops.knn(x, 32).sort().values
    expected = ops.knn_torch(x, 32, count).sort().values
    assert (found == expected).float().mean() > 0.999  # ties at float32 rounding may differ


@kernels
def test_what_all_points_have_in_common_does_not_blur_their_neighbours() -> None:
    """Features are positive: far from zero, beside what tells them apart."""
    x = torch.randn(1, 500, 64, generator=torch.Generator().manual_seed(0))
    found, expected = ops.knn(x + 50, 32).sort().values, ops.knn(x, 32).sort().values
    assert (found == expected).float().mean() > 0.998


@kernels
def test_knn_never_returns_the_point_itself() -> None:
    index = ops.knn(torch.randn(1, 500, 3), 32)
    assert not (index == torch.arange(500)[:, None]).any()


def test_squared_distances_are_those_of_the_differences() -> None:
    a, b = torch.randn(2, 7, 3) + 100, torch.randn(2, 11, 3) + 100
    expected = torch.cdist(a.double(), b.double()).square()
    torch.testing.assert_close(ops.squared_distances(a, b).double(), expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("count", [2, 20, 33])
def test_knn_repeats_neighbours_when_there_are_too_few(count: int) -> None:
    x = torch.randn(1, count, 3)
    for index in (ops.knn(x, 32), ops.knn_torch(x, 32, count)):
        assert index.shape == (1, count, 32)
        assert {len(set(row.tolist())) for row in index[0]} == {min(32, count - 1)}


@kernels
def test_knn_of_equal_points_stays_in_range() -> None:
    index = ops.knn(torch.zeros(1, 200, 3), 32)
    assert index.min() >= 0
    assert index.max() < 200


@kernels
@pytest.mark.parametrize("dims", [3, 32])
def test_a_point_that_is_no_number_is_nobody_s_neighbour(dims: int) -> None:
    x = torch.randn(1, 200, dims, generator=torch.Generator().manual_seed(dims))
    x[0, 7] = torch.nan
    found = ops.knn(x, 32)
    others = torch.arange(200) != 7
    assert (found[0, 7] == 0).all()
    assert (found[0, others] != 7).all()
    expected = ops.knn_torch(x[:, others], 32, 199)  # its own cdist has no order for NaN
    assert (found[0, others].sort().values == torch.arange(200)[others][expected[0]].sort().values).all()


@kernels
@pytest.mark.parametrize("count", [2, 34, 64, 200])
@pytest.mark.parametrize("dims", [3, 32])
@pytest.mark.parametrize("value", [torch.nan, -torch.nan, torch.inf, 3e38])
def test_of_points_that_are_no_numbers_neighbours_stay_in_range(value: float, dims: int, count: int) -> None:
    found = ops.knn(torch.full((1, count, dims), value), 32)
    assert found.min() >= 0
    assert found.max() < count


@kernels
@pytest.mark.parametrize("grad", [False, True])  # in one call of the kernels, and block by block
def test_a_network_of_nan_says_nan(*, grad: bool) -> None:
    module = VelocityModule().eval()
    with torch.no_grad():
        for tensor in module.parameters():
            tensor.fill_(torch.nan)
    with torch.set_grad_enabled(grad):
        assert module(torch.randn(1, 100, 3)).isnan().all()


@kernels
@pytest.mark.parametrize(("width", "out_width"), [(16, 16), (32, 32), (64, 64), (128, 128), (256, 256)])
def test_edge_max_agrees_with_the_gathered_form(width: int, out_width: int) -> None:
    generator = torch.Generator().manual_seed(width)
    a, b = torch.randn(2, 2, 200, width, generator=generator)
    weight = torch.randn(out_width, width, generator=generator) / width**0.5
    index = ops.knn(b, 32, 70)
    found = ops.edge_max(a[:, :70], b, index, weight)
    expected = ops.edge_max_torch(a[:, :70].double(), b.double(), index, weight.double())
    assert relative_error(found, expected) < 5e-3  # bfloat16 products where the processor has them


@kernels
@pytest.mark.parametrize("k", [1, 20, 32, 40])
def test_edge_max_takes_any_number_of_edges(k: int) -> None:
    generator = torch.Generator().manual_seed(k)
    a, b = torch.randn(2, 1, 90, 64, generator=generator) - 1  # a missing edge taken for zeros would win
    weight = -torch.rand(64, 64, generator=generator) / 8
    index = ops.knn(b, k)
    assert relative_error(ops.edge_max(a, b, index, weight), ops.edge_max_torch(a, b, index, weight)) < 5e-3


@kernels
def test_edge_max_gradient_is_exact_along_the_winning_edges() -> None:
    """With weights and inputs on a coarse grid bfloat16 is exact, so the winners and the gradient must agree."""
    generator = torch.Generator().manual_seed(0)

    def grid(*shape: int) -> torch.Tensor:
        return (torch.randint(-8, 9, shape, generator=generator) / 8).requires_grad_()

    a, b, weight = grid(1, 50, 32), grid(1, 120, 32), grid(32, 32)
    index = ops.knn(b, 8, 50)
    # Ties share no gradient the same way: break them with a gradient that is zero where they are.
    hidden = torch.relu(a.unsqueeze(2) + b[0][index.long()])
    top = (hidden @ weight.T).topk(2, dim=2).values
    grad = torch.randn(1, 50, 32, generator=generator) * (top[:, :, 0] > top[:, :, 1])
    found = torch.autograd.grad(ops.edge_max(a, b, index, weight), (a, b, weight), grad)
    expected = torch.autograd.grad(ops.edge_max_torch(a, b, index, weight), (a, b, weight), grad)
    for ours, theirs in zip(found, expected, strict=True):
        assert relative_error(ours, theirs) < 1e-5


@kernels
def test_loading_the_kernels_leaves_subnormal_numbers_alone() -> None:
    cpu.load()
    assert float(torch.tensor(5e-324, dtype=torch.float64) * 1) == 5e-324
    assert 2.0**-1074 * 1.0 > 0
