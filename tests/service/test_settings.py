from __future__ import annotations

import re
import urllib.request
from pathlib import Path

import pytest

from straightpcf.points.errors import InvalidOptions
from straightpcf.service.app import create_app
from straightpcf.service.settings import Settings
from tests.conftest import run_server, serve
from tests.service.fakes import ObedientBackend

# What a pod is told of the Services straightpcf and straightpcf-grpc in its namespace.
KUBERNETES = {
    "STRAIGHTPCF_SERVICE_HOST": "10.0.0.1",
    "STRAIGHTPCF_SERVICE_PORT": "8000",
    "STRAIGHTPCF_SERVICE_PORT_HTTP": "8000",
    "STRAIGHTPCF_PORT": "tcp://10.0.0.1:8000",
    "STRAIGHTPCF_PORT_8000_TCP": "tcp://10.0.0.1:8000",
    "STRAIGHTPCF_PORT_8000_TCP_PROTO": "tcp",
    "STRAIGHTPCF_PORT_8000_TCP_PORT": "8000",
    "STRAIGHTPCF_PORT_8000_TCP_ADDR": "10.0.0.1",
    "STRAIGHTPCF_GRPC_SERVICE_HOST": "10.0.0.2",
    "STRAIGHTPCF_GRPC_SERVICE_PORT": "50051",
    "STRAIGHTPCF_GRPC_PORT": "tcp://[fd00::2]:50051",
    "STRAIGHTPCF_GRPC_PORT_50051_TCP": "tcp://[fd00::2]:50051",
}
OF_OTHERS = {
    "STRAIGHTPCF_URL": "http://127.0.0.1:8000",
    "STRAIGHTPCF_KEY": "alpha",
    "STRAIGHTPCF_NO_KERNELS": "1",
    "STRAIGHTPCF_TORCH": "cpu",
}


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


def test_a_blank_variable_is_a_setting_left_out_but_a_blank_key_file_opens_no_server() -> None:
    blank = dict.fromkeys(("STRAIGHTPCF_HOST", "STRAIGHTPCF_PORT", "STRAIGHTPCF_DATA_DIR", "STRAIGHTPCF_THREADS"), " ")
    assert Settings.from_environment(blank) == Settings()
    with pytest.raises(InvalidOptions, match="STRAIGHTPCF_API_KEYS_FILE is blank"):
        Settings.from_environment({"STRAIGHTPCF_API_KEYS_FILE": ""})


def test_one_port_is_not_for_both_transports_but_any_free_ones_are() -> None:
    with pytest.raises(InvalidOptions, match="port and grpc_port are both 8000"):
        Settings(grpc_port=8000)
    assert Settings(port=0, grpc_port=0).grpc_port == 0


def test_a_tilde_is_ones_home_also_where_no_shell_reads_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    names = ("data_dir", "weights", "api_keys_file")
    settings = Settings.from_environment({f"STRAIGHTPCF_{name.upper()}": f"~/{name}" for name in names})
    assert [getattr(settings, name) for name in names] == [tmp_path / name for name in names]
    assert Settings(data_dir=Path("~")).data_dir == tmp_path


def test_a_user_without_a_home_is_asked_for_a_data_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)  # as of a container's --user 12345
    with pytest.raises(InvalidOptions, match=r"data_dir is ~/.local/share/straightpcf, .*HOME is not set"):
        Settings()
    assert Settings(data_dir=tmp_path).data_dir == tmp_path


def test_what_kubernetes_and_our_other_programs_are_told_is_no_setting() -> None:
    assert Settings.from_environment(KUBERNETES | OF_OTHERS) == Settings()


def test_a_server_starts_beside_a_service_of_its_own_name(tmp_path: Path) -> None:
    with (
        run_server(tmp_path, environment=KUBERNETES | OF_OTHERS) as server,
        urllib.request.urlopen(f"{server.url}/livez") as answer,
    ):
        assert answer.status == 200


@pytest.mark.parametrize("key", ["clé", "кл\u044eч", "a\x01b"])
def test_a_key_that_no_header_can_carry_is_refused_under_its_settings_name(tmp_path: Path, key: str) -> None:
    (path := tmp_path / "keys").write_text(f"# die Schlüssel\nalpha\n{key}\n")
    for settings, name in (
        (Settings(api_keys=f"alpha,{key}"), "api_keys: key 2 of 2"),
        (Settings(api_keys_file=path), f"api_keys_file {path}: key 2 of 2"),
    ):
        with pytest.raises(InvalidOptions, match=re.escape(name)) as refused:
            settings.keys()
        assert key not in str(refused.value)
    path.write_text("# die Schlüssel\nalpha\n")
    assert Settings(api_keys_file=path).keys() == ("alpha",)


