"""Which of the compiled kernels a machine takes; what they compute is in test_ops.py."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from pathlib import Path

import pytest

from straightpcf.model.kernels import cpu


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Collect what would be compiled; the choice is forgotten before and after."""
    names: list[str] = []
    monkeypatch.setattr(cpu, "build", lambda folder, name: names.append(name) or folder / name)
    cpu.instruction_set.cache_clear()
    yield names
    cpu.instruction_set.cache_clear()


@pytest.mark.parametrize("machine", ["aarch64", "arm64", "riscv64"])
def test_a_machine_without_x86_compiles_and_takes_the_generic_kernels(
    machine: str, asked: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Though under emulation /proc/cpuinfo may list what the host has."""
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(Path, "read_text", lambda _: "flags : avx2 avx512bw avx512_bf16")
    assert cpu.instruction_set() == "generic"
    cpu.build_all(tmp_path)
    assert asked == ["generic"]


@pytest.mark.parametrize("machine", ["x86_64", "AMD64"])
def test_an_image_for_x86_carries_every_instruction_set(
    machine: str, asked: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(Path, "read_text", lambda _: "flags : fma avx2")
    assert cpu.instruction_set() == "avx2"
    cpu.build_all(tmp_path)
    assert asked == ["avx512_bf16", "avx512bw", "avx2", "generic"]
