"""The REST API over real sockets, as curl sees it."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import httpx2
import numpy as np
import pytest

from straightpcf.points.errors import ERRORS_BY_CODE
from straightpcf.points.formats import read_cloud
from straightpcf.service.api.errors import STATUS_BY_CODE
from tests.clouds import noisy, sphere, torus
from tests.conftest import RunningServer
from tests.service.rest import POINTS, curl, load, npy, raw


def test_a_form_a_raw_post_a_put_and_a_chunked_body_give_the_same_bytes(server: RunningServer, cloud: Path) -> None:
    url = f"{server.url}/denoise"
    answers = [
        curl("-F", f"file=@{cloud}", "-F", "iterations=1", url),
        curl("-F", "iterations=1", "-F", f"file=@{cloud}", url),
        curl("--data-binary", f"@{cloud}", f"{url}?iterations=1"),
        curl("-T", cloud, f"{url}?iterations=1"),
        curl("-T", cloud, f"{server.url}/denoise/torus.npy?iterations=1"),
        curl("-T", "-", f"{url}?iterations=1", stdin=cloud.read_bytes()),
    ]
    assert {answer.status for answer in answers} == {200}
    assert len({answer.body for answer in answers}) == 1
    result = load(answers[0])
    assert result.dtype == np.float32
    assert result.shape == (POINTS, 3)


def test_the_headers_say_what_was_done(server: RunningServer, cloud: Path) -> None:
    answer = curl("-F", f"file=@{cloud}", "-F", "iterations=1", "-H", "X-Request-Id: mine-1", f"{server.url}/denoise")
    assert answer.headers["x-request-id"] == "mine-1"
    assert answer.headers["x-points"] == str(POINTS)
    assert answer.headers["x-iterations"] == "1"
    assert answer.headers["x-untouched"] == "0"
    assert float(answer.headers["x-noise-before"]) >= 0
    assert float(answer.headers["x-noise-after"]) >= 0
    assert answer.headers["content-disposition"] == 'attachment; filename="torus_clean.npy"'
    assert int(answer.headers["content-length"]) == len(answer.body)


def test_the_name_of_the_result_never_holds_a_path_or_a_line_break(server: RunningServer, cloud: Path) -> None:
    for name in ("..%2F..%2Fetc%2Fscan.npy", "C%3A%5Cdata%5Cscan.npy", "a%0D%0AX-Evil%3A1%2Fscan.npy"):
        answer = curl("--data-binary", f"@{cloud}", f"{server.url}/denoise?iterations=1&filename={name}")
        assert answer.headers["content-disposition"] == 'attachment; filename="scan_clean.npy"'
        assert "x-evil" not in answer.headers


def test_the_name_of_the_result_can_be_that_of_a_file(server: RunningServer, cloud: Path) -> None:
    for name in ("点" * 83 + ".npy", "🙂" * 200 + ".npy"):  # the first is as long as a file's name may be
        url = f"{server.url}/denoise?iterations=1&filename={quote(name)}"
        told = curl("--data-binary", f"@{cloud}", url).headers["content-disposition"]
        saved = unquote(told.removeprefix("attachment; filename*=utf-8''"), errors="strict")
        assert 250 <= len(saved.encode()) <= 255
        assert saved == f"{name[0] * (len(saved) - 10)}_clean.npy"


def test_the_result_has_the_format_that_was_asked_for(server: RunningServer, cloud: Path) -> None:
    answer = curl("-F", f"file=@{cloud}", "-F", "iterations=1", "-F", "format=xyz", f"{server.url}/denoise")
    assert answer.headers["content-disposition"] == 'attachment; filename="torus_clean.xyz"'
    assert np.loadtxt(io.BytesIO(answer.body)).shape == (POINTS, 3)


def test_strength_zero_gives_the_input_back(server: RunningServer, cloud: Path) -> None:
    answer = curl("-F", f"file=@{cloud}", "-F", "iterations=1", "-F", "strength=0", f"{server.url}/denoise")
    np.testing.assert_array_equal(load(answer), np.load(cloud))


def test_several_objects_in_one_cloud_are_denoised_and_reported(server: RunningServer, tmp_path: Path) -> None:
    np.save(path := tmp_path / "two.npy", np.vstack([noisy(torus(600), 0.01), noisy(torus(600), 0.01) + 100.0]))
    answer = curl("-F", f"file=@{path}", "-F", "iterations=1", "--max-time", "60", f"{server.url}/denoise")
    assert (answer.status, answer.headers["x-points"], answer.headers["x-untouched"]) == (200, "1200", "0")


def test_rows_that_are_not_finite_pass_through(server: RunningServer, tmp_path: Path) -> None:
    xyz = noisy(torus(POINTS), 0.01)
    xyz[3], xyz[399] = np.nan, np.inf
    np.save(path := tmp_path / "holes.npy", xyz)
    answer = curl("-F", f"file=@{path}", "-F", "iterations=1", f"{server.url}/denoise")
    assert answer.headers["x-untouched"] == "2"
    np.testing.assert_array_equal(load(answer)[[3, 399]], xyz[[3, 399]])


def _zip_bomb() -> bytes:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (20_000_000, 3)})
    with (
        zipfile.ZipFile(buffer := io.BytesIO(), "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("xyz.npy", "w", force_zip64=True) as entry,
    ):
        entry.write(header.getvalue())
        for _ in range(60):
            entry.write(bytes(8_000_000))
    return buffer.getvalue()


_PLY = b"ply\nformat %s 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


BAD_BODIES = {
    "wrong magic": ("scan.ply", b"GIF89a" + bytes(range(256)), {"malformed_file", "unknown_format"}),
    "no format at all": (None, bytes(range(256)), {"unknown_format"}),
    "truncated binary": ("scan.ply", _PLY % (b"binary_little_endian", 500) + bytes(700), {"malformed_file"}),
    "truncated ascii": ("scan.ply", _PLY % (b"ascii", 500) + b"0 0 0\n" * 20, {"malformed_file"}),
    "zero points": ("scan.ply", _PLY % (b"ascii", 0), {"too_few_points", "malformed_file"}),
    "one point": ("one.npy", npy(np.zeros((1, 3))), {"too_few_points"}),
    "10 points": ("ten.npy", npy(sphere(10)), {"too_few_points"}),
    "all NaN": ("nan.npy", npy(np.full((500, 3), np.nan)), {"too_few_points"}),
    "1e9 vertices": (
        "scan.ply",
        _PLY % (b"binary_little_endian", 10**9) + bytes(1200),
        {"too_many_points", "malformed_file"},
    ),
    "4e9 vertices": ("scan.ply", _PLY % (b"ascii", 4 * 10**9) + b"0 0 0\n", {"too_many_points", "malformed_file"}),
    "pickle in npy": ("evil.npy", npy(np.array([{}, None], dtype=object)), {"malformed_file", "unsupported_cloud"}),
    "zip bomb": ("bomb.npz", _zip_bomb(), {"too_many_points", "malformed_file", "too_large"}),
}


@pytest.mark.parametrize("case", BAD_BODIES)
def test_a_bad_file_is_a_problem_with_its_code_and_the_server_goes_on(
    case: str, server: RunningServer, tmp_path: Path
) -> None:
    name, body, codes = BAD_BODIES[case]
    (path := tmp_path / "body").write_bytes(body)
    worker = server.worker_pid()
    query = f"?filename={name}" if name else ""
    problem = curl("--data-binary", f"@{path}", f"{server.url}/denoise{query}").problem()
    assert problem["code"] in codes, problem
    assert problem["status"] == STATUS_BY_CODE[problem["code"]]
    assert server.worker_pid() == worker, "the worker did not survive"
    assert curl(f"{server.url}/readyz").status == 200
    assert not server.spooled_files()


@pytest.mark.parametrize(
    "xyz",
    [np.ones((200, 3)), sphere(200) * 1e-30, sphere(200) * 1e6 + [5e6, -4e6, 3e5]],
    ids=["all equal", "tiny", "far"],
)
def test_an_odd_cloud_is_denoised_to_finite_points(server: RunningServer, xyz: Any) -> None:
    answer = curl("--data-binary", "@-", f"{server.url}/denoise?iterations=1", stdin=npy(xyz))
    assert np.isfinite(load(answer)).all()


@pytest.mark.parametrize(
    "xyz", [sphere(200) * 1e300, np.sign(sphere(200)) * 1.7e308], ids=["sphere", "corners of a cube"]
)
def test_huge_coordinates_end_in_a_problem_or_in_finite_points(server: RunningServer, xyz: Any) -> None:
    answer = curl("--data-binary", "@-", f"{server.url}/denoise?iterations=1", stdin=npy(xyz))
    if answer.status == 200:
        assert np.isfinite(load(answer)).all()
    else:
        assert issubclass(ERRORS_BY_CODE[answer.problem()["code"]], ERRORS_BY_CODE["invalid_request"])


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ("iterations=0", "1..10"),
        ("iterations=many", "iterations"),
        ("seed=-1", "seed"),
        ("strength=nan", "0..1"),
        ("speed=9", "speed"),
    ],
)
def test_a_bad_option_is_refused_before_the_body_is_read(server: RunningServer, query: str, word: str) -> None:
    request = f"POST /denoise?{query} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000000\r\n\r\n"
    problem = raw(server, request.encode()).problem()
    assert problem["code"] == "invalid_options"
    assert word in problem["detail"]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("-F", "cloud=@{cloud};type=x/y"), "invalid_request"),
        (("-F", "iterations=1"), "invalid_request"),
        (("-F", "file=@{cloud}", "-F", "file=@{cloud}"), "invalid_request"),
        (("-F", "file=@{cloud}", "-F", "iterations=x"), "invalid_options"),
        (("-F", "file=@{cloud}", "-F", "format=gif"), "unknown_format"),
        (("-H", "Content-Type: multipart/form-data", "-d", "x"), "invalid_request"),
        (("-H", "Content-Type: multipart/form-data; boundary=b", "-d", "--b\r\nbroken"), "invalid_request"),
    ],
)
def test_a_bad_form_is_a_problem(server: RunningServer, cloud: Path, arguments: tuple[str, ...], code: str) -> None:
    filled = [argument.format(cloud=cloud) for argument in arguments]
    assert curl(*filled, f"{server.url}/denoise").problem()["code"] == code


@pytest.mark.parametrize(("method", "path", "status"), [("GET", "/nowhere", 404), ("DELETE", "/denoise", 405)])
def test_wrong_paths_and_methods_are_problems_too(server: RunningServer, method: str, path: str, status: int) -> None:
    answer = curl("-X", method, f"{server.url}{path}")
    assert answer.problem()["status"] == status


@pytest.mark.parametrize(
    ("path", "allow"),
    [
        ("/jobs", "GET, HEAD, POST"),
        ("/jobs/", "GET, HEAD, POST"),
        ("/jobs/some", "GET, HEAD, PUT, DELETE"),
        ("/denoise", "POST, PUT"),
        ("/readyz", "GET, HEAD"),
        ("/jobs/some/cancel", "POST"),
        ("/", "GET, HEAD"),
    ],
)
def test_a_wrong_method_is_told_every_right_one(server: RunningServer, path: str, allow: str) -> None:
    answer = curl("-X", "PATCH", f"{server.url}{path}")
    assert answer.problem()["code"] == "method_not_allowed"
    assert answer.headers["allow"] == allow


def test_head_answers_as_get_does_without_the_body(server: RunningServer) -> None:
    with httpx2.Client(base_url=server.url) as client:
        for path in ("/livez", "/healthz", "/readyz", "/jobs", "/v1/info", "/", "/jobs/nope", "/docs", "/openapi.json"):
            get, head = client.get(path), client.head(path)
            assert (head.status_code, head.content) == (get.status_code, b""), path
            assert head.headers["content-type"] == get.headers["content-type"]
            assert head.headers["content-length"] == get.headers["content-length"]


@pytest.mark.parametrize("path", ["/jobs?limit=0", "/jobs?state=foo", "/jobs/some?wait=nan"])
def test_a_query_parameter_that_cannot_be_read_is_422(server: RunningServer, path: str) -> None:
    problem = curl(f"{server.url}{path}").problem()
    assert (problem["status"], problem["code"]) == (422, "invalid_request")


@pytest.mark.parametrize(
    ("disposition", "name"),
    [
        ("attachment; filename*=UTF-8''%E2%98%83.npy", "%E2%98%83_clean.npy"),
        ("attachment; filename=\"plain.npy\"; filename*=utf-8'en'%e2%98%83.npy", "%E2%98%83_clean.npy"),
        ("attachment; filename*=iso-8859-1''caf%E9.npy; filename=plain.npy", "caf%C3%A9_clean.npy"),
        ("attachment; filename*=UTF-8''..%2F..%2Fetc%2Fscan.npy", "scan_clean.npy"),
        ("attachment; filename=\"a; filename*=UTF-8''b.npy\"", "a%3B%20filename%2A%3DUTF-8%27%27b_clean.npy"),
        ("attachment; filename*=UTF-8''; filename=plain.npy", "plain_clean.npy"),
    ],
)
def test_a_body_is_called_what_its_content_disposition_says(
    server: RunningServer, cloud: Path, disposition: str, name: str
) -> None:
    said = f"Content-Disposition: {disposition}"
    answer = curl("--data-binary", f"@{cloud}", "-H", said, f"{server.url}/denoise?iterations=1")
    plain, extended = f'attachment; filename="{name}"', f"attachment; filename*=utf-8''{name}"
    assert answer.headers["content-disposition"] == (extended if "%" in name else plain)


def test_a_form_part_may_say_its_name_in_the_extended_way(server: RunningServer, cloud: Path) -> None:
    head = b"--b\r\nContent-Disposition: form-data; name=\"file\"; filename*=UTF-8''%E2%98%83.npy\r\n\r\n"
    body = head + cloud.read_bytes() + b"\r\n--b--\r\n"
    kind = "Content-Type: multipart/form-data; boundary=b"
    answer = curl("--data-binary", "@-", "-H", kind, f"{server.url}/denoise?iterations=1", stdin=body)
    assert answer.headers["content-disposition"] == "attachment; filename*=utf-8''%E2%98%83_clean.npy"


def test_the_openapi_document_has_examples_and_problems(server: RunningServer) -> None:
    document = json.loads(curl(f"{server.url}/openapi.json").body)
    post = document["paths"]["/denoise"]["post"]
    assert "example" in post["requestBody"]["content"]["multipart/form-data"]
    assert "application/octet-stream" in post["requestBody"]["content"]
    assert {"413", "415", "422", "503"} <= set(post["responses"])
    assert "application/problem+json" in post["responses"]["422"]["content"]
    assert "example" in document["components"]["schemas"]["Problem"]
    for path, operations in document["paths"].items():
        for operation in operations.values():
            names = [(each["name"], each["in"]) for each in operation.get("parameters", [])]
            assert len(names) == len(set(names))
            assert ("{filename}" in path) == (("filename", "path") in names)


def test_the_openapi_document_names_the_headers_that_are_read(server: RunningServer) -> None:
    paths = json.loads(curl(f"{server.url}/openapi.json").body)["paths"]
    for method, path, headers in (
        ("post", "/denoise", {"Idempotency-Key", "Prefer"}),
        ("put", "/denoise/{filename}", {"Idempotency-Key", "Prefer"}),
        ("post", "/jobs", {"Idempotency-Key"}),
        ("put", "/jobs/{id}", {"Idempotency-Key"}),
        ("get", "/jobs/{id}/events", {"Last-Event-ID"}),
        ("get", "/jobs/{id}/result", {"Range", "If-Range", "If-Match", "If-None-Match"}),
        ("head", "/jobs/{id}/result", {"Range", "If-Range", "If-Match", "If-None-Match"}),
    ):
        named = {each["name"] for each in paths[path][method]["parameters"] if each["in"] == "header"}
        assert named == headers, path


def test_the_openapi_document_shows_a_job_with_all_that_it_has(server: RunningServer) -> None:
    job = json.loads(curl(f"{server.url}/openapi.json").body)["components"]["schemas"]["Job"]
    assert set(job["example"]) == set(job["required"])
    assert job["example"]["result"] is None


def test_the_openapi_document_says_the_limits_of_numbers(server: RunningServer) -> None:
    paths = json.loads(curl(f"{server.url}/openapi.json").body)["paths"]
    for path, name, least, most in (("/jobs", "limit", 1, 200), ("/jobs/{id}", "wait", 0, 60)):
        (schema,) = (each["schema"] for each in paths[path]["get"]["parameters"] if each["name"] == name)
        assert (schema.get("minimum"), schema.get("maximum")) == (least, most)


def test_the_openapi_document_names_what_becomes_of_a_job_meanwhile(server: RunningServer) -> None:
    paths = json.loads(curl(f"{server.url}/openapi.json").body)["paths"]
    assert "404" in paths["/denoise"]["post"]["responses"]  # deleted while it waits
    for part in ("result", "report", "stream"):
        assert "507" in paths[f"/jobs/{{id}}/{part}"]["get"]["responses"]  # it failed for want of room


def test_the_openapi_document_says_where_a_key_is_wanted(server: RunningServer) -> None:
    document = json.loads(curl(f"{server.url}/openapi.json").body)
    scheme = document["components"]["securitySchemes"]["key"]
    assert (scheme["type"], scheme["scheme"]) == ("http", "bearer")
    for path, operations in document["paths"].items():
        for operation in operations.values():
            is_open = path in ("/livez", "/healthz", "/readyz")
            assert ("401" in operation["responses"]) is not is_open, path
            assert operation.get("security") == (None if is_open else [{"key": []}]), path


def test_info_says_what_the_server_takes(strict_server: RunningServer) -> None:
    info = json.loads(curl(f"{strict_server.url}/v1/info").body)
    assert (info["max_bytes"], info["max_points"], info["max_jobs"]) == (100_000, 4_000, 1)
    assert info["devices"] == ["cpu"]
    assert "ply" in {entry["name"] for entry in info["formats"]}


def test_normals_are_recomputed_where_a_file_has_some(server: RunningServer, tmp_path: Path) -> None:
    xyz = noisy(sphere(POINTS), 0.01)
    names = ("x", "y", "z", "nx", "ny", "nz")
    lines = [
        "ply", "format binary_little_endian 1.0", f"element vertex {POINTS}",
        *(f"property float {name}" for name in names), "end_header", "",
    ]  # fmt: skip
    body = "\n".join(lines).encode() + np.hstack([xyz, xyz]).astype("<f4").tobytes()
    query = f"{server.url}/denoise?iterations=1&normals=recompute"
    answer = curl("--data-binary", "@-", query, stdin=body)
    table = np.frombuffer(answer.body[-len(np.hstack([xyz, xyz]).astype("<f4").tobytes()) :], "<f4").reshape(-1, 6)
    np.testing.assert_allclose(np.linalg.norm(table[:, 3:], axis=1), 1.0, atol=1e-5)
    assert ((table[:, :3] * table[:, 3:]).sum(axis=1) > 0).all()
    for bad in (f"{query}&format=xyz", f"{server.url}/denoise?normals=flip"):
        assert curl("--data-binary", "@-", bad, stdin=body).problem()["status"] == 422
    assert curl("--data-binary", "@-", query, stdin=npy(xyz)).problem()["code"] == "unsupported_cloud"
    np.savez(packed := io.BytesIO(), points=xyz, normals=xyz.astype(np.float32))
    for format, status in {"ply": 200, "pcd": 200, "e57": 200, "npz": 422}.items():
        answer = curl("--data-binary", "@-", f"{query}&format={format}", stdin=packed.getvalue())
        assert answer.status == status
        if status == 422:
            assert answer.problem()["detail"] == "normals=recompute is for ply, pcd, e57; the result would be npz"
            continue
        (path := tmp_path / f"a.{format}").write_bytes(answer.body)
        np.testing.assert_allclose(np.linalg.norm(read_cloud(path)[0].old_normals(), axis=1), 1.0, atol=1e-5)
