"""A pass of the filter on the CPU: patches side by side, one a thread."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch

from straightpcf.model.agreement import Agreement
from straightpcf.model.patches import Patches
from straightpcf.model.processor import Finish, Floats, Measure, Network, cut_out
from straightpcf.model.spread import spread
from straightpcf.model.survey import survey
from straightpcf.model.tiles import Tiling

__all__ = ["OnHost"]

_T = TypeVar("_T")
_Item = TypeVar("_Item")


class OnHost:
    """The Processor of the CPU, on threads of its own."""

    def __init__(self, network: Network, threads: int) -> None:
        self._network, self._threads = network, threads
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0
        self.heed: Callable[[], None] | None = None  # called again and again while there is work; see `Filter.heeding`

    def __getstate__(self) -> dict[str, Any]:
        """Leave the threads behind where a filter is handed to another process, or copied."""
        return {**self.__dict__, "_pool": None, "heed": None}

    def displacements(
        self, positions: Floats, cut: Patches, scales: Floats, known_distances: Mapping[int, float], finish: Finish[_T],
        *, agree: bool,
    ) -> Iterator[_T | None]:  # fmt: skip
        """Evaluate few patches ahead, so that a slow reader does not fill the memory."""
        points = torch.from_numpy(positions)
        parts = (torch.from_numpy(part) for part in (cut.index, scales, cut.radii))
        agreement = Agreement(len(points), *parts) if agree else None
        heard: list[tuple[torch.Tensor, torch.Tensor]] = []  # of each patch its own points' first velocities, and d

        def known(patch: int) -> torch.Tensor | None:
            return torch.tensor([[known_distances[patch]]], dtype=torch.float32) if patch in known_distances else None

        def begin(joined: Agreement, patch: int) -> tuple[torch.Tensor, ...]:
            x, distance = _cut_out(points, cut, scales, patch), known(patch)
            velocities, distance = self._network.begin(x), self._network.distance(x) if distance is None else distance
            weighed = joined.weighed(slice(patch, patch + 1), x, velocities, distance)
            return *weighed, velocities[:, : max(1, int(cut.owned[patch]))].clone(), distance

        def move(patch: int) -> _T:
            x, owned = _cut_out(points, cut, scales, patch), int(cut.owned[patch])
            distance, first = known(patch), None
            if agreement is not None:
                velocities, distance = heard[patch]
                first = velocities, agreement.velocities(slice(patch, patch + 1), distance)
            moved = self._network.forward(x, torch.tensor([owned]), distance, first, max(1, owned))[0, :owned]
            return finish(patch, moved.double().numpy())

        every = range(len(cut.seeds))
        if agreement is not None:
            for places, said, velocities, distance in self.mapper(partial(begin, agreement), every):
                agreement.add_weighed(places, said)
                heard.append((velocities, distance))
                yield None
        yield from self.mapper(move, every)

    def distances(self, positions: Floats, cut: Patches, scales: Floats) -> Floats:
        """Return what the DistanceModule says of each patch: (M,)."""
        points = torch.from_numpy(positions)

        def read(patch: int) -> float:
            return float(self._network.distance(_cut_out(points, cut, scales, patch)))

        return np.array(list(self.mapper(read, range(len(cut.seeds)))))

    def spread(self, positions: Floats, tiling: Tiling, limit: float, rounds: int) -> Floats:
        """Spread tile by tile, the halo around."""
        moved = np.empty_like(positions)
        for rows, own in tiling.surroundings():
            near = spread(positions[rows], limit, rounds=rounds, workers=self._threads, mapper=self.mapper)
            moved[rows[:own]] = near[:own]
        return moved

    def spacings(self, positions: Floats, tiling: Tiling, count: int) -> None:
        """Leave that to a tree."""

    def survey(self, positions: Floats, patches: Patches, measure: Measure[_T], /) -> Iterable[_T]:
        """Look at some patches at a time, each time on a thread."""
        return survey(positions, patches, measure, mapper=self.mapper)

    def mapper(self, function: Callable[[_Item], _T], items: Iterable[_Item], /) -> Iterator[_T]:
        """Map in order, few results waiting."""
        pool = self._own_pool()
        waiting: deque[Future[_T]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(_inference, function, item))
                if len(waiting) >= 2 * self._threads:
                    yield self._awaited(waiting.popleft())
            while waiting:
                yield self._awaited(waiting.popleft())
        finally:
            for future in waiting:
                future.cancel()

    def _awaited(self, coming: Future[_T]) -> _T:
        result = coming.result()
        if self.heed is not None:
            self.heed()
        return result

    def _own_pool(self) -> ThreadPoolExecutor:
        """Return the threads of this process: a fork has none of its parent's."""
        if self._pool is None or self._process != os.getpid():
            self._pool, self._process = ThreadPoolExecutor(self._threads, initializer=_one_thread), os.getpid()
        return self._pool


def _cut_out(points: torch.Tensor, cut: Patches, scales: Floats, patch: int) -> torch.Tensor:
    some = slice(patch, patch + 1)
    return cut_out(points, *(torch.from_numpy(part[some]) for part in (cut.index, cut.seeds, scales)))


def _one_thread() -> None:
    # Inside a patch more threads would only wait for each other.
    torch.set_num_threads(1)


def _inference(function: Callable[[_Item], _T], item: _Item) -> _T:
    with torch.inference_mode():  # the mode belongs to a thread
        return function(item)
