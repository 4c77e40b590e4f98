"""Networks on disk: our safetensors files, and the import of the authors' `.pt` checkpoints.

A safetensors file holds the tensors of `StraightPCF.state_dict()` and one JSON object of metadata; its
`architecture` entry is what the network is rebuilt from. Nothing is ever loaded half: a key too many, a key
too few or another shape is a MalformedFile that names it.
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import pickle
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from straightpcf.model.nets.straightpcf import StraightPCF, VelocityModule
from straightpcf.points.errors import MalformedFile

__all__ = [
    "architecture_of",
    "convert_official_checkpoint",
    "load_checkpoint",
    "load_official_checkpoint",
    "read_checkpoint",
    "read_official_checkpoint",
    "refuse_folder",
    "save_checkpoint",
]

State = dict[str, torch.Tensor]
_Module = TypeVar("_Module", bound=nn.Module)

FORMAT = "straightpcf-1"
MAX_COUPLINGS, MAX_WIDTH = 16, 1024
MAX_OFFICIAL_BYTES = 256 << 20  # unpacked; the authors' full checkpoint with its optimiser is below 10 MB


def save_checkpoint(
    model: nn.Module | Mapping[str, torch.Tensor], path: Path, metadata: Mapping[str, Any] | None = None
) -> None:
    """Write the tensors of a StraightPCF (or of its parts, under the same keys) and JSON metadata to `path`.

    The file replaces an older one in one step. `architecture` is added to the metadata from the tensors' shapes.
    """
    state = model.state_dict() if isinstance(model, nn.Module) else model
    state = {key: tensor.detach().cpu().contiguous() for key, tensor in state.items()}
    described = {**(metadata or {}), "architecture": architecture_of(state)}
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    save_file(state, partial, {"format": FORMAT, "straightpcf": json.dumps(described, allow_nan=False)})
    partial.replace(path)


@torch.inference_mode(mode=False)  # tensors made in it are never packed for the kernels
def load_checkpoint(path: Path, *, device: torch.device | str = "cpu") -> StraightPCF:
    """Rebuild the network a file describes, in inference mode; raises MalformedFile naming what does not fit."""
    state, metadata = read_checkpoint(path)
    sizes = _architecture(metadata.get("architecture"), path)
    with torch.device("meta"):  # no memory and no random numbers for weights that are replaced at once
        model = StraightPCF(**sizes)
    return _filled(model, state, path).to(device)


def read_checkpoint(path: Path) -> tuple[State, dict[str, Any]]:
    """Return a safetensors file's tensors, on the CPU, and its metadata, without building a network."""
    refuse_folder(path)
    try:
        with safe_open(path, framework="pt") as file:
            texts = file.metadata() or {}
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - it is no mapping
    except (SafetensorError, ValueError) as exc:
        raise MalformedFile(f"{path} is no safetensors file: {exc}") from exc
    if "progress" in texts:
        raise MalformedFile(f"{path} is the state of a training run: docs/training.md says how weights are made of it")
    if texts.get("format") != FORMAT:
        raise MalformedFile(f"{path} has the format {texts.get('format')!r} in its metadata, expected {FORMAT!r}")
    try:
        metadata = json.loads(texts.get("straightpcf", ""))
    except json.JSONDecodeError as exc:
        raise MalformedFile(f"{path} has metadata that are not JSON: {exc}") from exc
    if not isinstance(metadata, dict):
        raise MalformedFile(f"{path} has metadata of type {type(metadata).__name__}, expected an object")
    return state, metadata


def load_official_checkpoint(path: Path) -> VelocityModule | nn.ModuleList | StraightPCF:
    """Build what the authors' file holds, in inference mode.

    A single module gives a VelocityModule, a coupled stack without DistanceModule the list of its modules, a full
    checkpoint a StraightPCF. The file is read without running anything in it.
    """
    state = read_official_checkpoint(path)
    sizes = architecture_of(state)
    with torch.device("meta"):
        whole = StraightPCF(**_architecture(sizes, path))
    model: nn.Module = whole
    if "distance_width" not in sizes:
        model = whole.velocity_modules if sizes["couplings"] > 1 else whole.velocity_modules[0]
        prefix = r"^velocity_modules\." if sizes["couplings"] > 1 else r"^velocity_modules\.0\."
        state = {re.sub(prefix, "", key): tensor for key, tensor in state.items()}
    return _filled(model, state, path)  # type: ignore[return-value]


