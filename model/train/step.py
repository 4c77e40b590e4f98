"""One training iteration: eager on the host, one captured graph on CUDA."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from straightpcf.model.train.data import Batch, PatchSource
from straightpcf.model.train.device_data import DevicePatchSource
from straightpcf.model.train.soap import SOAP
from straightpcf.model.train.team import Team

__all__ = ["GraphedStep", "HostStep", "Step"]

GRADIENT_NORM = 1.0
_EAGER_STEPS = 3  # before the capture, so that every buffer and workspace is there

Loss = Callable[[Batch], torch.Tensor]
Step = Callable[[float], torch.Tensor]  # learning rate -> loss, a tensor that the next step may overwrite


class HostStep:
    """Draw on the host with `rng`, then run eagerly, a team taking its share of the batch."""

    def __init__(
        self,
        source: PatchSource,
        loss: Loss,
        trained: torch.nn.Module,
        optimiser: SOAP,
        rng: np.random.Generator,
        batch_size: int,
        team: Team | None = None,
    ) -> None:
        self._team = team
        self._draw: Callable[[], Batch] = lambda: source.draw(rng, batch_size)
        self._loss, self._trained, self._optimiser = loss, trained, optimiser

    def __call__(self, learning_rate: float) -> torch.Tensor:
        """Make one update."""
        for group in self._optimiser.param_groups:
            group["lr"] = learning_rate
        if self._team is not None:
            self._team.start(training=self._trained.training)
        return _update(self._draw(), self._loss, self._trained, self._optimiser, self._team)


class GraphedStep:
    """Draw, evaluate and update in one CUDA graph: a replay an iteration, and no Python inside it."""

    def __init__(
        self,
        source: PatchSource,
        loss: Loss,
        trained: torch.nn.Module,
        optimiser: SOAP,
        device: torch.device,
        batch_size: int,
    ) -> None:
        self._source = DevicePatchSource(source, device)
        self._rate = torch.zeros((), device=device)
        for group in optimiser.param_groups:
            group["lr"] = self._rate  # a graph reads it from memory
        self._eager_left = _EAGER_STEPS
        self._graph: torch.cuda.CUDAGraph | None = None
        self._side: torch.cuda.Stream | None = None  # one: each keeps the memory of an iteration
        self._result = torch.zeros((), device=device)
        self._run: Callable[[], torch.Tensor] = lambda: _update(self._source.draw(batch_size), loss, trained, optimiser)

    def __call__(self, learning_rate: float) -> torch.Tensor:
        """Make one update; the first few run eagerly on a side stream, then one is captured."""
        self._rate.fill_(learning_rate)
        if self._graph is not None:
            self._graph.replay()
        elif self._eager_left > 0:
            self._eager_left -= 1
            side = self._side = self._side or torch.cuda.Stream()  # type: ignore[no-untyped-call]
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                self._result = self._run()
            torch.cuda.current_stream().wait_stream(side)
        else:
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self._result = self._run()
            self._graph.replay()  # capturing only records
        return self._result


def _update(
    batch: Batch, loss_of: Loss, trained: torch.nn.Module, optimiser: SOAP, team: Team | None = None
) -> torch.Tensor:
    optimiser.zero_grad(set_to_none=True)
    loss = loss_of(batch)
    loss.backward()  # type: ignore[no-untyped-call]
    loss = loss.detach() if team is None else team.join(loss.detach())
    torch.nn.utils.clip_grad_norm_(trained.parameters(), GRADIENT_NORM)
    optimiser.step()
    return loss
