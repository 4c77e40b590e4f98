"""The compiled CPU loops: build once per machine, load with ctypes, call on torch tensors.

The library is looked for in `kernels/lib/` (an image or a wheel may carry it), then in the user's cache,
and otherwise compiled there with the machine's C++ compiler. Where there is none, `load()` returns None
and the torch twins do the work: same result within rounding, several times slower.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Literal

import torch

__all__ = ["EdgeMax", "Packing", "build", "build_all", "instruction_sets", "knn", "load", "packed"]

_SOURCES = tuple(sorted(Path(__file__).parent.glob("*.cpp")))
_HEADERS = tuple(sorted(Path(__file__).parent.glob("*.h")))
_SHIPPED = Path(__file__).with_name("lib")
_AVX2 = "-mavx2 -mfma -mbmi -mbmi2"
_AVX512 = f"-mavx512f -mavx512bw -mavx512dq -mavx512vl {_AVX2}"
# Newest first. Each name is what /proc/cpuinfo must list; the value is what the compiler is told.
_X86 = {
    "amx_bf16": f"-mamx-tile -mamx-bf16 -mavx512bf16 {_AVX512}",
    "avx512_bf16": f"-mavx512bf16 -mavx512vnni {_AVX512}",  # no processor has the first without the second
    "avx512_vnni": f"-mavx512vnni {_AVX512}",
    "avx512bw": _AVX512,
    "avx_vnni": f"-mavxvnni {_AVX2}",
    "avx2": _AVX2,
    "generic": "",
}
_ARM = {"asimddp": "-march=armv8.2-a+dotprod", "generic": ""}
# Sums may be reordered. Not -ffast-math: it lets the compiler drop the comparisons that the selection relies on, and
# gcc links code into such a library that makes the whole process flush subnormal numbers to zero.
_REORDER = "-fassociative-math -fno-signed-zeros -fno-trapping-math -fno-math-errno -freciprocal-math"
_FLAGS = f"-O3 -std=c++17 -fPIC -shared {_REORDER} -Wno-psabi"
_BUILD_SECONDS = 120
Packing = Literal["edge_max", "edge_max_fine", "edge_max_coarse", "linear"]  # the kernel that a weight is packed for


@functools.cache
def instruction_sets() -> tuple[str, ...]:
    """Name the instruction sets this processor has among those the kernels are compiled for, newest first."""
    try:
        listed = set(Path("/proc/cpuinfo").read_text().split())  # under emulation it may be the host's
    except OSError:  # not Linux; all of Apple's own processors have these
        listed = {"asimddp"} if platform.system() == "Darwin" else set()
    if not (listed >= {"amx_tile", "avx512_bf16"} and _tiles_granted()):
        listed.discard("amx_bf16")
    if "GenuineIntel" in listed:  # outside the tiles its products of bfloat16 take 1.5 times as long as float32's
        listed.discard("avx512_bf16")
    return tuple(name for name in _compiled_sets() if name in listed or name == "generic")


def _compiled_sets() -> dict[str, str]:
    """Return the instruction sets that there are kernels for on this architecture, with their flags."""
    if platform.machine() in ("x86_64", "AMD64"):
        return _X86
    return _ARM if platform.machine() in ("aarch64", "arm64") else {"generic": ""}


def _tiles_granted() -> bool:
    """Ask Linux for AMX's tile registers, which a process must before it uses them (Documentation/arch/x86/xstate)."""
    arch_prctl, request_permission, tile_data = 158, 0x1023, 18
    return bool(ctypes.CDLL(None).syscall(arch_prctl, request_permission, tile_data) == 0)


@functools.cache
def load() -> ctypes.CDLL | None:
    """Return the library for this processor, compiled if need be, or None where that is not possible."""
    if os.environ.get("STRAIGHTPCF_NO_KERNELS"):  # the one switch: compare with the torch twins
        return None
    failed: Exception | None = None
    for name in instruction_sets():  # a compiler may be older than the processor
        try:
            library = _found(name) or _open_whole(build(_cache(), name))
        except (OSError, subprocess.SubprocessError) as exc:
            failed = failed or exc
            continue
        if failed:
            warnings.warn(f"CPU kernels compiled for {name} only, which is slower here ({failed})", stacklevel=2)
        return library
    warnings.warn(f"CPU kernels not compiled ({failed}); plain torch is used, several times slower", stacklevel=2)
    return None


def _found(target_set: str) -> ctypes.CDLL | None:
    """Open what was shipped or built before; None where there is none, or it is cut short or made for another libc."""
    folders = [_SHIPPED]
    with suppress(OSError):
        folders.append(_cache())
    for path in [path for folder in folders for path in sorted(folder.glob(_file_name(target_set, "*")))]:
        with suppress(OSError):
            return _open_whole(path)
    return None


def build(folder: Path, target_set: str) -> Path:
    """Compile for an instruction set into `folder`; the file's name says what is in it, for `_open_whole`.

    Raises OSError or SubprocessError where that fails.
    """
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        raise OSError("no C++ compiler: install g++")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        built = Path(scratch) / "kernel.so"
        flags = [*_FLAGS.split(), *_compiled_sets()[target_set].split()]
        command = [compiler, *flags, *map(str, _SOURCES), "-o", str(built)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_BUILD_SECONDS, check=False)
        if done.returncode != 0:
            raise OSError(f"{compiler} failed: {done.stderr.strip()[:500]}")
        with built.open("rb") as file:
            os.fsync(file.fileno())  # raises where a full disk has no room for what it seemed to take
            target = folder / _file_name(target_set, _digest(file.read()))
        return built.replace(target)  # atomic: two processes may build at once


