#!/usr/bin/env bash
# Install straightpcf and everything its tests need into .venv, on a fresh Debian or Ubuntu.
# PYTHON=python3.12 picks another interpreter; STRAIGHTPCF_TORCH=cuda|cpu overrides what is detected.
set -euo pipefail
cd "$(dirname "$0")"

torch=${STRAIGHTPCF_TORCH:-$(command -v nvidia-smi >/dev/null 2>&1 && echo cuda || echo cpu)}
if [ "$torch" != cpu ] && [ "$torch" != cuda ]; then # a typing error would be a download of several GB
  echo "STRAIGHTPCF_TORCH is $torch; it must be cpu or cuda" >&2
  exit 1
fi
need=(g++ curl)                       # g++ compiles the CPU kernels at first use; the tests call curl
python=${PYTHON:-python3}
"$python" -c 'import venv, ensurepip' 2>/dev/null || need+=("$(basename "$python")-venv") # it brings python3, too
missing=()
for package in "${need[@]}"; do
  dpkg -s "$package" >/dev/null 2>&1 || missing+=("$package")
done
if ((${#missing[@]})); then
  sudo=""; [ "$(id -u)" = 0 ] || sudo=sudo
  $sudo apt-get update -q
  $sudo apt-get install -q -y --no-install-recommends "${missing[@]}"
fi

# Before .venv is made of it, which the next run would take again.
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
  echo "$python is no Python 3.11 or newer; with one, say PYTHON=python3.12 bash install.sh" >&2
  exit 1
fi
[ -x .venv/bin/pip ] || "$python" -m venv .venv # without pip it was left by a run that failed
if [ "$torch" = cpu ] && ! .venv/bin/python -c 'import torch' 2>/dev/null; then
  # The public index serves CUDA builds of torch, PyTorch's own the CPU build; where that one cannot be reached, another
  # index in use may have such a build, older than its newest. Where none has, that index decides.
  pytorch=(--retries 0 --timeout 10 --index-url https://download.pytorch.org/whl/cpu)
  build=$(.venv/bin/pip index versions torch "${pytorch[@]}" 2>/dev/null | grep -o '[0-9.]*+cpu' | head -n 1 || true)
  .venv/bin/pip install -q "torch>=2.6,<3${build:+,==$build}" "${pytorch[@]}" 2>/dev/null || true
fi
.venv/bin/pip install -q -e '.[dev]'
# pip compiles what it copies, not what it links to; where PYTHONDONTWRITEBYTECODE is set nothing else would.
.venv/bin/python -m compileall -q points model service clients src # it follows no links
if [ "$torch" = cuda ] && ! .venv/bin/python -c 'import sys, torch; sys.exit(torch.version.cuda is None)'; then
  echo "the torch in .venv has no CUDA, and stays: for another one, remove .venv and install anew" >&2
fi
.venv/bin/straightpcf version
