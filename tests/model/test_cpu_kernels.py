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


_EVERY = ["avx512_bf16", "avx512bw", "avx2", "generic"]


@pytest.mark.parametrize(
    ("machine", "flags", "taken", "in_an_image"),
    [
        # Under emulation /proc/cpuinfo may list what the host has.
        ("aarch64", "avx2 avx512bw avx512_bf16", "generic", ["generic"]),
        ("arm64", "avx2 avx512bw avx512_bf16", "generic", ["generic"]),
        ("riscv64", "avx2 avx512bw avx512_bf16", "generic", ["generic"]),
        ("x86_64", "fma avx2", "avx2", _EVERY),
        ("AMD64", "fma avx2", "avx2", _EVERY),
    ],
)
def test_a_machine_compiles_and_takes_the_kernels_of_its_architecture(
    machine: str, flags: str, taken: str, in_an_image: list[str],
    asked: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:  # fmt: skip
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(Path, "read_text", lambda _: f"flags : {flags}")
    assert cpu.instruction_set() == taken
    cpu.build_all(tmp_path)
    assert asked == in_an_image
