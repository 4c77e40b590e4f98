"""SOAP: Adam in the slowly turning eigenbasis of Shampoo's preconditioner (Vyas et al. 2024, arXiv:2409.11321)."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from inspect import unwrap

import torch

__all__ = ["SOAP"]

_BETAS = (0.9, 0.99)
_FACTOR_BETA = 0.99
_EPS = 1e-8
_STREAMS = 8


class SOAP(torch.optim.Optimizer):
    """Adam on each matrix's gradient turned into the eigenvectors of E[G G^T] and E[G^T G]; plain Adam on vectors.

    `step` has no host-side condition, so a CUDA graph can hold it; `turn_bases` is called beside it, every few steps.
    The learning rate may be a tensor. Every value of the state is a tensor.
    """

    # As torch wraps them, these import its compiler, to tell it to pass them by: seconds, where nothing is compiled.
    add_param_group = unwrap(torch.optim.Optimizer.add_param_group)
    zero_grad = unwrap(torch.optim.Optimizer.zero_grad)
    state_dict = unwrap(torch.optim.Optimizer.state_dict)
    load_state_dict = unwrap(torch.optim.Optimizer.load_state_dict)

    def __init__(self, parameters: Iterable[torch.nn.Parameter], lr: float | torch.Tensor = 1e-3) -> None:
        super().__init__(parameters, {"lr": lr, "capturable": True})  # so that a loaded "step" is on its device

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Make one update from the gradients that are there."""
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            gradients = [parameter.grad for parameter in parameters]
            states = [self.state[parameter] for parameter in parameters]
            for state, gradient in zip(states, gradients, strict=True):
                if not state:
                    self._start(state, gradient)
            self._update(parameters, gradients, states, group["lr"])

    @staticmethod
    def _update(
        parameters: list[torch.Tensor],
        gradients: list[torch.Tensor],
        states: list[dict[str, torch.Tensor]],
        rate: float | torch.Tensor,
    ) -> None:
        """Update the parameters and their states; what is done to each alike is one kernel on a GPU."""
        if not parameters:
            return
        steps, means, squares = ([state[name] for state in states] for name in ("step", "mean", "square"))
        factors = [(s, g) for s, g in zip(states, gradients, strict=True) if g.ndim == 2]
        for side, products in (("left", [g @ g.T for _, g in factors]), ("right", [g.T @ g for _, g in factors])):
            if factors:
                torch._foreach_lerp_([state[side] for state, _ in factors], products, 1 - _FACTOR_BETA)
        turned = [_into_basis(gradient, state) for gradient, state in zip(gradients, states, strict=True)]
        torch._foreach_add_(steps, 1)
        torch._foreach_lerp_(means, gradients, 1 - _BETAS[0])
        torch._foreach_lerp_(squares, torch._foreach_mul(turned, turned), 1 - _BETAS[1])
        # What of the sums has been there since the start.
        shares = [torch._foreach_neg(torch._foreach_pow(beta, steps)) for beta in _BETAS]
        for share in shares:
            torch._foreach_add_(share, 1)
        change = torch._foreach_div(
            [_into_basis(mean, state) for mean, state in zip(means, states, strict=True)], shares[0]
        )
        size = torch._foreach_sqrt(torch._foreach_div(squares, shares[1]))
        torch._foreach_add_(size, _EPS)
        torch._foreach_div_(change, size)
        moves = [_out_of_basis(each, state) for each, state in zip(change, states, strict=True)]
        torch._foreach_mul_(moves, rate)
        torch._foreach_sub_(parameters, moves)

    @torch.no_grad()
    def turn_bases(self) -> None:
        """Take one step of the power iteration that keeps the bases at the factors' eigenvectors, in place."""
        kept = (self.state[parameter] for group in self.param_groups for parameter in group["params"])
        matrices = [state for state in kept if "left" in state]
        if not matrices or (device := matrices[0]["left"].device).type != "cuda":
            for state in matrices:
                self._turn(state)
            return
        # A decomposition is a hundred small kernels, one after the other: those of several matrices run side by side.
        streams, current = _streams(device), torch.cuda.current_stream(device)
        for stream in streams:
            stream.wait_stream(current)
        for number, state in enumerate(matrices):
            with torch.cuda.stream(streams[number % len(streams)]):
                self._turn(state)
        for stream in streams:
            current.wait_stream(stream)

    @staticmethod
    def _turn(state: dict[str, torch.Tensor]) -> None:
        for axis, side in enumerate(("left", "right")):
            factor, basis = state[side], state[f"{side}_basis"]
            order = (basis * (factor @ basis)).sum(dim=0).argsort(descending=True)
            basis.copy_(torch.linalg.qr(factor @ basis[:, order]).Q)
            state["square"].copy_(state["square"].index_select(axis, order))

    @staticmethod
    def _start(state: dict[str, torch.Tensor], gradient: torch.Tensor) -> None:
        state["step"] = torch.zeros((), device=gradient.device)
        state["mean"] = torch.zeros_like(gradient)
        state["square"] = torch.zeros_like(gradient)
        if gradient.ndim == 2:
            for side, factor in (("left", gradient @ gradient.T), ("right", gradient.T @ gradient)):
                state[side] = torch.zeros_like(factor)
                # In float64: of a gradient of low rank, LAPACK's float32 eigenvectors have come out as NaN.
                basis = torch.linalg.eigh(factor.double()).eigenvectors.flip(1)
                state[f"{side}_basis"] = basis.to(factor.dtype, memory_format=torch.contiguous_format)


@cache
def _streams(device: torch.device) -> list[torch.cuda.Stream]:
    return [torch.cuda.Stream(device) for _ in range(_STREAMS)]  # type: ignore[no-untyped-call]


def _into_basis(x: torch.Tensor, state: dict[str, torch.Tensor]) -> torch.Tensor:
    return state["left_basis"].T @ x @ state["right_basis"] if x.ndim == 2 else x


def _out_of_basis(x: torch.Tensor, state: dict[str, torch.Tensor]) -> torch.Tensor:
    return state["left_basis"] @ x @ state["right_basis"].T if x.ndim == 2 else x
