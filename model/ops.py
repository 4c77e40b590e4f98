"""Neighbour search and the EdgeConv maximum: the plain torch definitions, and the choice of a faster path."""

from __future__ import annotations

import torch

from straightpcf.model.kernels import cpu

__all__ = ["edge_max", "edge_max_torch", "knn", "knn_torch", "squared_distances"]

_DIRECT = 8  # of fewer channels distances are differences, and products are exact


def knn(x: torch.Tensor, k: int, rows: int | None = None) -> torch.Tensor:
    """Find each point's k nearest others inside its patch.

    x: (B, P, C) float32, P > 1; rows: only for the first `rows` points, all if None.
    Returns (B, rows, k) indices into P in any order, int32 from the kernels and int64 from torch. k > P - 1 repeats
    the farthest.
    """
    rows = x.shape[1] if rows is None else rows
    if x.is_cuda:
        from straightpcf.model.kernels import cuda

        if x.shape[1] <= cuda.MOST_POINTS and k <= cuda.MOST_NEIGHBOURS and cuda.load():
            return cuda.knn(x.detach(), k, rows)
    library = cpu.load() if x.device.type == "cpu" and x.dtype == torch.float32 and k <= 64 else None
    return knn_torch(x, k, rows) if library is None else cpu.knn(library, x, k, rows)


def knn_torch(x: torch.Tensor, k: int, rows: int) -> torch.Tensor:
    """Do what `knn` does with a full distance matrix and `torch.topk`."""
    x = x.detach()
    if x.shape[2] < _DIRECT:  # exact differences where they are cheap
        distance = squared_distances(x[:, :rows], x)
    else:
        distance = torch.cdist(x[:, :rows], x, compute_mode="use_mm_for_euclid_dist")
    distance.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    found = min(k, x.shape[1] - 1)
    index = distance.topk(found, dim=2, largest=False).indices
    return index if found == k else torch.cat([index, index[:, :, -1:].expand(-1, -1, k - found)], dim=2)


def squared_distances(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return |a_i - b_j|^2, (..., A, B), of points (..., A, C) and (..., B, C), as a sum of C squared differences.

    `torch.cdist` without products gives each of them a block of threads of its own on a GPU.
    """
    first, *others = range(a.shape[-1])
    distance = (a[..., :, None, first] - b[..., None, :, first]).square_()
    for axis in others:
        apart = a[..., :, None, axis] - b[..., None, :, axis]
        distance.addcmul_(apart, apart)
    return distance


def edge_max(a: torch.Tensor, b: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Take the maximum over a point's edges of the second layer of an EdgeConv.

    a: (B, M, C) the point's own share of the first layer; b: (B, P, C) its neighbours' share;
    index: (B, M, k) into P; weight: (D, C). Returns (B, M, D): max_n weight @ relu(a_i + b_index[i, n]).
    """
    want_grad = torch.is_grad_enabled() and any(t.requires_grad for t in (a, b, weight))
    whole = a.shape[2] % 16 == 0 and weight.shape[0] % 16 == 0
    if a.is_cuda and whole:
        from straightpcf.model.kernels import cuda, cuda_gradient

        if not want_grad and cuda.load():
            return cuda.edge_max(a, b, index.int(), weight)
        if want_grad and index.shape[2] == cuda_gradient.EDGES and cuda_gradient.load_gradient():
            return cuda_gradient.EdgeMax.apply(a, b, index.int(), weight)  # type: ignore[no-untyped-call,no-any-return]
    plain = whole and a.dtype == torch.float32 and index.dtype == torch.int32
    library = cpu.load() if plain and a.device.type == "cpu" else None
    if library is None:
        return edge_max_torch(a, b, index, weight)
    return cpu.EdgeMax.apply(library, a, b, index, weight, want_grad)  # type: ignore[no-untyped-call,no-any-return]


def edge_max_torch(a: torch.Tensor, b: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Do what `edge_max` does with a gathered (B, M, k, C) tensor."""
    batch, rows, k = index.shape
    flat = index.reshape(batch, rows * k, 1).long().expand(-1, -1, b.shape[2])
    neighbours = b.gather(1, flat).view(batch, rows, k, -1)  # (B, M, k, C)
    return (torch.relu(a.unsqueeze(2) + neighbours) @ weight.T).amax(dim=2)
