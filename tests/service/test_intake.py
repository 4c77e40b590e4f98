"""What a request may look like that brings a cloud, and what is said of one that may not."""

from __future__ import annotations

import asyncio
import io
import os
import time
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from straightpcf.service.api.disposition import disposition, disposition_name
from straightpcf.service.jobs.record import JobRecord, NewJob
from straightpcf.service.jobs.store import JobStore
from tests.clouds import noisy, torus
from tests.conftest import RunningServer
from tests.service.fakes import ObedientBackend
from tests.service.in_process import serving
from tests.service.rest import curl, raw
from tests.service.test_races import CLOUD, play, willing

XYZ = noisy(torus(400), 0.01)


def npy() -> bytes:
    np.save(buffer := io.BytesIO(), XYZ)
    return buffer.getvalue()


@pytest.mark.parametrize("method", ["POST", "PUT"])
def test_a_slash_behind_denoise_is_no_other_place(server: RunningServer, method: str) -> None:
    url = f"{server.url}/denoise/?iterations=1"  # `curl -T - URL/denoise/` sends this, and follows no redirect
    answer = httpx2.request(method, url, content=iter([npy()]), timeout=60)
    assert answer.status_code == 200, answer.text
    assert np.load(io.BytesIO(answer.content)).shape == XYZ.shape


def test_nor_is_a_slash_behind_jobs(server: RunningServer) -> None:
    made = httpx2.post(f"{server.url}/jobs/?iterations=1&filename=a.npy", content=npy(), timeout=60)
    assert made.status_code == 202, made.text
    assert httpx2.delete(f"{server.url}{made.headers['location']}").status_code == 204


@pytest.mark.parametrize(
    ("query", "form"),
    [
        ("?iterations=1&iterations=2", {}),
        ("?iterations=1", {"iterations": "2"}),
        ("", {"iterations": ["1", "2"]}),
    ],
)
@pytest.mark.parametrize("path", ["/denoise", "/jobs"])
def test_an_option_that_is_said_twice_is_refused_by_name(
    server: RunningServer, path: str, query: str, form: dict[str, str | list[str]]
) -> None:
    answer = httpx2.post(f"{server.url}{path}{query}", files={"file": ("a.npy", npy())}, data=form, timeout=60)
    assert answer.json()["code"] == "invalid_options"
    assert "'iterations'" in answer.json()["detail"]
    assert not server.spooled_files()


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("iterations=two", "iterations is 'two'; it must be \"auto\" or 1..10"),
        ("iterations=2.5", "iterations is '2.5'; it must be \"auto\" or 1..10"),
        ("seed=1.5", "seed is '1.5'; it must be an integer in 0..4294967295"),
        ("strength=0,5", "strength is '0,5'; it must be in 0..1"),
    ],
)
def test_an_option_that_is_no_number_is_told_the_limit(server: RunningServer, query: str, said: str) -> None:
    assert httpx2.post(f"{server.url}/jobs?{query}", content=npy()).json()["detail"] == said


def test_a_packed_body_is_refused_and_not_taken_for_points(server: RunningServer) -> None:
    url = f"{server.url}/denoise/frame.bin"
    answer = httpx2.put(url, content=bytes(1600), headers={"Content-Encoding": "gzip"})
    assert (answer.status_code, answer.json()["code"]) == (415, "unknown_format")
    assert "gzip" in answer.json()["detail"]
    for codings in (["identity", "gzip"], ["identity, br"], ["", "zstd"]):
        headers = [("Content-Encoding", coding) for coding in codings]
        assert httpx2.put(url, content=bytes(1600), headers=headers).status_code == 415, codings
    assert httpx2.put(url, content=npy(), headers={"Content-Encoding": "identity"}, timeout=60).status_code == 200


@pytest.mark.parametrize("path", ["/denoise/a.xyz", "/jobs/part?filename=a.xyz"])
def test_a_part_of_a_file_is_not_taken_for_the_whole(server: RunningServer, path: str, tmp_path: Path) -> None:
    """What `curl -C 1000 -T` sends to go on with an upload."""
    (cloud := tmp_path / "a.xyz").write_bytes(b"0.5 0.25 1\n" * 400)
    answer = curl("-C", "1100", "-T", cloud, f"{server.url}{path}")
    assert (answer.status, answer.problem()["code"]) == (400, "invalid_request")
    assert "'bytes 1100-4399/4400'" in answer.problem()["detail"]
    assert not httpx2.get(f"{server.url}/jobs").json()["jobs"]


