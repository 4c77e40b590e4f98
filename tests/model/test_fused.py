"""A module in one call of the kernels does what it does step by step."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from straightpcf.model.kernels import cpu
from straightpcf.model.kernels.fused import fused
from straightpcf.model.nets.edgeconv import NEIGHBOURS
from straightpcf.model.nets.straightpcf import DistanceModule, VelocityModule

pytestmark = pytest.mark.skipif(cpu.load() is None, reason="no C++ compiler and no shipped kernels")

Module = VelocityModule | DistanceModule


def of(kind: type[Module], *widths: int) -> Module:
    """Return a module that has seen some batches, and learns no more."""
    torch.manual_seed(0)
    module = kind(*widths)
    for _ in range(5):
        module(torch.randn(2, 200, 3) * 0.3)
    return module.eval()


def in_one_call(module: Module, x: torch.Tensor) -> bool:
    return fused(module, module.encoder, module.decoder, x, NEIGHBOURS) is not None


def relative_error(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found - expected).norm() / expected.norm())


@pytest.mark.parametrize("count", [2, 20, 33, 700])
@pytest.mark.parametrize(
    "module", [of(VelocityModule), of(DistanceModule), of(DistanceModule, 64)], ids=["velocity", "distance", "narrow"]
)
def test_one_call_gives_what_the_steps_give(module: Module, count: int) -> None:
    x = torch.randn(2, count, 3, generator=torch.Generator().manual_seed(count)) * 0.2
    assert not in_one_call(module, x)  # there may be a gradient to take
    expected = module(x).detach()
    with torch.inference_mode():
        assert in_one_call(module, x)
        found = module(x)
    assert found.shape == expected.shape
    assert relative_error(found, expected) < 2e-2  # bfloat16 products, also in the linear layers


def test_the_first_rows_are_those_of_all() -> None:
    module, x = of(VelocityModule), torch.randn(2, 150, 3) * 0.2
    with torch.no_grad():
        every = module(x)
        for rows in (1, 33, 150):
            torch.testing.assert_close(module(x, rows), every[:, :rows])


def test_weights_that_change_are_packed_anew() -> None:
    module, other, x = of(VelocityModule), VelocityModule().eval(), torch.randn(1, 100, 3) * 0.2
    with torch.no_grad():
        before = module(x)
        module.decoder.lin_3.weight.mul_(2)
        module.decoder.lin_3.bias.mul_(2)
        torch.testing.assert_close(module(x), 2 * before)
        module.load_state_dict(other.state_dict())
        torch.testing.assert_close(module(x), other(x))
        module.decoder.lin_3 = torch.nn.Linear(64, 3)
        assert not torch.equal(module(x), other(x))


def test_a_module_that_learns_goes_step_by_step() -> None:
    module, x = of(VelocityModule).train(), torch.randn(1, 50, 3)
    with torch.no_grad():
        assert not in_one_call(module, x)
        assert not in_one_call(module.eval(), x.double())


def test_a_module_made_in_inference_mode_goes_step_by_step() -> None:
    with torch.inference_mode():
        module = VelocityModule().eval()
        assert not in_one_call(module, torch.randn(1, 50, 3))


def test_threads_do_not_disturb_each_other() -> None:
    module = of(VelocityModule)
    patches = [torch.randn(1, count, 3) * 0.2 for count in (50, 400, 90, 300) * 8]

    def move(x: torch.Tensor) -> torch.Tensor:
        with torch.inference_mode():
            return module(x)

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(move, patches))
    for found, x in zip(together, patches, strict=True):
        assert torch.equal(found, move(x))
