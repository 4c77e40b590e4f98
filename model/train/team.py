"""More processes for one training run on CPUs: each takes the gradient of its own patches, at the same weights."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import multiprocessing

from straightpcf.model.allocator import keep_large_buffers
from straightpcf.model.children import signals_kept
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.train.data import Batch
from straightpcf.model.train.passed import training_patches

__all__ = ["NetworkLoss", "Team"]

NetworkLoss = Callable[[StraightPCF, Batch], torch.Tensor]
_SECONDS_TO_END = 10.0
_LEADERS_OWN = (signal.SIGINT, signal.SIGTERM)  # sent to the group; the process that updates the weights heeds them


class Team:
    """Processes beside the one that updates the weights, which are moved to shared memory; for a `with`.

    seed: each member draws its own patches from [seed, its number, the iteration], so that nothing of it need be kept
    for a run that goes on; start: iterations that were made before.
    """

    def __init__(
        self,
        members: int,
        network: StraightPCF,
        trained: torch.nn.Module,
        loss: NetworkLoss,
        data: Sequence[Path],
        batch_size: int,
        seed: int,
        *,
        start: int = 0,
        passed: Sequence[Path] = (),
    ) -> None:
        network.share_memory()
        self._parameters = list(trained.parameters())
        context = multiprocessing.get_context("spawn")
        self._iteration = start
        self._members: list[tuple[Connection, torch.Tensor]] = []
        self._processes: list[BaseProcess] = []
        for number in range(1, members + 1):
            ours, theirs = context.Pipe()
            gradient = torch.zeros(sum(p.numel() for p in self._parameters))
            gradient.share_memory_()  # type: ignore[no-untyped-call]
            arguments = (theirs, network, trained, loss, gradient, data, batch_size, (seed, number), passed)
            process = context.Process(target=_work, args=arguments, daemon=True)
            with signals_kept(_LEADERS_OWN):
                process.start()
            self._processes.append(process)
            theirs.close()
            self._members.append((ours, gradient))

    def start(self, *, training: bool) -> None:
        """Set every member to work on its share; do your own meanwhile. Raises RuntimeError where one has ended."""
        self._iteration += 1
        for number, (pipe, _) in enumerate(self._members):
            try:
                pipe.send((training, self._iteration))
            except OSError:
                raise self._ended(number) from None

    def join(self, loss: torch.Tensor) -> torch.Tensor:
        """Average the gradients that the parameters have with those of all members, and the loss with theirs.

        Raises RuntimeError where a member has ended.
        """
        share = 1 / (1 + len(self._members))
        for parameter in self._parameters:
            if parameter.grad is not None:
                parameter.grad.mul_(share)
        loss = loss * share
        for number, (pipe, gradient) in enumerate(self._members):
            try:
                loss = loss + share * pipe.recv()
            except (EOFError, OSError):  # the latter where it ended before it had read what it was to do
                raise self._ended(number) from None
            at = 0
            for parameter in self._parameters:
                if parameter.grad is not None:
                    theirs = gradient[at : at + parameter.numel()]
                    parameter.grad.add_(theirs.view_as(parameter), alpha=share)
                at += parameter.numel()
        return loss

    def close(self) -> None:
        """End the members, who have nothing to lose; leaving a `with` of the team does so too."""
        for pipe, _ in self._members:
            pipe.close()
        for process in self._processes:
            process.kill()
            process.join()

    def _ended(self, number: int) -> RuntimeError:
        """Say how a member ended: as an error of its pipe it would pass for one of a file, or of stdout's reader."""
        process = self._processes[number]
        process.join(_SECONDS_TO_END)
        signalled = process.exitcode is not None and process.exitcode < 0  # as by the system, where memory runs out
        how = f"by signal {-(process.exitcode or 0)}" if signalled else "its error is above"
        return RuntimeError(f"a process that shared the batch has ended, {how}; the last state that was saved is kept")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _work(
    pipe: Connection,
    network: StraightPCF,
    trained: torch.nn.Module,
    loss_of: NetworkLoss,
    gradient: torch.Tensor,
    data: Sequence[Path],
    batch_size: int,
    seed: tuple[int, ...],
    passed: Sequence[Path],
) -> None:
    torch.set_num_threads(1)
    keep_large_buffers()
    for module in trained.modules():  # BatchNorm's statistics: of two that change them, the last would win
        for name, buffer in module.named_buffers(recurse=False):
            setattr(module, name, buffer.clone())
    source = training_patches(data, passed, network.distance_module)
    try:
        while True:
            training, iteration = pipe.recv()
            rng = np.random.default_rng((*seed, iteration))
            torch.manual_seed(int(rng.integers(2**62)))  # dropout
            trained.train(training)
            trained.zero_grad(set_to_none=True)
            loss = loss_of(network, source.draw(rng, batch_size))
            loss.backward()  # type: ignore[no-untyped-call]
            parts = [(torch.zeros_like(p) if p.grad is None else p.grad).flatten() for p in trained.parameters()]
            torch.cat(parts, out=gradient)
            pipe.send(loss.item())
    except (EOFError, OSError):  # the one who updates the weights has ended
        return
