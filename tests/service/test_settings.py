from __future__ import annotations

from pathlib import Path

import pytest

from straightpcf.points.errors import InvalidOptions
from straightpcf.service.settings import Settings


def test_every_setting_is_read_from_the_environment() -> None:
    environment = {
        "STRAIGHTPCF_PORT": "9000",
        "STRAIGHTPCF_DATA_DIR": "/data",
        "STRAIGHTPCF_MAX_SYNC_SECONDS": "1.5",
        "STRAIGHTPCF_THREADS": "3",
        "STRAIGHTPCF_WEIGHTS": "w.safetensors",
        "STRAIGHTPCF_DEVICE": "cpu",
        "PATH": "/bin",
    }
    settings = Settings.from_environment(environment)
    assert settings == Settings(
        port=9000,
        data_dir=Path("/data"),
        max_sync_seconds=1.5,
        threads=3,
        weights=Path("w.safetensors"),
        device="cpu",
    )


def test_an_argument_wins_over_the_environment_and_none_does_not() -> None:
    settings = Settings.from_environment({"STRAIGHTPCF_PORT": "9000", "STRAIGHTPCF_HOST": "::1"}, port=1, host=None)
    assert (settings.port, settings.host) == (1, "::1")


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("STRAIGHTPCF_PROT", "1"),
        ("STRAIGHTPCF_PORT", "many"),
        ("STRAIGHTPCF_PORT", "65536"),
        ("STRAIGHTPCF_MAX_JOBS", "0"),
        ("STRAIGHTPCF_TILE_POINTS", "9999"),
    ],
)
def test_unknown_names_and_impossible_values_are_refused(variable: str, value: str) -> None:
    with pytest.raises(InvalidOptions, match=rf"(?i){variable.removeprefix('STRAIGHTPCF_')}|port"):
        Settings.from_environment({variable: value})
