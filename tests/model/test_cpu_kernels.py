"""Which of the compiled kernels a machine takes; what they compute is in test_ops.py."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from straightpcf.model import ops
from straightpcf.model.kernels import cpu
from straightpcf.model.nets.straightpcf import VelocityModule


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Collect what would be compiled; the choice is forgotten before and after."""
    names: list[str] = []
    monkeypatch.setattr(cpu, "build", lambda folder, name: names.append(name) or folder / name)
    cpu.instruction_sets.cache_clear()
    yield names
    cpu.instruction_sets.cache_clear()


_EVERY = ["amx_bf16", "avx512_bf16", "avx512bw", "avx2", "generic"]


@pytest.mark.parametrize(
    ("machine", "flags", "taken", "in_an_image"),
    [
        # Under emulation /proc/cpuinfo may list what the host has.
        ("aarch64", "avx2 avx512bw avx512_bf16", "generic", ["generic"]),
        ("arm64", "avx2 avx512bw avx512_bf16", "generic", ["generic"]),
        ("riscv64", "avx2 avx512bw avx512_bf16", "generic", ["generic"]),
        ("x86_64", "fma avx2", "avx2", _EVERY),
        ("AMD64", "fma avx2", "avx2", _EVERY),
        ("x86_64", "avx2 avx512bw avx512_bf16 amx_tile amx_bf16", "amx_bf16", _EVERY),
        ("x86_64", "avx2 avx512bw amx_tile amx_bf16", "avx512bw", _EVERY),  # what a hypervisor may leave
        ("x86_64", "AuthenticAMD avx2 avx512bw avx512_bf16", "avx512_bf16", _EVERY),
        ("x86_64", "GenuineIntel avx2 avx512bw avx512_bf16", "avx512bw", _EVERY),
        ("x86_64", "GenuineIntel avx2 avx512bw avx512_bf16 amx_tile amx_bf16", "amx_bf16", _EVERY),
    ],
)
def test_a_machine_compiles_and_takes_the_kernels_of_its_architecture(
    machine: str, flags: str, taken: str, in_an_image: list[str],
    asked: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:  # fmt: skip
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(Path, "read_text", lambda _: f"flags : {flags}")
    monkeypatch.setattr(cpu, "_tiles_granted", lambda: True)
    assert cpu.instruction_sets()[0] == taken
    cpu.build_all(tmp_path)
    assert asked == in_an_image


def test_without_the_kernels_leave_a_processor_s_tiles_are_not_used(
    asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(Path, "read_text", lambda _: "flags : avx2 avx512bw avx512_bf16 amx_tile amx_bf16")
    monkeypatch.setattr(cpu, "_tiles_granted", lambda: False)
    assert cpu.instruction_sets() == ("avx512_bf16", "avx512bw", "avx2", "generic")


def test_a_compiler_older_than_the_processor_compiles_for_an_older_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tried: list[str] = []

    def build(folder: Path, name: str) -> Path:
        tried.append(name)
        if name != "avx2":
            raise OSError(f"c++: error: unrecognized command-line option for {name}")
        return folder / "compiled.so"

    monkeypatch.delenv("STRAIGHTPCF_NO_KERNELS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cpu, "_SHIPPED", tmp_path)
    monkeypatch.setattr(cpu, "instruction_sets", lambda: ("amx_bf16", "avx512_bf16", "avx2", "generic"))
    monkeypatch.setattr(cpu, "build", build)
    monkeypatch.setattr(cpu, "_open", lambda path: path.name)
    with pytest.warns(UserWarning, match=r"for avx2 only, which is slower here \(c\+\+: error: .* for amx_bf16\)"):
        assert cpu.load.__wrapped__() == "compiled.so"
    assert tried == ["amx_bf16", "avx512_bf16", "avx2"]


@pytest.mark.slow
def test_the_kernels_of_every_instruction_set_agree(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of those that this processor has; which of them is taken elsewhere is not known here."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 1, 100, 64, generator=generator)
    weight = torch.randn(64, 64, generator=generator) / 8
    index = ops.knn_torch(b, 20, 100)
    neighbours = index.sort().values
    expected = ops.edge_max_torch(a, b, index, weight)
    module = VelocityModule().eval()
    monkeypatch.setattr(cpu, "load", lambda: None)
    with torch.no_grad():
        velocities = module(b[:, :, :3])
    for name in cpu.instruction_sets():
        library = cpu._open(cpu.build(tmp_path, name))
        monkeypatch.setattr(cpu, "load", lambda library=library: library)
        assert (ops.knn(b, 20).sort().values == neighbours).float().mean() > 0.999, name
        error = 5e-3 if "bf16" in name else 1e-6
        assert float((ops.edge_max(a, b, index, weight) - expected).norm() / expected.norm()) < error, name
        with torch.no_grad():
            assert float((module(b[:, :, :3]) - velocities).norm() / velocities.norm()) < 4 * error, name