@pytest.mark.parametrize("path", ["/denoise/", "/jobs?filename="])
@pytest.mark.parametrize("name", ["a.xyz", "a.npy"])
def test_a_file_that_curl_took_the_line_ends_from_is_told_so(
    server: RunningServer, path: str, name: str, tmp_path: Path
) -> None:
    text = "".join(f"{x} {y} {z}\n" for x, y, z in XYZ).encode()
    (cloud := tmp_path / name).write_bytes(npy() if name == "a.npy" else text)
    cut = curl("-d", f"@{cloud}", f"{server.url}{path}{name}")
    assert (cut.status, cut.problem()["code"]) == (400, "invalid_request")
    assert "--data-binary" in cut.problem()["detail"]
    whole = curl("--data-binary", f"@{cloud}", f"{server.url}{path}{name}")
    assert whole.status in (200, 202)


def test_a_packed_part_of_a_form_is_refused_too(server: RunningServer) -> None:
    for coding, status in (("base64", 415), ("quoted-printable", 415), ("Binary", 202), ("8bit", 202)):
        files = {"file": ("a.npy", npy(), "application/octet-stream", {"Content-Transfer-Encoding": coding})}
        answer = httpx2.post(f"{server.url}/jobs?iterations=1", files=files)
        assert answer.status_code == status, coding
        assert status == 202 or coding in answer.json()["detail"]


def test_text_without_a_name_is_told_to_bring_one(server: RunningServer) -> None:
    answer = httpx2.post(f"{server.url}/denoise", content=b"0 0 0\n" * 50, timeout=60)
    assert answer.json()["code"] == "unknown_format"
    assert "it needs a name with a suffix" in answer.json()["detail"]


def test_a_form_whose_boundary_is_not_said_is_told_so(server: RunningServer) -> None:
    for kind in ("multipart/form-data", "multipart/form-data; boundary="):
        form = (
            b'--b\r\nContent-Disposition: form-data; name="file"; filename="a.npy"\r\n\r\n' + npy() + b"\r\n--b--\r\n"
        )
        answer = httpx2.post(f"{server.url}/jobs", content=form, headers={"Content-Type": kind})
        assert (answer.status_code, answer.json()["code"]) == (400, "invalid_request")
        assert "names no boundary" in answer.json()["detail"]


@pytest.mark.parametrize("size", [1, 7, 10_000])
@pytest.mark.parametrize(
    "preamble", [b"", b"\r\n", b"This is a message with multiple parts - in MIME format.\r\n", b"--c\r\n"]
)
def test_what_stands_before_a_forms_first_boundary_is_ignored(
    server: RunningServer, preamble: bytes, size: int
) -> None:
    cloud = "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in XYZ[:50]).encode()
    form = b'--b\r\nContent-Disposition: form-data; name="file"; filename="a.xyz"\r\n\r\n' + cloud + b"\r\n--b--\r\n"
    whole = preamble + form + b"and behind the last"
    made = httpx2.put(
        f"{server.url}/jobs/form",
        content=(whole[at : at + size] for at in range(0, len(whole), size)),
        headers={"Content-Type": "multipart/form-data; boundary=b"},
    )
    assert made.status_code == 202, made.text
    assert (made.json()["name"], made.json()["bytes"]) == ("a.xyz", len(cloud))