def _cache() -> Path:
    """Return the user's folder; raises OSError where there is no home, as of a container's user without a name."""
    try:
        root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError as exc:
        raise OSError(f"{exc} Set HOME or XDG_CACHE_HOME") from exc
    return Path(root) / "straightpcf"


def build_all(folder: Path) -> list[Path]:
    """Compile for every instruction set of this architecture, as an image does that does not know its processor."""
    return [build(folder, name) for name in _compiled_sets()]


def _file_name(target_set: str, content: str) -> str:
    """Return what a library is called, by what it is made of and by the digest of its content."""
    read = b"".join(path.read_bytes() for path in _SOURCES + _HEADERS)
    flags = f"{_FLAGS} {_compiled_sets()[target_set]}"
    return f"kernels-{platform.machine()}-{target_set}-{_digest(read + flags.encode())}-{content}.so"


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:12]


def _open_whole(path: Path) -> ctypes.CDLL:
    """Open a library that `build` made; raises OSError where it is cut short or overwritten.

    It is mapped, not read: one that is opened all the same ends the process, then or when it is first called.
    """
    if not path.stem.endswith(f"-{_digest(path.read_bytes())}"):
        raise OSError(f"{path} is damaged")
    return _open(path)


def _open(path: Path) -> ctypes.CDLL:
    library = ctypes.CDLL(str(path))
    packing = "pack", "pack_fine", "pack_coarse", "pack_linear"
    for name in ("knn", "edge_max", "edge_max_backward", "fused", *packing):
        try:
            getattr(library, f"straightpcf_{name}").restype = None
        except AttributeError as exc:
            raise OSError(f"{path} has other functions: {exc}") from exc
    return library


def _at(tensor: torch.Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def knn(library: ctypes.CDLL, x: torch.Tensor, k: int, rows: int) -> torch.Tensor:
    """Return (B, rows, k) int32 neighbours of the first `rows` points of each patch, x: (B, P, C) float32."""
    batch, count, dims = x.shape
    x = x.detach().contiguous()
    out = torch.empty(batch, rows, k, dtype=torch.int32)
    for patch, index in zip(x, out, strict=True):
        library.straightpcf_knn(_at(patch), count, dims, rows, k, _at(index))
    return out


def packed(library: ctypes.CDLL, weight: torch.Tensor, kernel: Packing) -> torch.Tensor:
    """Return a weight (D, C) float32 as a kernel reads it.

    kernel: "edge_max", D a multiple of 16 and C even; of the others both are multiples of 32.
    """
    weight = weight.contiguous()
    out = torch.empty_like(weight)
    pack = {
        "edge_max": library.straightpcf_pack,
        "edge_max_fine": library.straightpcf_pack_fine,
        "edge_max_coarse": library.straightpcf_pack_coarse,
        "linear": library.straightpcf_pack_linear,
    }[kernel]
    pack(_at(weight), weight.shape[1], weight.shape[0], _at(out))
    return out


class EdgeMax(torch.autograd.Function):
    """max_n W relu(a_i + b_index[i, n]) and its gradient; shapes as in `ops.edge_max`."""

    @staticmethod
    def forward(ctx, library, a, b, index, weight, want_grad):  # type: ignore[no-untyped-def]
        """Run the kernel patch by patch; remember the winning edge only where a gradient will be asked for."""
        batch, rows, width = a.shape
        k, out_width = index.shape[2], weight.shape[0]
        a, b, weight = a.contiguous(), b.contiguous(), weight.contiguous()
        ready = packed(library, weight, "edge_max")
        out = torch.empty(batch, rows, out_width, dtype=torch.float32)
        arg = torch.empty(batch, rows, out_width, dtype=torch.uint8) if want_grad else None
        for i in range(batch):
            library.straightpcf_edge_max(
                _at(a[i]), _at(b[i]), _at(index[i]), _at(ready), rows, k, width, out_width, _at(out[i]),
                _at(None if arg is None else arg[i]),
            )  # fmt: skip
        if arg is not None:
            ctx.library = library
            ctx.save_for_backward(a, b, index, weight, arg)
        return out

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        """Follow the winning edges back."""
        a, b, index, weight, arg = ctx.saved_tensors
        batch, rows, width = a.shape
        grad = grad.contiguous()
        grad_a, grad_b, grad_weight = torch.empty_like(a), torch.zeros_like(b), torch.zeros_like(weight)
        for i in range(batch):
            ctx.library.straightpcf_edge_max_backward(
                _at(grad[i]), _at(arg[i]), _at(a[i]), _at(b[i]), _at(index[i]), _at(weight), rows, b.shape[1],
                index.shape[2], width, weight.shape[0], _at(grad_a[i]), _at(grad_b[i]), _at(grad_weight),
            )  # fmt: skip
        return None, grad_a, grad_b, None, grad_weight, None
