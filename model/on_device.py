"""A pass of the filter on a CUDA device: points go up once, patches are cut out of them there, moves come back.

Written and tested on the CPU, where a captured graph is a function called again; not yet run on a GPU
(docs/kernels.md).
"""

from __future__ import annotations

import functools
import math
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import torch

from straightpcf.model.device import current, enough_memory
from straightpcf.model.ops import knn
from straightpcf.model.patches import PATCH_SIZE, Patches
from straightpcf.model.processor import Finish, Floats, Forward, Mapper, cut_out
from straightpcf.model.spread import TANGENT_NEIGHBOURS, spread_among
from straightpcf.model.tiles import Tiling
from straightpcf.points.errors import TooLarge

__all__ = ["Capture", "Graphs", "OnDevice", "capture_cuda_graph"]

_T = TypeVar("_T")
# A computation in -> how to do it again on what its inputs hold by then, and the tensor that it writes.
Capture = Callable[[Callable[[], torch.Tensor]], tuple[Callable[[], object], torch.Tensor]]

_BATCH = 32
_ROWS = 128  # counts of rows are rounded up to a multiple: few shapes, and a graph for each
_MOST_GRAPHS = 16
_IN_FLIGHT = 2  # batches of which the results have not been read


def capture_cuda_graph(run: Callable[[], torch.Tensor]) -> tuple[Callable[[], object], torch.Tensor]:
    """Capture one run of a computation, which has run before, as a CUDA graph."""
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.current_stream()
    try:
        side = _capture_stream(torch.cuda.current_device())
        with torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"):
            out = run()
    finally:
        torch.cuda.set_stream(stream)  # a capture that fails leaves its own current
    return graph.replay, out


@functools.cache
def _capture_stream(device: int) -> torch.cuda.Stream:
    """Return the stream of a device on which all captures are made: cuBLAS keeps a workspace for every stream.

    torch's own stream for captures is on the device of a process's first capture.
    """
    return torch.cuda.Stream(device)  # type: ignore[no-untyped-call]


class Graphs:
    """A Forward replayed as a graph from the second time on that a shape of full patches comes.

    A velocity evaluation is some forty kernels of a few microseconds; launching each takes the host as long. The first
    call of a shape compiles and sets up what a capture must not; where capturing fails, all goes on without graphs.
    """

    def __init__(self, forward: Forward, capture: Capture) -> None:
        self._forward, self._capture = forward, capture
        self._seen: set[tuple[int, int, bool]] = set()
        self._graphs: dict[
            tuple[int, int, bool], tuple[list[torch.Tensor], Callable[[], object], torch.Tensor]
        ] = {}  # fmt: skip
        self._broken = False

    def __call__(self, x: torch.Tensor, owned: torch.Tensor, distance: torch.Tensor | None, rows: int) -> torch.Tensor:
        """Do what the Forward does; the next call may overwrite the result, of at least `rows` rows."""
        rows = min(x.shape[1], _ROWS * math.ceil(rows / _ROWS))
        key = (len(x), rows, distance is not None)
        given = [x, owned] if distance is None else [x, owned, distance]
        if key not in self._graphs:
            worth = x.shape[1] == PATCH_SIZE and not self._broken
            if not worth or key not in self._seen:
                self._seen.add(key)
                return self._forward(x, owned, distance, rows)
            if len(self._graphs) == _MOST_GRAPHS:
                del self._graphs[next(iter(self._graphs))]
            inputs = [tensor.clone() for tensor in given]
            again = partial(self._forward, inputs[0], inputs[1], None if distance is None else inputs[2], rows)
            try:
                self._graphs[key] = (inputs, *self._capture(again))
            except torch.OutOfMemoryError:
                raise
            except RuntimeError as exc:
                warnings.warn(f"the network is not captured as a CUDA graph, it runs without: {exc}", stacklevel=2)
                self._broken = True
                return self._forward(x, owned, distance, rows)
        inputs, replay, out = self._graphs[key] = self._graphs.pop(key)  # the one used last is given up last
        for static, fresh in zip(inputs, given, strict=True):
            static.copy_(fresh)
        replay()
        return out

    def clear(self) -> None:
        """Give the graphs' memory back."""
        self._graphs.clear()


