"""The network is the paper's."""

from __future__ import annotations

import torch

from straightpcf.model.nets.edgeconv import EdgeConv
from straightpcf.model.nets.straightpcf import DistanceModule, StraightPCF, VelocityModule
from straightpcf.model.ops import knn
from straightpcf.model.turns import turns


def parameters(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_parameter_counts_are_the_papers() -> None:
    assert parameters(VelocityModule()) == 234_947
    assert parameters(StraightPCF()) == 533_415


def test_an_edgeconv_equals_its_definition_on_explicit_edges() -> None:
    torch.manual_seed(0)
    block, x = EdgeConv(16, 32), torch.randn(1, 60, 16)
    index = knn(x, 8)
    neighbours = x[0][index[0].long()]  # (P, k, C)
    centre = x[0][:, None].expand_as(neighbours)
    edges = block.mlp(torch.cat([centre, neighbours - centre], dim=2)).amax(dim=1)
    expected = torch.relu(edges) + torch.relu(block.lin(x[0]))
    torch.testing.assert_close(block(x, index)[0], expected, atol=2e-2, rtol=2e-2)  # bfloat16 products


def test_velocities_do_not_depend_on_the_order_of_the_points() -> None:
    torch.manual_seed(0)
    module, x = VelocityModule().eval(), torch.randn(1, 300, 3) * 0.2
    order = torch.randperm(300)
    with torch.inference_mode():
        torch.testing.assert_close(module(x[:, order]), module(x)[:, order], atol=1e-5, rtol=1e-4)


def test_the_first_rows_alone_give_what_all_rows_give() -> None:
    torch.manual_seed(0)
    module, x = VelocityModule().eval(), torch.randn(2, 300, 3) * 0.2
    with torch.inference_mode():
        torch.testing.assert_close(module(x, 40), module(x)[:, :40])


def test_neighbours_may_keep_their_velocity() -> None:
    torch.manual_seed(0)
    network, x = StraightPCF(width=128, distance_width=128).eval(), torch.randn(2, 300, 3) * 0.2
    owned = torch.tensor([40, 25])
    with torch.inference_mode():
        whole, _ = network(x, rows=40)
        torch.testing.assert_close(network(x, rows=40, owned=owned, full_evaluations=5)[0], whole)
        torch.testing.assert_close(network(x, rows=300, owned=torch.tensor([300, 300]))[0], network(x)[0])
        first, second = network.velocity_modules
        fewer, distance = network(x, rows=40, owned=owned, euler_steps=1)
        step = distance[:, :, None] / 2
        here = x + step * first(x)
        torch.testing.assert_close(fewer, here[:, :40] + step * second(here, 40))


def test_every_evaluation_sees_the_patch_in_its_own_position() -> None:
    torch.manual_seed(0)
    network, x = StraightPCF(width=128, distance_width=128).eval(), torch.randn(2, 300, 3) * 0.2
    a, b, c = turns(3)
    with torch.inference_mode():
        moved, distance = network(x, euler_steps=2, turns=turns(3))
        step = distance[:, :, None] / 4
        first, second = network.velocity_modules
        for velocity, turn in ((first, a), (second, b), (first, c), (second, a)):
            x = x + step * (velocity(x @ turn) @ turn.T)
    torch.testing.assert_close(moved, x)


def test_turns_are_rotations_and_spread() -> None:
    matrices = turns(6)
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3).expand(6, 3, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(6))
    traces = torch.einsum("aij,bij->ab", matrices, matrices)
    angles = torch.rad2deg(torch.arccos((traces.clamp(max=3.0) - 1) / 2))
    assert angles[~torch.eye(6, dtype=torch.bool)].min() > 60


def test_a_patch_does_not_see_its_batch() -> None:
    torch.manual_seed(0)
    network, x = StraightPCF(width=128, distance_width=128).eval(), torch.randn(2, 300, 3) * 0.2
    owned = torch.tensor([40, 25])
    with torch.inference_mode():
        both, _ = network(x, rows=40, owned=owned)
        alone, _ = network(x[1:], rows=25, owned=owned[1:])
    torch.testing.assert_close(both[1:, :25], alone)


def test_the_distance_lies_between_0_and_1_and_belongs_to_the_whole_patch() -> None:
    torch.manual_seed(0)
    module, x = DistanceModule().eval(), 0.1 * torch.randn(2, 300, 3)
    with torch.inference_mode():
        distance, mixed = module(x), module(x[:, torch.randperm(300)])
    assert distance.shape == (2, 1)
    assert ((distance > 0) & (distance < 1)).all()
    torch.testing.assert_close(mixed, distance, atol=1e-3, rtol=1e-3)
