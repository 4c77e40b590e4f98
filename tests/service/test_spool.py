from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from straightpcf.service.spool import Spool


def test_a_folder_and_all_in_it_is_gone_after_its_block_even_after_an_error(tmp_path: Path) -> None:
    with Spool(tmp_path) as spool:
        folders = []

        def fail() -> None:
            with spool.folder() as folder:
                folders.append(folder)
                (folder / "input").write_bytes(b"x")
                raise KeyError

        with pytest.raises(KeyError):
            fail()
        assert not folders[0].exists()


def test_nothing_is_left_when_a_server_ends(tmp_path: Path) -> None:
    with Spool(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_the_folder_of_a_killed_server_is_swept_and_that_of_a_living_one_is_not(tmp_path: Path) -> None:
    killed = (
        "import os, pathlib, sys; from straightpcf.service.spool import Spool; "
        "spool = Spool(pathlib.Path(sys.argv[1])); spool.folder().__enter__(); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", killed, str(tmp_path)], check=False)
    (orphan,) = tmp_path.iterdir()
    with Spool(tmp_path):
        assert not orphan.exists()
        (living,) = tmp_path.iterdir()
        with Spool(tmp_path):
            assert living.exists()