class OnDevice:
    """The Processor of a device; for one thread at a time."""

    def __init__(
        self,
        forward: Forward,
        distances: Callable[[torch.Tensor], torch.Tensor],
        device: str,
        *,
        threads: int = 1,
        batch: int = _BATCH,
        capture: Capture = capture_cuda_graph,
    ) -> None:
        """Take the network's two parts; batch: patches at once, halved when memory runs out; threads: of the CPU."""
        self.device, self.batch = torch.device(device), batch
        self._distances, self._graphs = distances, Graphs(forward, capture)
        self._pool = ThreadPoolExecutor(threads)
        self.mapper: Mapper = self._pool.map

    def displacements(
        self, positions: Floats, cut: Patches, scales: Floats, known_distances: Mapping[int, float], finish: Finish[_T]
    ) -> Iterator[_T]:
        """Do what a Processor does; while the device computes a batch, the results of the one before are read.

        Raises TooLarge where it has no memory for one patch.
        """
        points, sent = self._sent(positions, cut, scales, known_distances)
        waiting: deque[tuple[range, _Result]] = deque()
        first = 0
        while first < len(cut.seeds):
            chosen = range(first, min(first + self.batch, len(cut.seeds)))
            try:
                with current(self.device):
                    moves = self._launch(points, cut, sent, chosen)
                    waiting.append((chosen, _Result(moves[: len(chosen)])))
            except torch.OutOfMemoryError as exc:
                self._halve(cut, exc)
                continue
            first = chosen.stop
            if len(waiting) == _IN_FLIGHT:
                yield from self._finished(*waiting.popleft(), cut, finish)
        for batch, result in waiting:
            yield from self._finished(batch, result, cut, finish)

    @torch.inference_mode()
    def distances(self, positions: Floats, cut: Patches, scales: Floats) -> Floats:
        """Return what the DistanceModule says of each patch: (M,). Raises TooLarge as `displacements` does."""
        points, sent = self._sent(positions, cut, scales, {})
        with current(self.device):
            found = list(self._batched(cut, lambda batch: self._distances(sent.cut_out(points, batch))))
        distances: Floats = torch.cat(found).flatten().double().cpu().numpy()
        return distances

    @torch.inference_mode()
    def spread(self, positions: Floats, tiling: Tiling, limit: float) -> Floats:
        """Spread points (N, 3) along the surface, each among the patch that owned it; tiling: of the pass before.

        Raises TooLarge where it has no memory for them.
        """
        nearest = min(TANGENT_NEIGHBOURS, PATCH_SIZE - 1, len(positions) - 1)
        with current(self.device), enough_memory(self.device, len(positions)):
            points = torch.from_numpy(positions).to(self.device)
            around = torch.empty(len(points), nearest, dtype=torch.int32, device=self.device)
            for cut in tiling.cuts():
                sent = _DeviceCut.of(cut, np.ones(len(cut.seeds)), {}, self.device)
                for _ in self._batched(cut, partial(_look_around, points, cut, sent, around)):
                    pass
            moved: Floats = spread_among(points, around, limit).cpu().numpy()
        return moved

    def _sent(
        self, positions: Floats, cut: Patches, scales: Floats, known_distances: Mapping[int, float]
    ) -> tuple[torch.Tensor, _DeviceCut]:
        with current(self.device), enough_memory(self.device, len(positions)):
            return torch.from_numpy(positions).to(self.device), _DeviceCut.of(cut, scales, known_distances, self.device)

    def _batched(self, cut: Patches, call: Callable[[slice], _T]) -> Iterator[_T]:
        """Call with batch after batch of a cut's patches, with halves where memory runs out."""
        first = 0
        while first < len(cut.seeds):
            batch = slice(first, first + self.batch)
            try:
                made = call(batch)
            except torch.OutOfMemoryError as exc:
                self._halve(cut, exc)
                continue
            first = batch.stop
            yield made

    def _halve(self, cut: Patches, exc: torch.OutOfMemoryError) -> None:
        if self.batch == 1:
            raise TooLarge(f"{self.device} has no memory for a patch of {cut.index.shape[1]} points") from exc
        self.batch //= 2
        self._graphs.clear()
        torch.cuda.empty_cache()

    def _finished(self, batch: range, result: _Result, cut: Patches, finish: Finish[_T]) -> Iterator[_T]:
        moves = result.read().astype(np.float64)
        owned = (move[: cut.owned[patch]] for patch, move in zip(batch, moves, strict=True))
        yield from self._pool.map(finish, batch, owned)

    @torch.inference_mode()
    def _launch(self, points: torch.Tensor, cut: Patches, sent: _DeviceCut, chosen: range) -> torch.Tensor:
        # A last batch that is not full is filled up with its last patch: one shape more would be one graph more.
        full = self.batch if len(cut.seeds) > self.batch else len(chosen)
        batch = torch.arange(chosen.start, chosen.start + full, device=self.device).clamp(max=chosen.stop - 1)
        some = slice(chosen.start, chosen.stop)
        distance = sent.known_distances[batch] if sent.known[some].all() else None
        rows = max(1, int(cut.owned[some].max()))
        return self._graphs(sent.cut_out(points, batch), sent.owned[batch], distance, rows)