@pytest.mark.parametrize("body", [b"", b"0 0 0\r\n", b"--c\r\n\r\n--c--\r\n", b"--b\r\n", b"text\r\n--b"])
def test_a_form_without_the_boundary_that_it_names_is_told_so(server: RunningServer, body: bytes) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=b"}
    answer = httpx2.post(f"{server.url}/jobs", content=body, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (400, "invalid_request")
    assert "without the closing boundary" in answer.json()["detail"]


def test_a_long_form_of_another_boundary_is_refused_before_it_is_all_there(server: RunningServer) -> None:
    head = "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=b\r\n"
    begun = f"{head}Content-Length: 100000000\r\n\r\n".encode() + b"--c\r\n" + bytes(100_000)
    problem = raw(server, begun).problem()
    assert (problem["status"], problem["code"]) == (400, "invalid_request")
    assert "boundary that Content-Type names" in problem["detail"]


@pytest.mark.parametrize(("id", "code"), [(".hidden", "invalid_request"), ("second", "quota_exceeded")])
def test_what_refuses_a_job_whatever_its_body_is_said_before_it_comes(tmp_path: Path, id: str, code: str) -> None:
    async def scenario() -> None:
        backend = willing()
        backend.finish.clear()
        async with serving(tmp_path, backend, max_jobs_per_key=1) as (_, host, port):
            async with httpx2.AsyncClient(base_url=f"http://{host}:{port}") as http:
                first = {"url": "/jobs/first?filename=a.xyz", "content": CLOUD}
                assert (await http.put(**first)).status_code == 202
                assert (await http.put(**first)).status_code == 200  # which is no other job
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(f"PUT /jobs/{id}?filename=a.xyz HTTP/1.1\r\nHost: localhost\r\n".encode())
            writer.write(b"Content-Length: 6\r\nExpect: 100-continue\r\n\r\n")
            answer = await asyncio.wait_for(reader.readuntil(b"}"), timeout=5)
            writer.close()
            assert b"100 Continue" not in answer
            assert f'"code":"{code}"'.encode() in answer

    play(scenario)


@pytest.mark.parametrize("form", [False, True], ids=["raw", "form"])
@pytest.mark.parametrize("path", ["/denoise", "/jobs"])
def test_an_empty_file_is_refused_at_once(server: RunningServer, path: str, form: bool) -> None:
    for name in ("a.ply", "a.xyz", ""):
        if form:
            answer = httpx2.post(f"{server.url}{path}", files={"file": (name, b"")})
        else:
            answer = httpx2.post(f"{server.url}{path}?filename={name}", content=b"")
        assert (answer.status_code, answer.json()["code"]) == (422, "malformed_file")
        assert answer.json()["detail"] == f"{name or 'the cloud'} is empty (0 bytes)"
    assert httpx2.put(f"{server.url}/jobs/empty", headers={"Content-Length": "0"}).status_code == 422
    assert httpx2.get(f"{server.url}/jobs").json()["jobs"] == []
    assert not server.spooled_files()


def test_a_name_whose_quotes_are_not_closed_is_read_in_one_go() -> None:
    began = time.process_time()  # looked for from each quote anew, the end held the whole server up for a minute
    assert disposition_name('attachment; filename="' + '\\"' * 20_000) is not None
    assert time.process_time() - began < 2
    assert disposition_name("""a; x="b; filename*=UTF-8''no"; filename*=UTF-8''yes""") == "yes"


@pytest.mark.parametrize("name", ["my scan_clean.ply", "scan (1)_clean.ply", "a,b=c@d+e[1]&{f}_clean.xyz"])
def test_a_result_whose_name_is_ascii_is_called_so_in_the_form_that_every_client_reads(name: str) -> None:
    assert disposition(name) == f'attachment; filename="{name}"'
    assert disposition_name(disposition(name)) == name


@pytest.mark.parametrize("name", ["é.ply", 'a"b.ply', "a\\b.ply", "a%20b.ply", "a;b.ply", "a*b.ply", "a'b.ply"])
def test_any_other_name_is_said_in_the_extended_form(name: str) -> None:
    assert disposition(name).startswith("attachment; filename*=utf-8''")
    assert disposition_name(disposition(name)) == name


def test_a_file_and_its_name_are_on_the_disk_before_its_job_is_committed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a power cut leaves of an accepted job."""
    sync, create = os.fsync, JobStore.create
    happened: list[Any] = []

    def watched_sync(handle: int) -> None:
        sync(handle)
        happened.append(Path(f"/proc/self/fd/{handle}").readlink())

    def watched_create(store: JobStore, job: NewJob) -> tuple[JobRecord, bool]:
        happened.append(job.folder)
        return create(store, job)

    async def ask() -> None:
        async with serving(tmp_path, ObedientBackend()) as (_, host, port), httpx2.AsyncClient() as http:
            assert (await http.put(f"http://{host}:{port}/jobs/a", content=b"0 0 0\n")).status_code == 202

    monkeypatch.setattr(os, "fsync", watched_sync)
    monkeypatch.setattr(JobStore, "create", watched_create)
    asyncio.run(ask())
    file, *folders, job = happened
    assert file.parent == tmp_path / "incoming"
    assert folders == [tmp_path / "jobs" / job, tmp_path / "jobs"]
