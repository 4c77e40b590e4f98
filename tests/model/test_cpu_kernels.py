"""Which of the compiled kernels a machine takes; what they compute is in test_ops.py."""

from __future__ import annotations

import errno
import os
import platform
import shutil
import subprocess
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


_EVERY = ["amx_bf16", "avx512_bf16", "avx512_vnni", "avx512bw", "avx_vnni", "avx2", "generic"]


@pytest.mark.parametrize(
    ("machine", "flags", "taken", "in_an_image"),
    [
        # Under emulation /proc/cpuinfo may list what the host has.
        ("aarch64", "avx2 avx512bw avx512_bf16", "generic", ["asimddp", "generic"]),
        ("arm64", "avx2 avx512bw avx512_bf16", "generic", ["asimddp", "generic"]),
        ("aarch64", "fp asimd asimdhp asimddp", "asimddp", ["asimddp", "generic"]),
        ("x86_64", "fp asimd asimdhp asimddp", "generic", _EVERY),
        ("riscv64", "avx2 avx512bw avx512_bf16", "generic", ["generic"]),
        ("x86_64", "fma avx2", "avx2", _EVERY),
        ("AMD64", "fma avx2", "avx2", _EVERY),
        ("x86_64", "avx2 avx512bw avx512_bf16 amx_tile amx_bf16", "amx_bf16", _EVERY),
        ("x86_64", "avx2 avx512bw amx_tile amx_bf16", "avx512bw", _EVERY),  # what a hypervisor may leave
        ("x86_64", "AuthenticAMD avx2 avx512bw avx512_bf16", "avx512_bf16", _EVERY),
        ("x86_64", "GenuineIntel avx2 avx512bw avx512_bf16", "avx512bw", _EVERY),
        ("x86_64", "GenuineIntel avx2 avx512bw avx512_vnni avx512_bf16", "avx512_vnni", _EVERY),
        ("x86_64", "GenuineIntel avx2 avx512bw avx512_vnni", "avx512_vnni", _EVERY),
        ("x86_64", "GenuineIntel avx2 avx_vnni", "avx_vnni", _EVERY),
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


def test_apple_s_processors_have_products_of_bytes(asked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(path: Path) -> str:
        raise FileNotFoundError(path)

    monkeypatch.setattr(platform, "machine", lambda: "arm64")
    monkeypatch.setattr(platform, "system", lambda: "Darwin")
    monkeypatch.setattr(Path, "read_text", missing)
    assert cpu.instruction_sets() == ("asimddp", "generic")


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
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(cpu, "instruction_sets", lambda: ("amx_bf16", "avx512_bf16", "avx2", "generic"))
    monkeypatch.setattr(cpu, "build", build)
    monkeypatch.setattr(cpu, "_open_whole", lambda path: path.name)
    with pytest.warns(UserWarning, match=r"for avx2 only, which is slower here \(c\+\+: error: .* for amx_bf16\)"):
        assert cpu.load.__wrapped__() == "compiled.so"
    assert tried == ["amx_bf16", "avx512_bf16", "avx2"]


@pytest.fixture
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Nothing is shipped, and what is built comes to a folder of the test's."""
    monkeypatch.delenv("STRAIGHTPCF_NO_KERNELS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cpu, "_SHIPPED", tmp_path / "shipped")
    monkeypatch.setattr(cpu, "instruction_sets", lambda: ("generic",))
    return tmp_path / "straightpcf"


def kept_as(folder: Path, content: bytes, *, named: bytes | None = None) -> Path:
    """Leave a library, by its own name or by that of another content."""
    folder.mkdir(exist_ok=True)
    path = folder / cpu._file_name("generic", cpu._digest(content if named is None else named))
    path.write_bytes(content)
    return path


@pytest.fixture
def good(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """What compiling gives, in less time."""
    library = cpu.load()
    if library is None:
        pytest.skip("no C++ compiler and no shipped kernels")
    content = Path(library._name).read_bytes()
    monkeypatch.setattr(cpu, "build", lambda folder, name: kept_as(folder, content))
    return content


@pytest.mark.parametrize("kept", [b"", b"\x7fELF of another machine", b"#!/bin/sh\n"])
def test_a_library_that_does_not_open_is_compiled_again(kept: bytes, own_cache: Path, good: bytes) -> None:
    kept_as(own_cache, kept)
    assert cpu.load.__wrapped__()._name == str(own_cache / cpu._file_name("generic", cpu._digest(good)))


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9, 0.999])
def test_a_library_that_is_cut_short_is_compiled_again(part: float, own_cache: Path, good: bytes) -> None:
    """It was opened, and the process ended: by SIGBUS, then or at the first call of what was not there."""
    path = kept_as(own_cache, good[: int(part * len(good))], named=good)
    library = cpu.load.__wrapped__()
    assert path.read_bytes() == good
    assert cpu.knn(library, torch.rand(1, 50, 3), 4, 50).shape == (1, 50, 4)


def test_a_library_that_was_overwritten_is_none_of_ours(own_cache: Path, good: bytes) -> None:
    path = kept_as(own_cache, good[:-1] + b"x", named=good)
    with pytest.raises(OSError, match="is damaged"):
        cpu._open_whole(path)
    assert cpu._found("generic") is None


def test_of_two_libraries_the_one_that_opens_is_taken(own_cache: Path, good: bytes) -> None:
    """As where machines of two libcs have one home: neither compiles over the other's."""
    for salt in range(20):
        kept_as(own_cache, b"of another libc: %d" % salt)
    path = kept_as(own_cache, good)
    assert cpu._found("generic")._name == str(path)


def test_a_disk_that_is_full_behind_the_compiler_leaves_no_library(
    own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some tell at fsync alone."""

    def compiled(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        Path(command[-1]).write_bytes(b"to be written")
        return subprocess.CompletedProcess(command, 0)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "which", str)
    monkeypatch.setattr(subprocess, "run", compiled)
    whole = cpu.build(own_cache, "generic")
    assert whole.name == cpu._file_name("generic", cpu._digest(b"to be written"))
    whole.unlink()
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        cpu.build(own_cache, "generic")
    assert not list(own_cache.iterdir())


def test_where_a_library_neither_opens_nor_compiles_torch_does_the_work(
    own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept_as(own_cache, b"no library")
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.warns(UserWarning, match=r"not compiled \(no C\+\+ compiler: install g\+\+\); plain torch is used"):
        assert cpu.load.__wrapped__() is None


def test_a_library_with_other_functions_is_none_of_ours(own_cache: Path) -> None:
    foreign = torch.__file__.replace("__init__.py", "lib/libshm.so")
    if not Path(foreign).is_file():
        pytest.skip("no library to try it with")
    with pytest.raises(OSError, match="has other functions"):
        cpu._open(Path(foreign))


def test_a_user_without_a_home_gets_what_is_shipped_or_torch(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`docker run --user 12345` where no HOME is set."""

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", homeless)
    with pytest.warns(UserWarning, match=r"determine home directory\. Set HOME .*; plain torch is used"):
        assert cpu.load.__wrapped__() is None
    kept_as(cpu._SHIPPED, b"shipped")
    monkeypatch.setattr(cpu, "_open", lambda path: path)
    assert cpu.load.__wrapped__().parent == cpu._SHIPPED


def test_other_flags_of_a_set_are_another_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    names = {cpu._file_name(name, "") for name in cpu._X86}
    monkeypatch.setattr(cpu, "_X86", {name: f"{flags} -mtune=native" for name, flags in cpu._X86.items()})
    assert names.isdisjoint(cpu._file_name(name, "") for name in cpu._X86)


@pytest.mark.slow
def test_the_kernels_of_every_instruction_set_agree(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of those that this processor has; which of them is taken elsewhere is not known here."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 1, 100, 64, generator=generator)
    weight = torch.randn(64, 64, generator=generator) / 8
    index = ops.knn_torch(b, 20, 100)
    neighbours = index.sort().values
    expected = ops.edge_max_torch(a, b, index, weight)
    torch.manual_seed(0)  # of another network a neighbour may be another
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
        error = 2e-2 if "bf16" in name or "vnni" in name else 4e-6 if name == "avx512bw" else 1e-4
        with torch.no_grad():
            assert float((module(b[:, :, :3]) - velocities).norm() / velocities.norm()) < error, name


@pytest.mark.slow
@pytest.mark.parametrize(("flags", "coarse"), [("", 1e-6), ("-march=armv8.2-a+dotprod", 1e-2)])
def test_kernels_for_arm_agree_with_float64(flags: str, coarse: float, tmp_path: Path) -> None:
    """Under emulation: no such processor is here."""
    compiler, emulator = shutil.which("aarch64-linux-gnu-g++"), shutil.which("qemu-aarch64")
    if compiler is None or emulator is None:
        pytest.skip("no compiler and emulator for aarch64: apt install g++-aarch64-linux-gnu qemu-user")
    program = tmp_path / "check"
    sources = [Path(__file__).with_name("edge_max_check.cpp"), *cpu._SOURCES]
    command = [compiler, "-O3", "-std=c++17", "-static", *flags.split(), f"-I{cpu._SOURCES[0].parent}"]
    subprocess.run([*command, *sources, "-o", program], check=True)
    for width, k in ((32, 1), (96, 9), (256, 32), (64, 33)):
        done = subprocess.run([emulator, program, str(width), str(k)], check=True, capture_output=True, text=True)
        errors = [float(error) for error in done.stdout.split()]
        assert errors[0] < 1e-6
        assert errors[1] < coarse


def integer_products(
    kernel: cpu.Packing, a: torch.Tensor, b: torch.Tensor, index: torch.Tensor, weight: torch.Tensor
) -> tuple[torch.Tensor, float]:
    """Return what a kernel for inference makes of a patch (N, C), and the error that its numbers may have."""
    library = cpu.load()
    if library is None:
        pytest.skip("no C++ compiler and no shipped kernels")
    (rows, width), out_width = a.shape, len(weight)
    packed, found = cpu.packed(library, weight, kernel), torch.full((rows, out_width), torch.nan)
    getattr(library, f"straightpcf_{kernel}")(
        cpu._at(a), cpu._at(b), cpu._at(index), cpu._at(packed), rows, len(b), index.shape[1], width, out_width,
        cpu._at(found),
    )  # fmt: skip
    few_bits = ("bf16",) if kernel == "edge_max_fine" else ("bf16", "vnni", "asimddp")
    return found, 1e-2 if any(kind in library._name for kind in few_bits) else 5e-4


@pytest.mark.parametrize("kernel", ["edge_max_fine", "edge_max_coarse"])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("k", [1, 9, 32, 33])
@pytest.mark.parametrize("width", [32, 96, 256])
def test_products_of_integers_are_within_their_steps(kernel: cpu.Packing, width: int, k: int, scale: float) -> None:
    """Edges and weights are a step off at most, and in a sum of `width` of them errors have no common sign."""
    generator = torch.Generator().manual_seed(width + k)
    a, b = torch.randn(2, 60, width, generator=generator) * scale
    a[0] = -1e6 * scale  # nothing is left of its edges
    weight = torch.randn(width, width, generator=generator) / width**0.5
    weight[1] = 0
    index = torch.randint(60, (60, k), generator=generator, dtype=torch.int32)
    found, error = integer_products(kernel, a, b, index, weight)
    expected = ops.edge_max_torch(a[None], b[None], index[None].long(), weight)[0]
    assert (found[0] == 0).all()
    assert (found[:, 1] == 0).all()
    assert float((found - expected).norm() / expected.norm()) < error
    assert float((found - expected).abs().max()) < 5 * error * scale


@pytest.mark.parametrize("kernel", ["edge_max_fine", "edge_max_coarse"])
@pytest.mark.parametrize("width", [32, 256, 1024])
def test_the_largest_sums_of_integers_are_no_others(kernel: cpu.Packing, width: int) -> None:
    """All of an edge as large as its largest, all of a row of the weight too: 32 bits hold no larger sum."""
    ones, zeros = torch.ones(32, width), torch.zeros(32, width)
    weight = torch.stack([torch.ones(width), -torch.ones(width), torch.arange(width) / width] * 32)[:32]
    index = torch.zeros(32, 2, dtype=torch.int32)
    for a, b, share in ((ones, zeros, 1.0), (zeros, ones, 1.0), (ones, ones, 2.0), (3 * ones, -2 * ones, 1.0)):
        found, _ = integer_products(kernel, a, b, index, weight)
        expected = share * weight.sum(dim=1).expand(32, -1)
        assert float(((found - expected) / expected).abs().max()) < 1e-2
    assert (integer_products(kernel, -ones, ones - 1, index, weight)[0] == 0).all()
