"""Checkpoints come back as they were saved, and nothing that is not exactly one is loaded."""

from __future__ import annotations

import argparse
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from straightpcf.model import checkpoint
from straightpcf.model.checkpoint import (
    architecture_of,
    convert_official_checkpoint,
    load_checkpoint,
    load_official_checkpoint,
    read_checkpoint,
    read_official_checkpoint,
    save_checkpoint,
)
from straightpcf.model.filter import load_filter
from straightpcf.model.nets.straightpcf import StraightPCF, VelocityModule
from straightpcf.model.train.soap import SOAP
from straightpcf.model.train.state import Average, read_network, save_state
from straightpcf.points.errors import MalformedFile

SMALL = {"couplings": 2, "width": 16, "distance_width": 8}


def small() -> StraightPCF:
    torch.manual_seed(0)
    return StraightPCF(**SMALL)


def official_names(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return a state under the authors' keys."""
    renamed = {}
    for key, tensor in state.items():
        key = key.replace("velocity_modules.", "velocity_nets.").replace("distance_module.", "")
        for block in ("conv1", "conv2"):
            key = key.replace(f"{block}.lin.", f"{block}.lin.0.")
        renamed[key] = tensor
    return renamed


def write_official(path: Path, state: dict[str, torch.Tensor]) -> Path:
    torch.save({"args": argparse.Namespace(seed=2020), "state_dict": state, "others": {"step": 1}}, path)
    return path


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def test_weights_of_a_filter_may_be_named_by_text(tmp_path: Path) -> None:
    save_checkpoint(small(), path := tmp_path / "small.safetensors")
    assert same(load_filter(str(path), device="cpu").network.state_dict(), small().state_dict())


def test_a_network_comes_back_with_its_weights_and_metadata(tmp_path: Path) -> None:
    model, path = small(), tmp_path / "small.safetensors"
    save_checkpoint(model, path, {"noise_std": 0.02, "calibration": [[1, 0.3]]})
    loaded = load_checkpoint(path)
    assert same(loaded.state_dict(), model.state_dict())
    assert not loaded.training
    assert all(parameter.requires_grad for parameter in loaded.parameters())
    assert read_checkpoint(path)[1] == {"noise_std": 0.02, "calibration": [[1, 0.3]], "architecture": SMALL}


def test_loading_draws_no_random_numbers(tmp_path: Path) -> None:
    save_checkpoint(small(), tmp_path / "a")
    before = torch.get_rng_state()
    load_checkpoint(tmp_path / "a")
    assert torch.equal(torch.get_rng_state(), before)


def test_saving_leaves_no_other_file_behind(tmp_path: Path) -> None:
    save_checkpoint(small(), tmp_path / "a")
    save_checkpoint(small().state_dict(), tmp_path / "a")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_the_architecture_is_read_off_the_tensors() -> None:
    state = small().state_dict()
    assert architecture_of(state) == SMALL
    velocities = {key: tensor for key, tensor in state.items() if key.startswith("velocity")}
    assert architecture_of(velocities) == {"couplings": 2, "width": 16}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.pop("distance_module.decoder.lin_3.bias"), "lacks 1 .*distance_module.decoder.lin_3.bias"),
        (lambda state: state.update(extra=torch.zeros(1)), "has not: extra"),
        (
            lambda state: state.update({"velocity_modules.0.decoder.lin_3.bias": torch.zeros(4)}),
            r"velocity_modules.0.decoder.lin_3.bias of shape \(4,\)",
        ),
        (
            lambda state: state.update({"velocity_modules.0.decoder.lin_3.bias": torch.zeros(3).double()}),
            "float64, the network .*float32",
        ),
        (
            lambda state: state.update({"velocity_modules.1.decoder.lin_3.bias": torch.full((3,), torch.nan)}),
            "velocity_modules.1.decoder.lin_3.bias with values that are not finite",
        ),
        (
            lambda state: [state.pop(key) for key in list(state) if key.startswith("velocity_modules.0")],
            "no width",
        ),
    ],
)
def test_tensors_that_do_not_fit_are_named(
    tmp_path: Path, change: Callable[[dict[str, torch.Tensor]], Any], message: str
) -> None:
    state = dict(small().state_dict())
    change(state)
    save_checkpoint(state, tmp_path / "a")
    with pytest.raises(MalformedFile, match=message):
        load_checkpoint(tmp_path / "a")


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({}, "the format None"),
        ({"format": "other"}, "the format 'other'"),
        ({"format": "straightpcf-1", "straightpcf": "{"}, "not JSON"),
        ({"format": "straightpcf-1", "straightpcf": "[]"}, "type list"),
        ({"format": "straightpcf-1", "straightpcf": "{}"}, "no architecture"),
        ({"format": "straightpcf-1", "straightpcf": json.dumps({"architecture": {"depth": 3}})}, "unknown .*'depth'"),
        (
            {"format": "straightpcf-1", "straightpcf": json.dumps({"architecture": SMALL | {"width": 10**9}})},
            "width 1000000000",
        ),
    ],
)
def test_metadata_that_describe_no_network_are_refused(tmp_path: Path, metadata: dict[str, str], message: str) -> None:
    save_file(small().state_dict(), tmp_path / "a", metadata)
    with pytest.raises(MalformedFile, match=message):
        load_checkpoint(tmp_path / "a")