def read_official_checkpoint(path: Path) -> State:
    """Return the tensors of an authors' `.pt` file under our keys.

    Theirs are `encoder.`/`decoder.` for a single VelocityModule, `velocity_nets.<i>.` for coupled ones, and then
    `encoder.`/`decoder.` at the top for the DistanceModule; the first skip layers are `lin.0`, ours `lin`.
    """
    state = _official_state(path)
    coupled = any(key.startswith("velocity_nets.") for key in state)
    top = "distance_module." if coupled else "velocity_modules.0."
    renamed = {}
    for key, tensor in state.items():
        ours = key.replace("velocity_nets.", "velocity_modules.") if key.startswith("velocity_nets.") else top + key
        renamed[ours.replace(".lin.0.", ".lin.")] = tensor
    return renamed


def convert_official_checkpoint(source: Path, target: Path) -> None:
    """Write an authors' `.pt` file as safetensors, after checking that it is one of their networks and complete."""
    load_official_checkpoint(source)
    save_checkpoint(read_official_checkpoint(source), target, {"origin": f"ddsediri/StraightPCF, {Path(source).name}"})


def architecture_of(state: Mapping[str, torch.Tensor]) -> dict[str, int]:
    """Read couplings and widths off the tensors; `distance_width` is absent where there is no DistanceModule."""
    numbers = {match[1] for key in state if (match := re.match(r"velocity_modules\.(\d+)\.", key))}
    found = {"couplings": len(numbers)}
    for name, key in [("width", "velocity_modules.0."), ("distance_width", "distance_module.")]:
        if (bias := state.get(f"{key}encoder.conv3.lin.bias")) is not None:
            found[name] = bias.numel()
    return found


def refuse_folder(path: Path) -> None:
    """Raise IsADirectoryError of what is one: safetensors says `No such device` of it, and no name."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))


def _architecture(sizes: Any, path: Path) -> dict[str, int]:
    """Return sizes that a StraightPCF can be built from, or raise MalformedFile naming the one that is wrong."""
    if not isinstance(sizes, dict):
        raise MalformedFile(f"{path} has no architecture in its metadata")
    allowed = {
        "couplings": range(1, MAX_COUPLINGS + 1),
        "width": range(8, MAX_WIDTH + 1, 8),
        "distance_width": range(8, MAX_WIDTH + 1, 8),
    }
    for name, value in sizes.items():
        if name not in allowed:
            raise MalformedFile(f"{path} has the unknown architecture entry {name!r}; known: {', '.join(allowed)}")
        if type(value) is not int or value not in allowed[name]:
            raise MalformedFile(f"{path} has {name} {value!r}; it must be in {allowed[name]}")
    if missing := {"couplings", "width"} - sizes.keys():
        raise MalformedFile(f"{path} has no {' and no '.join(sorted(missing))} in its architecture")
    return sizes


def _filled(model: _Module, state: Mapping[str, torch.Tensor], path: Path) -> _Module:
    """Put `state` into `model` once every key, shape and type agrees and every value is finite."""
    expected = model.float().state_dict()  # whatever torch.set_default_dtype says
    if unknown := sorted(state.keys() - expected.keys()):
        raise MalformedFile(f"{path} has {len(unknown)} tensors the network has not: {_some(unknown)}")
    if missing := sorted(expected.keys() - state.keys()):
        raise MalformedFile(f"{path} lacks {len(missing)} of the network's tensors: {_some(missing)}")
    for key, tensor in state.items():
        wanted = expected[key]
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise MalformedFile(
                f"{path} has {key} of shape {tuple(tensor.shape)} {tensor.dtype}, "
                f"the network {tuple(wanted.shape)} {wanted.dtype}"
            )
        if not torch.isfinite(tensor).all():
            raise MalformedFile(f"{path} has {key} with values that are not finite")
    model.load_state_dict(dict(state), strict=True, assign=True)
    return model.eval()


def _official_state(path: Path) -> State:
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_OFFICIAL_BYTES:
            raise MalformedFile(f"{path} unpacks to {size} bytes, the limit is {MAX_OFFICIAL_BYTES}")
        # weights_only builds tensors and plain containers only; their options are the one class to let through.
        with torch.serialization.safe_globals([argparse.Namespace]):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as exc:
        raise MalformedFile(f"{path} holds more than tensors and options and was not loaded: {exc}") from exc
    except (zipfile.BadZipFile, RuntimeError, EOFError, ValueError, KeyError) as exc:
        raise MalformedFile(f"{path} is no checkpoint written by torch.save: {exc}") from exc
    if not isinstance(content, dict) or not isinstance(content.get("state_dict"), Mapping):
        raise MalformedFile(f"{path} has no state_dict, which the authors' checkpoints have")
    state = dict(content["state_dict"])
    for key, tensor in state.items():
        if not isinstance(key, str) or not isinstance(tensor, torch.Tensor):
            raise MalformedFile(f"{path} has the state_dict entry {key!r} of type {type(tensor).__name__}")
    return state


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
