"""The straight line from file to file: what cannot be written is refused before anything is filtered."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from straightpcf.points.errors import UnsupportedCloud
from straightpcf.points.formats.xyz import Xyz
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.backends.base import FileJob
from straightpcf.service.backends.denoise_file import denoise_file


def test_what_cannot_be_written_is_refused_before_the_filter_runs_whatever_the_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise UnsupportedCloud("has no packing")

    monkeypatch.setattr(Xyz, "check", refuse)
    (source := tmp_path / "a.xyz").write_bytes(b"0 0 0\n" * 50)
    job = FileJob(
        id="a", source=source, target=tmp_path / "b.xyz", options=DenoiseOptions(), max_points=100, name="a.xyz"
    )
    with pytest.raises(UnsupportedCloud, match="has no packing"):
        denoise_file(cast("Any", None), job)
