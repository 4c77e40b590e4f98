"""What a training run needs to go on: weights, their average, optimiser, random states, in one safetensors file."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from straightpcf.model.checkpoint import load_checkpoint, read_checkpoint, refuse_folder
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.points.errors import MalformedFile

__all__ = ["Average", "average_with", "load_state", "read_header", "read_network", "save_state", "take_distance_module"]


class Average:
    """Keep an exponential moving average of a network's weights and buffers."""

    def __init__(self, network: StraightPCF, decay: float) -> None:
        self.decay = decay
        live = network.state_dict()
        self.tensors = {name: t.detach().clone() for name, t in live.items()}
        self._live = live  # shares storage with the network, so it is looked up once, not every iteration

    @torch.no_grad()
    def update(self, iteration: int) -> None:
        """Take one step; early on the window is short, so that the random start is forgotten."""
        decay = min(self.decay, (1 + iteration) / (10 + iteration))
        smooth = [name for name, mean in self.tensors.items() if mean.is_floating_point()]
        torch._foreach_lerp_([self.tensors[n] for n in smooth], [self._live[n] for n in smooth], 1 - decay)
        for name in self.tensors.keys() - set(smooth):
            self.tensors[name].copy_(self._live[name])

    def is_finite(self) -> bool:
        """Tell whether every number is, which none stays that once was not."""
        return all(bool(mean.isfinite().all()) for mean in self.tensors.values())


def save_state(
    path: Path, network: StraightPCF, average: Average, optimiser: torch.optim.Optimizer, rng: np.random.Generator,
    progress: dict[str, Any],
) -> None:  # fmt: skip
    """Write everything that `load_state` restores; the file replaces the old one whole, or OSError is raised."""
    tensors = {f"average.{name}": t.cpu().contiguous() for name, t in average.tensors.items()}
    for name, tensor in network.state_dict().items():
        if not torch.equal(tensor, average.tensors[name]):  # what is frozen is its own average
            tensors[f"weights.{name}"] = tensor.detach().cpu().clone().contiguous()
    for index, moments in optimiser.state_dict()["state"].items():
        tensors |= {
            f"optimiser.{index}.{name}": torch.as_tensor(t).cpu().clone().contiguous() for name, t in moments.items()
        }
    tensors["torch_rng"] = torch.get_rng_state()
    if torch.cuda.is_available():
        tensors["cuda_rng"] = torch.cuda.get_rng_state()
    metadata = {"progress": json.dumps(progress), "numpy_rng": json.dumps(rng.bit_generator.state)}
    scratch = path.with_suffix(".tmp")
    try:
        save_file(tensors, scratch, metadata=metadata)
        with scratch.open("rb+") as file:  # on the disk before it takes the old one's place
            os.fsync(file.fileno())
        scratch.replace(path)
    except SafetensorError as exc:
        raise OSError(f"{path} cannot be written: {exc}") from exc
    finally:
        scratch.unlink(missing_ok=True)  # half of one would keep a full disk full


def load_state(
    path: Path, network: StraightPCF, average: Average, optimiser: torch.optim.Optimizer, rng: np.random.Generator
) -> dict[str, Any]:
    """Restore a run in place and return its progress as saved."""
    tensors, metadata = _read(path)
    network.load_state_dict(_under(tensors, "average.") | _under(tensors, "weights."))
    average.tensors = {name: t.to(average.tensors[name].device) for name, t in _under(tensors, "average.").items()}
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in _under(tensors, "optimiser.").items():
        index, moment = name.split(".")
        moments.setdefault(int(index), {})[moment] = tensor
    optimiser.load_state_dict({"state": moments, "param_groups": optimiser.state_dict()["param_groups"]})
    torch.set_rng_state(tensors["torch_rng"])
    if "cuda_rng" in tensors and torch.cuda.is_available():
        torch.cuda.set_rng_state(tensors["cuda_rng"])
    rng.bit_generator.state = json.loads(metadata["numpy_rng"])
    return dict(json.loads(metadata["progress"]))


def read_network(path: Path) -> tuple[StraightPCF, dict[str, Any]]:
    """Return the averaged network of a run's state, or that of shipped weights, and the run's progress."""
    if "progress" not in read_header(path):
        return load_checkpoint(path), dict(read_checkpoint(path)[1].get("training", {}))
    tensors, metadata = _read(path)
    average = _under(tensors, "average.")
    couplings = len({name.split(".")[1] for name in average if name.startswith("velocity_modules.")})
    network = StraightPCF(couplings=couplings)
    network.load_state_dict(average)
    return network, dict(json.loads(metadata["progress"]))


def take_distance_module(network: StraightPCF, path: Path) -> None:
    """Give a network the averaged DistanceModule of a run's state, or that of shipped weights."""
    network.distance_module.load_state_dict(read_network(path)[0].distance_module.state_dict())


def average_with(network: StraightPCF, path: Path, share: float = 0.5) -> dict[str, Any]:
    """Replace a network's velocities by the mean of theirs, which have that share, and those of a state of their chain.

    Such means keep some of what each is better at (Wortsman et al. 2022, "Model soups"). BatchNorm's statistics are
    averaged too: settled runs leave them as they were. Returns that state's progress.
    """
    other, progress = read_network(path)
    theirs = other.velocity_modules.state_dict()
    ours = network.velocity_modules.state_dict()
    network.velocity_modules.load_state_dict(
        {name: torch.lerp(t, theirs[name], 1 - share) if t.is_floating_point() else t for name, t in ours.items()}
    )
    return progress


def _read(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    metadata = read_header(path)
    if "progress" not in metadata:
        raise MalformedFile(f"{path} is no training state: its header has no progress")
    with safe_open(path, framework="pt") as file:
        # Copies lie where a run's own tensors do, on which rounding depends.
        return {name: file.get_tensor(name).clone() for name in file.keys()}, metadata  # noqa: SIM118 - not a dict


def read_header(path: Path) -> dict[str, str]:
    """Return the metadata of a safetensors file; a state's has `progress`."""
    refuse_folder(path)
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}
    except (SafetensorError, ValueError) as exc:
        raise MalformedFile(f"{path} is no safetensors file: {exc}") from exc


def _under(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