@pytest.mark.parametrize("content", [b"", b"not a file", b"\xff" * 64])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a"
    path.write_bytes(content)
    with pytest.raises(MalformedFile, match="no safetensors file"):
        load_checkpoint(path)
    with pytest.raises(MalformedFile, match=r"no checkpoint written by torch.save"):
        load_official_checkpoint(path)


def test_a_truncated_checkpoint_is_refused(tmp_path: Path) -> None:
    save_checkpoint(small(), tmp_path / "a")
    (tmp_path / "b").write_bytes((tmp_path / "a").read_bytes()[:-100])
    with pytest.raises(MalformedFile, match="no safetensors file"):
        load_checkpoint(tmp_path / "b")


def test_a_missing_checkpoint_is_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_checkpoint(tmp_path / "a")
    with pytest.raises(FileNotFoundError):
        load_official_checkpoint(tmp_path / "a")


def test_an_official_single_module_becomes_a_velocity_module(tmp_path: Path) -> None:
    module = VelocityModule(16)
    path = write_official(tmp_path / "vm.pt", official_names(module.state_dict()))
    loaded = load_official_checkpoint(path)
    assert isinstance(loaded, VelocityModule)
    assert same(loaded.state_dict(), module.state_dict())


def test_an_official_coupled_stack_becomes_its_modules(tmp_path: Path) -> None:
    state = {key: tensor for key, tensor in small().state_dict().items() if key.startswith("velocity")}
    loaded = load_official_checkpoint(write_official(tmp_path / "cvm.pt", official_names(state)))
    assert isinstance(loaded, nn.ModuleList)
    assert len(loaded) == 2
    assert same({f"velocity_modules.{key}": tensor for key, tensor in loaded.state_dict().items()}, state)


def test_an_official_full_checkpoint_converts_to_safetensors(tmp_path: Path) -> None:
    model = small()
    source = write_official(tmp_path / "full.pt", official_names(model.state_dict()))
    assert isinstance(load_official_checkpoint(source), StraightPCF)
    convert_official_checkpoint(source, tmp_path / "full.safetensors")
    assert same(load_checkpoint(tmp_path / "full.safetensors").state_dict(), model.state_dict())


def test_an_official_single_module_converts_but_is_no_whole_network(tmp_path: Path) -> None:
    source = write_official(tmp_path / "vm.pt", official_names(VelocityModule(16).state_dict()))
    convert_official_checkpoint(source, tmp_path / "vm.safetensors")
    assert same(read_checkpoint(tmp_path / "vm.safetensors")[0], read_official_checkpoint(source))
    with pytest.raises(MalformedFile, match="distance_module"):
        load_checkpoint(tmp_path / "vm.safetensors")


def test_an_official_checkpoint_with_a_key_missing_is_refused(tmp_path: Path) -> None:
    state = official_names(VelocityModule(16).state_dict())
    del state["decoder.lin_1.weight"]
    with pytest.raises(MalformedFile, match=r"lacks 1 .*decoder.lin_1.weight"):
        load_official_checkpoint(write_official(tmp_path / "vm.pt", state))


class Malicious:
    """Run a command when unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.marker}",)


def test_a_malicious_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    marker = tmp_path / "run"
    torch.save({"args": Malicious(marker), "state_dict": {}}, tmp_path / "zip.pt")
    (tmp_path / "raw.pt").write_bytes(pickle.dumps({"state_dict": Malicious(marker)}))
    with pytest.raises(MalformedFile, match="was not loaded"):
        load_official_checkpoint(tmp_path / "zip.pt")
    with pytest.raises(MalformedFile, match="no checkpoint"):
        load_official_checkpoint(tmp_path / "raw.pt")
    assert not marker.exists()


def test_a_checkpoint_that_unpacks_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_official(tmp_path / "vm.pt", official_names(VelocityModule(16).state_dict()))
    monkeypatch.setattr(checkpoint, "MAX_OFFICIAL_BYTES", 1000)
    with pytest.raises(MalformedFile, match="the limit is 1000"):
        load_official_checkpoint(path)


@pytest.mark.parametrize("content", [[1, 2], {"weights": 1}, {"state_dict": 3}, {"state_dict": {"a": 1}}])
def test_a_torch_file_without_tensors_is_refused(tmp_path: Path, content: Any) -> None:
    torch.save(content, tmp_path / "a.pt")
    with pytest.raises(MalformedFile, match="state_dict"):
        load_official_checkpoint(tmp_path / "a.pt")


def test_a_folder_is_named_as_one(tmp_path: Path) -> None:
    for read in (load_checkpoint, read_network):
        with pytest.raises(IsADirectoryError, match=str(tmp_path)):
            read(tmp_path)


def test_the_state_of_a_training_run_is_named_as_one_where_weights_are_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "state.safetensors"
    network, rng = StraightPCF(couplings=1), np.random.default_rng(0)
    save_state(path, network, Average(network, 0.9), SOAP(network.parameters()), rng, {"stage": "vm", "iteration": 1})
    with pytest.raises(
        MalformedFile, match=r"state\.safetensors is the state of a training run: docs/training\.md says"
    ):
        load_filter(path, device="cpu")
