"""A pass of the filter on a CUDA device: points go up once, patches are cut out of them there, moves come back.

Tested on the CPU, where a captured graph is a function called again, and run on an H200 (docs/kernels.md).
"""

from __future__ import annotations

import functools
import math
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import torch

from straightpcf.model.agreement import Agreement
from straightpcf.model.device import current, enough_memory
from straightpcf.model.ops import knn
from straightpcf.model.patches import PATCH_SIZE, Patches
from straightpcf.model.processor import Finish, Floats, Measure, Network, cut_out
from straightpcf.model.spread import TANGENT_NEIGHBOURS, spread_among
from straightpcf.model.survey import survey_on
from straightpcf.model.tiles import Tiling
from straightpcf.points.errors import TooLarge

__all__ = ["Capture", "Graphs", "OnDevice", "capture_cuda_graph"]

_T = TypeVar("_T")
_Item = TypeVar("_Item")
# A computation in -> how to do it again on what its inputs hold by then, and the tensor that it writes.
Capture = Callable[[Callable[[], torch.Tensor]], tuple[Callable[[], object], torch.Tensor]]

Compute = Callable[..., torch.Tensor]  # how many of a patch's points, and tensors (B, ...) -> what is made of them
_Key = tuple[int, int, int]  # patches, rows, tensors
_BATCH = 32
_ROWS = 64  # counts of rows are rounded up to a multiple: few shapes, and a graph for each
_ASKED = 8  # so are those of patches of which only d is asked
_MOST_GRAPHS = 16
_IN_FLIGHT = 2  # batches of which the results have not been read
_MOST_THREADS = 8  # of the CPU, beside the device: numpy's threads wait for each other the more the more they are


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
    """A computation on patches replayed as a graph from the second time on that a shape of full patches comes.

    A velocity evaluation is some forty kernels of a few microseconds; launching each takes the host as long. The first
    call of a shape compiles and sets up what a capture must not; where capturing fails, all goes on without graphs.
    """

    def __init__(self, compute: Compute, capture: Capture) -> None:
        self._compute, self._capture = compute, capture
        self._seen: set[_Key] = set()
        self._graphs: dict[_Key, tuple[list[torch.Tensor], Callable[[], object], torch.Tensor]] = {}
        self._broken = False

    def __call__(self, rows: int, *given: torch.Tensor) -> torch.Tensor:
        """Compute for the first `rows` points of patches given[0] (B, P, 3), or some more.

        The next call may overwrite the result.
        """
        rows = min(given[0].shape[1], _ROWS * math.ceil(rows / _ROWS))
        key = (len(given[0]), rows, len(given))
        if key not in self._graphs:
            worth = given[0].shape[1] == PATCH_SIZE and not self._broken
            if not worth or key not in self._seen:
                self._seen.add(key)
                return self._compute(rows, *given)
            if len(self._graphs) == _MOST_GRAPHS:
                del self._graphs[next(iter(self._graphs))]
            inputs = [tensor.clone() for tensor in given]
            try:
                self._graphs[key] = (inputs, *self._capture(partial(self._compute, rows, *inputs)))
            except torch.OutOfMemoryError:
                raise
            except RuntimeError as exc:
                warnings.warn(f"the network is not captured as a CUDA graph, it runs without: {exc}", stacklevel=2)
                self._broken = True
                return self._compute(rows, *given)
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
        network: Network,
        device: str,
        *,
        threads: int = 1,
        batch: int = _BATCH,
        capture: Capture = capture_cuda_graph,
    ) -> None:
        """Take the network; batch: patches at once, halved when memory runs out; threads: of the CPU, at most."""
        self.device, self.batch, self._network = torch.device(device), batch, network
        self._begins = Graphs(self._begin, capture)
        self._moves = Graphs(self._move, capture)
        self._asked = Graphs(self._say, capture)
        self._pool = ThreadPoolExecutor(min(threads, _MOST_THREADS))

    def displacements(
        self, positions: Floats, cut: Patches, scales: Floats, known_distances: Mapping[int, float], finish: Finish[_T],
        *, agree: bool,
    ) -> Iterator[_T | None]:  # fmt: skip
        """Do what a Processor does; while the device computes a batch, the results of the one before are read.

        Raises TooLarge where it has no memory for one patch.
        """
        # A batch makes as many rows as its patch that owns most: those that own about as many go together.
        order = np.argsort(cut.owned, kind="stable")
        cut, scales = cut[order], scales[order]
        places = enumerate(order.tolist())
        known = {place: known_distances[patch] for place, patch in places if patch in known_distances}
        points, sent = self._sent(positions, cut, scales, known)
        heard: _Heard | None = None
        if agree:
            with current(self.device), enough_memory(self.device, len(positions)):
                heard = _Heard(len(points), sent)
            for some in self._batched(cut, partial(self._hear, points, sent, heard)):
                yield from [None] * some
        waiting: deque[tuple[range, _Result]] = deque()
        first = 0
        while first < len(cut.seeds):
            chosen = range(first, min(first + self.batch, len(cut.seeds)))
            try:
                with current(self.device):
                    moves = self._launch(points, cut, sent, chosen, heard)
                    waiting.append((chosen, _Result(moves[: len(chosen)])))
            except torch.OutOfMemoryError as exc:
                self._halve(cut, exc)
                continue
            first = chosen.stop
            if len(waiting) == _IN_FLIGHT:
                yield from self._finished(*waiting.popleft(), cut, order, finish)
        for batch, result in waiting:
            yield from self._finished(batch, result, cut, order, finish)

    @torch.inference_mode()
    def distances(self, positions: Floats, cut: Patches, scales: Floats) -> Floats:
        """Return what the DistanceModule says of each patch: (M,). Raises TooLarge as `displacements` does."""
        points, sent = self._sent(positions, cut, scales, {})
        with current(self.device):
            found = list(self._batched(cut, partial(self._ask, points, sent)))
        distances: Floats = torch.cat(found).flatten().double().cpu().numpy()
        return distances

    def _ask(self, points: torch.Tensor, sent: _DeviceCut, some: slice) -> torch.Tensor:
        """Return what the DistanceModule says of some patches: (n, 1)."""
        chosen = range(len(sent.seeds))[some]
        full = min(self.batch, _ASKED * math.ceil(len(chosen) / _ASKED))
        x = sent.cut_out(points, self._filled(chosen, full))
        return self._asked(x.shape[1], x)[: len(chosen)].clone()

    @torch.inference_mode()
    def spread(self, positions: Floats, tiling: Tiling, limit: float, rounds: int) -> Floats:
        """Spread points (N, 3) along the surface, each among the patch that owned it; tiling: of the pass before.

        Raises TooLarge where it has no memory for them.
        """
        with current(self.device), enough_memory(self.device, len(positions)):
            points = torch.from_numpy(positions).to(self.device)
            around = self._around(points, tiling, TANGENT_NEIGHBOURS)
            moved: Floats = spread_among(points, around, limit, rounds=rounds).cpu().numpy()
        return moved

    @torch.inference_mode()
    def spacings(self, positions: Floats, tiling: Tiling, count: int) -> tuple[Floats, Floats]:
        """Look for the neighbours of each point in the patch that owns it. Raises TooLarge as `spread` does."""
        with current(self.device), enough_memory(self.device, len(positions)):
            points = torch.from_numpy(positions).to(self.device)
            around = self._around(points, tiling, count).long()
            reach = (points[around[:, -1]] - points).norm(dim=1)
            rising, found = reach[around].sort(dim=1).values, around.shape[1]
            among = (rising[:, (found - 1) // 2] + rising[:, found // 2]) / 2
            return reach.cpu().numpy(), among.cpu().numpy()

    def mapper(self, function: Callable[[_Item], _T], items: Iterable[_Item], /) -> Iterable[_T]:
        """Call it with one after the other: the device works on each."""
        return map(function, items)

    def survey(self, positions: Floats, patches: Patches, measure: Measure[_T], /) -> Iterable[_T]:
        """Look at all patches at once. Raises TooLarge where the device has no memory for them."""
        return survey_on(self.device, positions, patches, measure)

    def _sent(
        self, positions: Floats, cut: Patches, scales: Floats, known_distances: Mapping[int, float]
    ) -> tuple[torch.Tensor, _DeviceCut]:
        with current(self.device), enough_memory(self.device, len(positions)):
            return torch.from_numpy(positions).to(self.device), _DeviceCut.of(cut, scales, known_distances, self.device)

    def _around(self, points: torch.Tensor, tiling: Tiling, count: int) -> torch.Tensor:
        """Return the rows of the points nearest to each, as many as there are in a patch: (N, count) int32."""
        nearest = min(count, PATCH_SIZE - 1, len(points) - 1)
        around = torch.empty(len(points), nearest, dtype=torch.int32, device=self.device)
        for cut in tiling.cuts():
            sent = _DeviceCut.of(cut, np.ones(len(cut.seeds)), {}, self.device)
            for _ in self._batched(cut, partial(_look_around, points, cut, sent, around)):
                pass
        return around

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
        self._begins.clear()
        self._moves.clear()
        self._asked.clear()
        torch.cuda.empty_cache()

    def _finished(
        self, batch: range, result: _Result, cut: Patches, order: npt.NDArray[np.int64], finish: Finish[_T]
    ) -> Iterator[_T]:
        moves = result.read().astype(np.float64)
        owned = (move[: cut.owned[place]] for place, move in zip(batch, moves, strict=True))
        yield from self._pool.map(finish, order[batch].tolist(), owned)

    @torch.inference_mode()
    def _hear(self, points: torch.Tensor, sent: _DeviceCut, heard: _Heard, some: slice) -> int:
        """Have the first evaluation of some patches made, and return how many they are."""
        chosen = range(len(sent.seeds))[some]
        batch = self._filled(chosen, self._full(sent, chosen))
        x = sent.cut_out(points, batch)
        said = self._begins(x.shape[1], x, *sent.known_of(chosen, batch))[: len(chosen)]
        heard.add(slice(chosen.start, chosen.stop), x[: len(chosen)], said)
        return len(chosen)

    def _say(self, rows: int, x: torch.Tensor) -> torch.Tensor:
        return self._network.distance(x)

    def _begin(self, rows: int, x: torch.Tensor, *known: torch.Tensor) -> torch.Tensor:
        """Return the first evaluation's velocities and, as one more point, three times d: (B, P + 1, 3)."""
        distance = known[0] if known else self._network.distance(x)
        return torch.cat([self._network.begin(x), distance[:, :, None].expand(-1, -1, 3)], dim=1)

    def _move(self, rows: int, x: torch.Tensor, owned: torch.Tensor, *known: torch.Tensor) -> torch.Tensor:
        """Return how far points move; known: d, and the first evaluation's velocities and what takes their place."""
        first = (known[1], known[2]) if len(known) > 1 else None
        return self._network.forward(x, owned, known[0] if known else None, first, rows)

    @torch.inference_mode()
    def _launch(
        self, points: torch.Tensor, cut: Patches, sent: _DeviceCut, chosen: range, heard: _Heard | None
    ) -> torch.Tensor:
        batch = self._filled(chosen, self._full(sent, chosen))
        known = sent.known_of(chosen, batch) if heard is None else heard.of_patches(batch)
        rows = max(1, int(cut.owned[chosen.start : chosen.stop].max()))
        return self._moves(rows, sent.cut_out(points, batch), sent.owned[batch], *known)

    def _full(self, sent: _DeviceCut, chosen: range) -> int:
        return self.batch if len(sent.seeds) > self.batch else len(chosen)

    def _filled(self, chosen: range, full: int) -> torch.Tensor:
        # A batch that is not full is filled up with its last patch: one shape more would be one graph more.
        return torch.arange(chosen.start, chosen.start + full, device=self.device).clamp(max=chosen.stop - 1)


@dataclass(frozen=True)
class _DeviceCut:
    """A cut and what goes with it, on the device: sent up once, for every batch of it.

    known: (M,), on the host, of which patches `known_distances`, (M, 1), holds what the DistanceModule said; index:
    (M, P), seeds, owned, radii: (M,), as in Patches; scales: (M,).
    """

    known: npt.NDArray[np.bool_]
    index: torch.Tensor
    seeds: torch.Tensor
    owned: torch.Tensor
    radii: torch.Tensor
    scales: torch.Tensor
    known_distances: torch.Tensor

    @classmethod
    def of(cls, cut: Patches, scales: Floats, known_distances: Mapping[int, float], device: torch.device) -> _DeviceCut:
        said = np.array([[known_distances.get(patch, np.nan)] for patch in range(len(cut.seeds))], dtype=np.float32)
        parts = (
            torch.from_numpy(part).to(device) for part in (cut.index, cut.seeds, cut.owned, cut.radii, scales, said)
        )
        return cls(~np.isnan(said[:, 0]), *parts)

    def cut_out(self, points: torch.Tensor, batch: torch.Tensor | slice) -> torch.Tensor:
        """Cut some patches out of the points."""
        return cut_out(points, self.index[batch], self.seeds[batch], self.scales[batch])

    def known_of(self, chosen: range, batch: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the distances of the patches `batch`, where those of all that are chosen are known."""
        return (self.known_distances[batch],) if self.known[chosen.start : chosen.stop].all() else ()


class _Heard:
    """What the patches of a cut said in their first evaluation, on the device."""

    def __init__(self, count: int, sent: _DeviceCut) -> None:
        """Make place for all patches of a cloud of `count` points."""
        patches, points = sent.index.shape
        self._agreement = Agreement(count, sent.index, sent.scales, sent.radii)
        self._said = torch.empty(patches, points + 1, 3, dtype=torch.float32, device=sent.index.device)

    def add(self, some: slice, x: torch.Tensor, said: torch.Tensor) -> None:
        """Hear some of the patches, x (B, P, 3); said: what `OnDevice._begin` returned, (B, P + 1, 3)."""
        self._agreement.add(some, x, said[:, :-1], said[:, -1, :1])
        self._said[some] = said

    def of_patches(self, batch: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return what `OnDevice._move` takes of some patches: their d, and both velocities."""
        said = self._said[batch]
        distance = said[:, -1, :1]
        return distance, said[:, :-1], self._agreement.velocities(batch, distance)


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
