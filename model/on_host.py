"""A pass of the filter on the CPU: patches side by side, one a thread."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import numpy as np
import torch

from straightpcf.model.patches import Patches
from straightpcf.model.processor import Finish, Floats, Forward, cut_out
from straightpcf.model.spread import spread
from straightpcf.model.tiles import Tiling

__all__ = ["OnHost"]

_T = TypeVar("_T")
_Item = TypeVar("_Item")


class OnHost:
    """The Processor of the CPU, on threads of its own."""

    def __init__(self, forward: Forward, distances: Callable[[torch.Tensor], torch.Tensor], threads: int) -> None:
        self._forward, self._distances, self._threads = forward, distances, threads
        self._pool = ThreadPoolExecutor(threads, initializer=_one_thread)

    def displacements(
        self, positions: Floats, cut: Patches, scales: Floats, known_distances: Mapping[int, float], finish: Finish[_T]
    ) -> Iterator[_T]:
        """Evaluate few patches ahead, so that a slow reader does not fill the memory."""
        points = torch.from_numpy(positions)

        def move(patch: int) -> _T:
            known = known_distances.get(patch)
            distance = None if known is None else torch.tensor([[known]])
            owned = int(cut.owned[patch])
            x = _cut_out(points, cut, scales, patch)
            moved = self._forward(x, torch.tensor([owned]), distance, max(1, owned))[0, :owned]
            return finish(patch, moved.double().numpy())

        yield from self.mapper(move, range(len(cut.seeds)))

    def distances(self, positions: Floats, cut: Patches, scales: Floats) -> Floats:
        """Return what the DistanceModule says of each patch: (M,)."""
        points = torch.from_numpy(positions)

        def read(patch: int) -> float:
            return float(self._distances(_cut_out(points, cut, scales, patch)))

        return np.array(list(self.mapper(read, range(len(cut.seeds)))))

    def spread(self, positions: Floats, tiling: Tiling, limit: float) -> Floats:
        """Spread tile by tile, the halo around."""
        moved = np.empty_like(positions)
        for rows, own in tiling.surroundings():
            moved[rows[:own]] = spread(positions[rows], limit, workers=self._threads, mapper=self.mapper)[:own]
        return moved

    def mapper(self, function: Callable[[_Item], _T], items: Iterable[_Item]) -> Iterator[_T]:
        """Map in order, few results waiting."""
        waiting: deque[Future[_T]] = deque()
        try:
            for item in items:
                waiting.append(self._pool.submit(_inference, function, item))
                if len(waiting) >= 2 * self._threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def _cut_out(points: torch.Tensor, cut: Patches, scales: Floats, patch: int) -> torch.Tensor:
    some = slice(patch, patch + 1)
    return cut_out(points, *(torch.from_numpy(part[some]) for part in (cut.index, cut.seeds, scales)))


def _one_thread() -> None:
    # Inside a patch more threads would only wait for each other.
    torch.set_num_threads(1)


def _inference(function: Callable[[_Item], _T], item: _Item) -> _T:
    with torch.inference_mode():  # the mode belongs to a thread
        return function(item)