def test_a_hash_begins_a_comment_in_a_file_alone(tmp_path: Path) -> None:
    (path := tmp_path / "keys").write_text("#alpha\n  # beta\ngamma#1\n")
    assert Settings(api_keys="#alpha, #beta").keys() == ("#alpha", "#beta")
    assert Settings(api_keys="#alpha", api_keys_file=path).keys() == ("#alpha", "gamma#1")


@pytest.mark.parametrize("text", ["alpha\r\nbeta\r\n", "# die Schlüssel\r\nalpha\r\nbeta"])
def test_a_file_of_keys_may_be_one_that_windows_saved(text: str, tmp_path: Path) -> None:
    (path := tmp_path / "keys").write_bytes(text.encode("utf-8-sig"))
    assert Settings(api_keys_file=path).keys() == ("alpha", "beta")


@pytest.mark.parametrize("value", [",", " , ,"])
def test_keys_that_are_set_but_hold_none_open_no_server(value: str, tmp_path: Path) -> None:
    (path := tmp_path / "keys").write_text("alpha\n")
    for file in (None, path):
        with pytest.raises(InvalidOptions, match="api_keys holds no key"):
            Settings.from_environment({"STRAIGHTPCF_API_KEYS": value}, api_keys_file=file).keys()


@pytest.mark.parametrize(("name", "value"), [("API_KEYS", "clé"), ("API_KEYS", ","), ("WEIGHTS", "no/such/weights")])
def test_serve_ends_at_once_with_a_key_that_would_never_match_or_without_its_weights(
    name: str, value: str, tmp_path: Path
) -> None:
    done = serve("--data-dir", tmp_path, environment={f"STRAIGHTPCF_{name}": value})
    assert done.returncode == 2
    assert name.lower() in done.stderr
    assert "Started server process" not in done.stderr


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[
            ("cors_origins", each)
            for each in ("friend.example", "https://a.example/", "http://a.example:80", "https://")
        ],
        *[
            ("allowed_hosts", each)
            for each in (
                "a.example:8000",
                "10.0.0.1:8000",
                "cafe:80",
                "https://a.example",
                "*",
                "münchen.example",
                "a.example.",
            )
        ],
    ],
)
def test_a_host_or_an_origin_that_no_browser_ever_names_keeps_a_server_from_starting(
    name: str, value: str, tmp_path: Path
) -> None:
    settings = Settings(data_dir=tmp_path, **{name: f"good.example,{value}" if name == "allowed_hosts" else value})
    with pytest.raises(InvalidOptions, match=rf"{name}: .*{re.escape(value)}"):
        create_app(settings, backend=ObedientBackend())


def test_hosts_and_origins_are_read_in_small_letters() -> None:
    settings = Settings(cors_origins="*, null, HTTPS://A.example:8443", allowed_hosts="A.example, [fd00::2], 10.0.0.1")
    assert settings.origins() == ("*", "null", "https://a.example:8443")
    assert settings.hosts() == ("a.example", "fd00::2", "10.0.0.1")


def test_compose_lets_a_server_end_in_peace() -> None:
    compose = (Path(__file__).parents[2] / "compose.yaml").read_text()
    grace = re.search(r"stop_grace_period: (\d+)s", compose)
    assert grace
    assert int(grace[1]) >= Settings().shutdown_seconds + 10


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("STRAIGHTPCF_PROT", "1"),
        ("STRAIGHTPCF_PORT", "many"),
        ("STRAIGHTPCF_GRPC_PROT", "tcp://10.0.0.1:8000"),
        ("STRAIGHTPCF_PORT", "http://10.0.0.1:8000"),
        ("STRAIGHTPCF_SERVICE", "10.0.0.1"),
        ("STRAIGHTPCF_PORT", "65536"),
        ("STRAIGHTPCF_MAX_JOBS", "1_000"),
        ("STRAIGHTPCF_MAX_SYNC_SECONDS", "٣"),
        ("STRAIGHTPCF_MAX_JOBS", "0"),
        ("STRAIGHTPCF_MAX_POINTS", "9223372036854775808"),
        ("STRAIGHTPCF_TILE_POINTS", "9999"),
        ("STRAIGHTPCF_ROOT_PATH", "straightpcf"),
        ("STRAIGHTPCF_ROOT_PATH", "/straightpcf/"),
        ("STRAIGHTPCF_ROOT_PATH", "https://host/straightpcf"),
        ("STRAIGHTPCF_RESULT_TTL_SECONDS", "inf"),
        ("STRAIGHTPCF_RESULT_TTL_SECONDS", "nan"),
        ("STRAIGHTPCF_ROW_TTL_SECONDS", "1e12"),
        ("STRAIGHTPCF_MAX_SYNC_SECONDS", "inf"),
    ],
)
def test_unknown_names_and_impossible_values_are_refused(variable: str, value: str) -> None:
    with pytest.raises(InvalidOptions, match=rf"(?i){variable.removeprefix('STRAIGHTPCF_')}|port"):
        Settings.from_environment({variable: value})