@dataclass(frozen=True)
class _DeviceCut:
    """A cut and what goes with it, on the device: sent up once, for every batch of it.

    known: (M,), on the host, of which patches `known_distances`, (M, 1), holds what the DistanceModule said; index:
    (M, P), seeds, owned: (M,), as in Patches; scales: (M,).
    """

    known: npt.NDArray[np.bool_]
    index: torch.Tensor
    seeds: torch.Tensor
    owned: torch.Tensor
    scales: torch.Tensor
    known_distances: torch.Tensor

    @classmethod
    def of(cls, cut: Patches, scales: Floats, known_distances: Mapping[int, float], device: torch.device) -> _DeviceCut:
        said = np.array([[known_distances.get(patch, np.nan)] for patch in range(len(cut.seeds))], dtype=np.float32)
        parts = (torch.from_numpy(part).to(device) for part in (cut.index, cut.seeds, cut.owned, scales, said))
        return cls(~np.isnan(said[:, 0]), *parts)

    def cut_out(self, points: torch.Tensor, batch: torch.Tensor | slice) -> torch.Tensor:
        """Cut some patches out of the points."""
        return cut_out(points, self.index[batch], self.seeds[batch], self.scales[batch])


def _look_around(points: torch.Tensor, cut: Patches, sent: _DeviceCut, around: torch.Tensor, batch: slice) -> None:
    """Write the rows of the points nearest to each that some patches own into around (N, k), nearest first."""
    x, index, owned = sent.cut_out(points, batch), sent.index[batch], sent.owned[batch]
    rows = max(1, int(cut.owned[batch].max()))
    patch, row = (torch.arange(rows, device=points.device) < owned[:, None]).nonzero(as_tuple=True)
    found = knn(x, around.shape[1], rows)[patch, row].long()  # (n, k), in any order
    far = (x[patch[:, None], found] - x[patch, row][:, None]).square().sum(dim=2)
    found = found.gather(1, far.argsort(dim=1))
    around[index[patch, row].long()] = index[patch[:, None], found]


class _Result:
    """A batch's moves on their way into page-locked memory."""

    def __init__(self, moves: torch.Tensor) -> None:
        self._host = torch.empty(moves.shape, dtype=moves.dtype, pin_memory=moves.is_cuda)
        self._host.copy_(moves, non_blocking=True)
        self._there = torch.cuda.Event() if moves.is_cuda else None  # type: ignore[no-untyped-call]
        if self._there is not None:
            self._there.record()

    def read(self) -> npt.NDArray[np.float32]:
        if self._there is not None:
            self._there.synchronize()
        return self._host.numpy()
