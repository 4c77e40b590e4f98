"""install.sh, with other programs in the place of those that would change this machine."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="install.sh is for Debian and Ubuntu")

# Makes of `-m venv` what the rest of the script calls; `$0.old` and `$0.bare` say what else it is.
PYTHON = """#!/bin/bash
case "$*" in
  *version_info*) [ ! -e "$0.old" ] ;;
  *ensurepip*) [ ! -e "$0.bare" ] ;;
  *venv*) mkdir -p .venv/bin; for it in python pip straightpcf; do printf '#!/bin/bash\\n' > .venv/bin/$it; done
          chmod +x .venv/bin/* ;;
esac
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copy(Path(__file__).parents[1] / "install.sh", tmp_path)
    (tmp_path / "bin").mkdir()
    dpkg = '#!/bin/bash\n[[ "$*" != *-venv ]]\n'
    asked = f'#!/bin/bash\necho "$@" >> {tmp_path}/asked\n'
    for name, text in {"python3.12": PYTHON, "dpkg": dpkg, "apt-get": asked, "sudo": '#!/bin/bash\n"$@"\n'}.items():
        (path := tmp_path / "bin" / name).write_text(text)
        path.chmod(0o755)
    return tmp_path


def install(folder: Path, **settings: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "PYTHON": "python3.12", **settings}
    return subprocess.run(
        ["bash", "install.sh"], cwd=folder, env=environment, capture_output=True, text=True, timeout=60, check=False
    )


def test_a_python_that_is_too_old_is_refused_and_leaves_no_environment(folder: Path) -> None:
    (folder / "bin" / "python3.12.old").touch()
    ended = install(folder)
    assert ended.returncode == 1
    assert ended.stderr.startswith("python3.12 is no Python 3.11 or newer")
    assert not (folder / ".venv").exists()
    (folder / "bin" / "python3.12.old").unlink()
    assert install(folder).returncode == 0


def test_an_environment_without_pip_is_made_again(folder: Path) -> None:
    (folder / ".venv" / "bin").mkdir(parents=True)
    (python := folder / ".venv" / "bin" / "python").write_text("#!/bin/bash\n")
    python.chmod(0o755)
    assert install(folder).returncode == 0
    assert (folder / ".venv" / "bin" / "pip").exists()


def test_another_pythons_own_package_is_installed(folder: Path) -> None:
    (folder / "bin" / "python3.12.bare").touch()
    assert install(folder).returncode == 0
    assert (folder / "asked").read_text().split()[-1] == "python3.12-venv"


def test_a_torch_that_there_is_not_is_refused_before_anything_is_done(folder: Path) -> None:
    ended = install(folder, STRAIGHTPCF_TORCH="CPU")
    assert (ended.returncode, ended.stderr) == (1, "STRAIGHTPCF_TORCH is CPU; it must be cpu or cuda\n")
    assert not (folder / ".venv").exists()


@pytest.mark.parametrize(("offered", "wanted"), [("2.14.1, 2.13.0+cpu", ",==2.13.0+cpu"), ("2.14.1", "")])
def test_a_cpu_build_of_torch_is_taken_where_an_index_has_one(folder: Path, offered: str, wanted: str) -> None:
    assert install(folder).returncode == 0
    pip = f'[ "$1" = index ] && echo "Available versions: {offered}" || echo "$@" >> {folder}/asked'
    for name, does in {"pip": pip, "python": '[ "$2" != "import torch" ]'}.items():
        (folder / ".venv" / "bin" / name).write_text(f"#!/bin/bash\n{does}\n")
    assert install(folder, STRAIGHTPCF_TORCH="cpu").returncode == 0
    of_torch, of_all = (folder / "asked").read_text().splitlines()
    assert of_torch.startswith(f"install -q torch>=2.6,<3{wanted} ")
    assert of_all == "install -q -e .[dev]"


def test_a_torch_without_cuda_that_was_there_before_is_named_where_cuda_is_wanted(folder: Path) -> None:
    assert install(folder, STRAIGHTPCF_TORCH="cuda").stderr == ""
    python = folder / ".venv" / "bin" / "python"
    python.write_text('#!/bin/bash\n[[ "$*" != *torch.version.cuda* ]]\n')  # None there
    ended = install(folder, STRAIGHTPCF_TORCH="cuda")
    assert (ended.returncode, "no CUDA, and stays" in ended.stderr) == (0, True)
    assert install(folder, STRAIGHTPCF_TORCH="cpu").stderr == ""
