"""How near the velocities of a training state are to the truth, across the surface and along it.

python -m benchmarks.velocities runs/vm/state.safetensors runs/cvm/state.safetensors official

On fixed patches of the held-out shapes, over the third of the points nearest the seed (those the filter keeps), per
component and in units of the training noise: 1 is what a network that does nothing gets. What is along the surface can
hardly be known, so networks differ in what is across it. "official" is the authors' VelocityModule in `../shared`; a
single module is also run twice in a row, as a coupled stack of copies.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import nn

from benchmarks.command import errors_in_one_line, positive
from benchmarks.quality import SHARED
from straightpcf.model.checkpoint import load_official_checkpoint
from straightpcf.model.train.data import NOISE_STD, Batch, PatchSource
from straightpcf.model.train.state import read_network

_NEIGHBOURS = 16
_AT_ONCE = 8


@torch.inference_mode()
def errors(modules: Iterable[nn.Module], batch: Batch) -> torch.Tensor:
    """Return (B, 2 K + 1): each module's mean squared error across and along, then that of where the points end."""
    modules = list(modules)
    x = batch.at(batch.time)
    near = x.norm(dim=2).argsort(dim=1)[:, : x.shape[1] // 3]
    normal = _normals(batch.clean)

    def across_and_along(error: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        across = (error * normal).sum(dim=2).square()
        both = torch.stack([across, (error.square().sum(dim=2) - across) / 2]) / NOISE_STD**2
        means = both.gather(2, near.expand(2, -1, -1)).mean(dim=2)
        return means[0], means[1]

    found: list[torch.Tensor] = []
    for module in modules:
        velocity = module(x)
        found += across_and_along(velocity - (batch.clean - batch.noisy))
        x = x + (1 - batch.time) / len(modules) * velocity
    found.append(across_and_along(x - batch.clean)[0])
    return torch.stack(found, dim=1)


def _modules(name: str, data: Path) -> list[nn.Module]:
    if name == "official":
        return [load_official_checkpoint(data / "official" / "ckpt_vm.pt")]
    return list(read_network(Path(name))[0].velocity_modules)


def _normals(clean: torch.Tensor) -> torch.Tensor:
    index = torch.cdist(clean, clean).topk(_NEIGHBOURS, largest=False).indices
    around = torch.stack([patch[rows] for patch, rows in zip(clean, index, strict=True)])
    around = around - around.mean(dim=2, keepdim=True)
    normals: torch.Tensor = torch.linalg.eigh((around.mT @ around).double()).eigenvectors[..., 0].float()
    return normals


@errors_in_one_line()
def main() -> None:
    """Print one block for each state."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("states", nargs="+", help='a state.safetensors, or "official"')
    parser.add_argument("--data", type=Path, default=SHARED / "data")
    parser.add_argument("--patches", type=positive, default=160)
    parser.add_argument("--threads", type=positive, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    stacks = {name: _modules(name, arguments.data) for name in arguments.states}  # one that is none is found out first
    source = PatchSource.read(arguments.data / "punet_train.npz", validation=True)
    batch = source.draw(np.random.default_rng(1), arguments.patches)
    parts = batch.split(-(-arguments.patches // _AT_ONCE))
    quarter = (4 * batch.time.flatten()).floor().long()  # t < 0, before the first, counts in the means
    print(f"{'velocities':44} {'across, of each module (in quarters of t)':58} along   end, across")
    for name, modules in stacks.items():
        for stack in [modules, modules * 2] if len(modules) == 1 else [modules]:
            for module in stack:
                module.eval()
            found = torch.cat([errors(stack, part) for part in parts])
            label = name if stack is modules else f"{name}, twice"
            for k in range(len(stack)):
                across, along = found[:, 2 * k], found[:, 2 * k + 1]
                times = " ".join(f"{across[quarter == q].mean():.3f}" for q in range(4))
                end = f"{found[:, -1].mean():.4f}" if k == len(stack) - 1 else ""
                print(f"{label if k == 0 else '':44} {across.mean():.4f} ({times}){'':24} {along.mean():.3f}   {end}")


if __name__ == "__main__":
    main()
