"""The job routes over real sockets."""

from __future__ import annotations

import hashlib
import io
import json
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from straightpcf.points.wire.patches import PATCHES_MEDIA_TYPE, PatchReader
from tests.clouds import noisy, sphere, torus
from tests.conftest import RunningServer, run_server
from tests.service.rest import curl
from tests.waiting import wait_for


@pytest.fixture
def http(server: RunningServer) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=server.url, timeout=60) as client:
        yield client


def npy(xyz: np.ndarray[Any, Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, xyz)
    return buffer.getvalue()


SMALL = npy(noisy(torus(300), 0.01))
LARGE = npy(noisy(sphere(12_000), 0.01))  # ten passes take a worker many seconds


def make(http: httpx2.Client, body: bytes = SMALL, *, iterations: int = 1, **headers: str) -> dict[str, Any]:
    answer = http.post(f"/jobs?iterations={iterations}", content=body, headers=headers)
    assert answer.status_code == 202, answer.text
    return dict(answer.json())


def finished(http: httpx2.Client, id: str) -> dict[str, Any]:
    return dict(http.get(f"/jobs/{id}?wait=60").json())


def sse(lines: Iterator[str]) -> list[dict[str, Any]]:
    events, event = [], {}
    for line in lines:
        if line == "" and event:
            events.append(event)
            event = {}
        elif line and not line.startswith(":"):
            name, _, value = line.partition(": ")
            event[name] = json.loads(value) if name in ("data", "id") else value
    return events


def test_a_job_goes_its_way_and_its_result_is_that_of_denoise(http: httpx2.Client) -> None:
    answer = http.post("/jobs?iterations=1&filename=scan.npy", content=SMALL)
    assert answer.status_code == 202
    job = answer.json()
    assert answer.headers["location"] == job["links"]["self"] == f"/jobs/{job['id']}"
    job = finished(http, job["id"])
    assert (job["state"], job["progress"], job["points"], job["attempts"]) == ("succeeded", 1.0, 300, 1)
    result = http.get(job["links"]["result"])
    assert result.content == http.post("/denoise?iterations=1", content=SMALL).content
    assert hashlib.sha256(result.content).hexdigest() == job["result"]["sha256"]
    assert 'filename="scan_clean.npy"' in result.headers["content-disposition"]
    report = http.get(job["links"]["report"]).json()
    moved = np.linalg.norm(np.load(io.BytesIO(result.content)) - np.load(io.BytesIO(SMALL)), axis=1)
    assert np.isclose(report["displacement"]["p50"], np.median(moved))
    assert report == job["report"]


def test_events_replay_behind_the_last_one_seen(http: httpx2.Client) -> None:
    id = make(http)["id"]
    with http.stream("GET", f"/jobs/{id}/events") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        assert answer.headers["x-accel-buffering"] == "no"
        events = sse(answer.iter_lines())
    assert [event["id"] for event in events] == list(range(1, len(events) + 1))
    kinds = [event["event"] for event in events]
    assert (kinds[0], kinds[-1]) == ("queued", "completed")
    assert {"start", "progress", "preview", "output"} <= set(kinds)
    assert events[-1]["data"]["state"] == "succeeded"
    again = http.get(f"/jobs/{id}/events", headers={"Last-Event-ID": str(len(events) - 2)})
    assert sse(iter([*again.text.splitlines(), ""])) == events[-2:]
    assert http.get(f"/jobs/{id}/events", headers={"Last-Event-ID": "x"}).status_code == 400
    nothing = http.get(f"/jobs/{id}/events", headers={"Last-Event-ID": str(len(events))})
    assert (nothing.status_code, nothing.content) == (204, b"")  # an EventSource takes anything else for a break


def test_patches_add_up_to_the_result_in_both_forms(http: httpx2.Client) -> None:
    job = make(http, npy(noisy(torus(2500), 0.01)))
    reader, xyz, ended = PatchReader(), np.full((2500, 3), np.nan), False
    with http.stream("GET", job["links"]["stream"]) as answer:  # while it runs
        for chunk in answer.iter_bytes():
            for frame in reader.feed(chunk):
                xyz[frame.indices] = frame.xyz
                ended = frame.end
    assert ended
    result = np.load(io.BytesIO(http.get(job["links"]["result"]).content))
    assert np.array_equal(xyz, result)
    lines = http.get(job["links"]["stream"], headers={"Accept": "application/x-ndjson"}).text.splitlines()
    for rather in ("application/vnd.straightpcf.patches", "*/*"):
        either = {"Accept": f"application/x-ndjson;q=0.5, {rather}"}
        assert http.get(job["links"]["stream"], headers=either).headers["content-type"] == PATCHES_MEDIA_TYPE
    said = [json.loads(line) for line in lines]
    assert said[0] == {"points": 2500}
    assert said[-1] == {"end": True}
    for line in said[1:-1]:
        assert np.array_equal(result[line["indices"]], np.array(line["xyz"]))


def test_a_result_can_be_fetched_in_parts_and_only_if_it_changed(http: httpx2.Client) -> None:
    job = finished(http, make(http)["id"])
    url, size = job["links"]["result"], job["result"]["bytes"]
    whole = http.get(url)
    etag = whole.headers["etag"]
    assert etag == f'"{job["result"]["sha256"]}"'
    head = http.head(url)
    assert (head.status_code, head.content, head.headers["content-length"]) == (200, b"", str(size))
    rest = http.get(url, headers={"Range": "bytes=100-", "If-Range": etag})
    assert (rest.status_code, rest.content) == (206, whole.content[100:])
    assert rest.headers["content-range"] == f"bytes 100-{size - 1}/{size}"
    assert http.get(url, headers={"Range": "bytes=-5"}).content == whole.content[-5:]
    assert http.get(url, headers={"Range": "bytes=100-", "If-Range": '"other"'}).status_code == 200
    assert http.get(url, headers={"If-None-Match": etag}).status_code == 304
    assert http.get(url, headers={"Range": "lines=1-2"}).status_code == 200
    over = http.get(url, headers={"Range": f"bytes={size}-"})
    assert (over.status_code, over.json()["code"]) == (416, "range_not_satisfiable")


def test_put_makes_one_job_however_often_it_comes(http: httpx2.Client) -> None:
    id = "scan-" + hashlib.sha256(str(time.time()).encode()).hexdigest()[:8]
    answers = [http.put(f"/jobs/{id}?iterations=1", content=SMALL) for _ in range(3)]
    assert [answer.status_code for answer in answers] == [202, 200, 200]
    other = http.put(f"/jobs/{id}?iterations=2", content=SMALL)
    assert (other.status_code, other.json()["code"]) == (409, "id_conflict")
    assert http.put("/jobs/.hidden", content=SMALL).status_code == 400


def test_an_idempotency_key_stands_for_one_job_also_when_all_come_at_once(http: httpx2.Client) -> None:
    key = {"Idempotency-Key": f"key-{time.time_ns()}"}
    answers: list[httpx2.Response] = []

    def send() -> None:
        answers.append(http.post("/denoise?iterations=1", content=SMALL, headers=key))

    threads = [threading.Thread(target=send) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {answer.status_code for answer in answers} == {200}
    assert len({answer.headers["x-job-id"] for answer in answers}) == 1
    assert len({answer.content for answer in answers}) == 1
    other = http.post("/denoise?iterations=2", content=SMALL, headers=key)
    assert (other.status_code, other.json()["code"]) == (422, "idempotency_conflict")
    assert http.post("/denoise", content=SMALL, headers={"Idempotency-Key": "k" * 256}).status_code == 400


def test_two_idempotency_keys_are_refused(http: httpx2.Client) -> None:
    """The first one counted: a repeat whose lines come in another order would have made another job."""
    keys = [("Idempotency-Key", key) for key in ("one", "other")]
    answer = http.post("/jobs?iterations=1", content=SMALL, headers=keys)
    assert (answer.status_code, answer.json()["code"]) == (400, "invalid_request")
    assert answer.json()["detail"] == "Idempotency-Key is said 2 times; which one is meant?"


@pytest.mark.parametrize("named", ['"x"', "", '"x", W/"*"', '"*"'])
def test_a_job_is_not_deleted_where_if_match_names_something_else(http: httpx2.Client, named: str) -> None:
    """It was deleted whatever the request said of when it may be (RFC 9110, 13.1.1)."""
    id = http.post("/jobs?iterations=1", content=SMALL).json()["id"]
    answer = http.delete(f"/jobs/{id}", headers={"If-Match": named})
    assert (answer.status_code, answer.json()["code"]) == (412, "precondition_failed")
    assert http.get(f"/jobs/{id}").status_code == 200
    assert http.delete(f"/jobs/{id}", headers={"If-Match": "*"}).status_code == 204


def test_prefer_respond_async_and_wait_give_the_job_instead_of_a_timeout(http: httpx2.Client) -> None:
    for prefer in ("respond-async", "wait=0"):
        answer = http.post("/denoise?iterations=10", content=LARGE, headers={"Prefer": prefer})
        assert answer.status_code == 202
        assert answer.headers["preference-applied"] == prefer
        job = http.get(answer.headers["location"]).json()
        assert job["state"] in ("queued", "starting", "processing")
        early = http.get(job["links"]["result"])
        assert (early.status_code, early.json()["code"]) == (409, "job_not_finished")
        assert http.delete(job["links"]["self"]).status_code == 204
    done = http.post("/denoise?iterations=1", content=SMALL, headers={"Prefer": "wait=60"})
    assert done.status_code == 200


def test_respond_async_with_a_wait_waits_first_and_what_was_heeded_is_said(http: httpx2.Client) -> None:
    began = time.monotonic()
    late = http.post("/denoise?iterations=10", content=LARGE, headers={"Prefer": "respond-async, wait=1"})
    assert (late.status_code, late.headers["preference-applied"]) == (202, "respond-async, wait=1")
    assert time.monotonic() - began >= 1
    assert http.delete(late.headers["location"]).status_code == 204
    for query in ("", "&report=true"):
        for prefer in ("wait=60", "respond-async, wait=60"):
            done = http.post(f"/denoise?iterations=1{query}", content=SMALL, headers={"Prefer": prefer})
            assert (done.status_code, done.headers["preference-applied"]) == (200, "wait=60")


def test_respond_async_with_a_value_is_no_preference_that_is_known(http: httpx2.Client) -> None:
    for prefer in ("respond-async=false", "respond-async=true; x=1", "respond-async=0, respond-async"):
        done = http.post("/denoise?iterations=1", content=SMALL, headers={"Prefer": prefer})
        assert (done.status_code, done.headers.get("preference-applied")) == (200, None), prefer
    wait_for(lambda: http.get("/jobs").json()["jobs"] == [])  # each lived as long as its request
    answer = http.post("/denoise?iterations=10", content=LARGE, headers={"Prefer": 'respond-async=""; x=1'})
    assert (answer.status_code, answer.headers["preference-applied"]) == (202, "respond-async")
    assert http.delete(answer.headers["location"]).status_code == 204


def test_denoise_tells_its_events_and_its_report_on_the_same_response(http: httpx2.Client) -> None:
    with http.stream("POST", "/denoise?iterations=1", content=SMALL, headers={"Accept": "text/event-stream"}) as answer:
        events = sse(answer.iter_lines())
    assert events[-1]["data"]["state"] == "succeeded"
    plain = http.get(events[-1]["data"]["links"]["result"])
    assert "no-cache" in plain.headers["cache-control"]
    both = http.post("/denoise?iterations=1&report=true", content=SMALL)
    assert both.headers["content-type"].startswith("multipart/mixed")
    boundary = both.headers["content-type"].partition("boundary=")[2].encode()
    _, report, cloud, end = both.content.split(b"--" + boundary)
    assert json.loads(report.partition(b"\r\n\r\n")[2])["points"] == 300
    described, _, file = cloud.partition(b"\r\n\r\n")
    assert file[:-2] == plain.content
    assert end == b"--\r\n"
    # What tells the file from others is said of the file, not of an answer that has more in it.
    assert f"Repr-Digest: {plain.headers['repr-digest']}".encode() in described
    assert b'Content-Disposition: attachment; filename="cloud_clean.npy"' in described
    assert not {"repr-digest", "etag"} & set(both.headers)


def test_cancel_frees_the_worker_within_a_second(http: httpx2.Client) -> None:
    id = make(http, LARGE, iterations=10)["id"]
    while http.get(f"/jobs/{id}").json()["state"] != "processing":
        time.sleep(0.02)
    began = time.monotonic()
    answer = http.post(f"/jobs/{id}/cancel")
    assert (answer.status_code, answer.json()["state"]) == (202, "canceled")
    assert time.monotonic() - began < 3  # a second, and what a busy machine takes
    assert http.post(f"/jobs/{id}/cancel").status_code == 200
    gone = http.get(f"/jobs/{id}/result")
    assert (gone.status_code, gone.json()["code"]) == (409, "job_canceled")
    assert finished(http, make(http)["id"])["state"] == "succeeded"


def test_a_failed_job_says_why_at_every_door(http: httpx2.Client) -> None:
    job = finished(http, make(http, b"ply\nformat nonsense\n")["id"])
    assert (job["state"], job["error"]["code"]) == ("failed", "malformed_file")
    for part in ("result", "report", "stream"):
        answer = http.get(job["links"][part])
        assert (answer.status_code, answer.json()["code"]) == (422, "malformed_file"), part


def test_pages_and_filters(http: httpx2.Client) -> None:
    made = [make(http)["id"] for _ in range(3)]
    for id in made:
        finished(http, id)
    first = http.get("/jobs?limit=2").json()
    assert [job["id"] for job in first["jobs"]] == made[:0:-1]
    assert http.get("/jobs/?limit=2").json() == first  # as `POST /jobs/` does what `POST /jobs` does
    second = http.get(f"/jobs?limit=2&cursor={first['next_cursor']}").json()
    assert second["jobs"][0]["id"] == made[0]
    assert http.get("/jobs?state=queued&state=processing").json()["jobs"] == []
    for query in ("limit=0", "limit=x", "state=nonsense", "cursor=nonsense"):
        answer = http.get(f"/jobs?{query}")
        assert answer.status_code in (400, 422), query
        assert answer.headers["content-type"] == "application/problem+json"


def test_what_is_not_there_is_a_problem(http: httpx2.Client) -> None:
    for method, path, status, code in (
        ("GET", "/jobs/nope", 404, "not_found"),
        ("GET", "/jobs/nope/events", 404, "not_found"),
        ("GET", "/jobs/nope/stream", 404, "not_found"),
        ("DELETE", "/jobs/nope", 404, "not_found"),
        ("GET", "/nope", 404, "not_found"),
        ("DELETE", "/denoise", 405, "method_not_allowed"),
    ):
        answer = http.request(method, path)
        assert (answer.status_code, answer.json()["code"]) == (status, code), path


def test_metrics_count_jobs_and_requests_by_route(http: httpx2.Client) -> None:
    http.get(f"/jobs/{make(http)['id']}")
    text = http.get("/metrics").text
    assert 'route="/jobs/{id}"' in text
    assert "straightpcf_ready 1.0" in text
    assert "straightpcf_jobs{" in text


def test_metrics_tell_what_is_there_now(server: RunningServer, http: httpx2.Client) -> None:
    def metric(name: str) -> float:
        (line,) = [line for line in http.get("/metrics").text.splitlines() if line.startswith(f"{name} ")]
        return float(line.rpartition(" ")[2])

    succeeded, spool = 'straightpcf_jobs{state="succeeded"}', "straightpcf_spool_bytes"
    server.delete_jobs()
    assert (metric(succeeded), metric(spool)) == (0, 0)
    job = finished(http, make(http)["id"])
    assert metric(succeeded) == 1
    assert metric(spool) == sum(path.stat().st_size for path in server.spooled_files())
    assert metric(spool) > len(SMALL) + job["result"]["bytes"]  # and its patches


def test_a_key_sees_its_own_jobs_alone(tmp_path: Path) -> None:
    (tmp_path / "keys").write_text("# the team\nalpha\nbeta\n")
    with run_server(tmp_path, environment={"STRAIGHTPCF_API_KEYS_FILE": str(tmp_path / "keys")}) as server:
        server.wait_until_ready()
        alpha, beta = ({"Authorization": f"Bearer {key}"} for key in ("alpha", "beta"))
        with httpx2.Client(base_url=server.url, timeout=60) as http:
            for headers in ({}, {"Authorization": "Bearer nope"}, {"Authorization": "Basic alpha"}):
                answer = http.post("/jobs", content=SMALL, headers=headers)
                assert (answer.status_code, answer.json()["code"]) == (401, "unauthorized")
                assert answer.headers["www-authenticate"] == "Bearer"
            id = make(http, **alpha)["id"]
            assert http.get(f"/jobs/{id}", headers=alpha).status_code == 200
            for path in ("", "/events", "/result", "/stream", "/report"):
                assert http.get(f"/jobs/{id}{path}", headers=beta).status_code == 404
            assert http.delete(f"/jobs/{id}", headers=beta).status_code == 404
            assert http.get("/jobs", headers=beta).json()["jobs"] == []
            assert {http.get(path).status_code for path in ("/livez", "/healthz", "/readyz")} == {200}
            assert {http.get(path).status_code for path in ("/", "/openapi.json", "/docs")} == {200}
            assert {http.get(path).status_code for path in ("/v1/info", "/metrics", "/jobs")} == {401}
        assert "alpha" not in server.log.read_text()


def test_a_key_that_asks_too_often_is_held_back_and_let_in_again(tmp_path: Path) -> None:
    # 120 a minute: the bucket holds 120 and gains one each half second, however often it is asked meanwhile.
    settings = {"STRAIGHTPCF_RATE_PER_MINUTE": "120"}
    with run_server(tmp_path, environment=settings) as server, httpx2.Client(base_url=server.url, timeout=60) as http:
        answers = [http.get("/jobs")]
        while answers[-1].status_code == 200 and len(answers) < 2000:
            answers.append(http.get("/jobs"))
        assert len(answers) > 120
        problem = answers[-1].json()
        assert (problem["status"], problem["code"], problem["retryable"]) == (429, "rate_limited", True)
        assert answers[-1].headers["retry-after"] == "1"
        assert http.get("/livez").status_code == 200
        until = time.monotonic() + 10
        while http.get("/jobs").status_code == 429:
            assert time.monotonic() < until, "a client that keeps asking never gets in"


def test_pages_of_other_origins_may_call_only_where_the_operator_says_so(server: RunningServer, tmp_path: Path) -> None:
    friend, stranger = "https://viewer.example", "https://other.example"

    def allowed(url: str, origin: str) -> str | None:
        asks = {"Origin": origin, "Access-Control-Request-Method": "POST"}
        preflight = httpx2.options(f"{url}/denoise", headers=asks).headers.get("access-control-allow-origin")
        plain = httpx2.get(f"{url}/v1/info", headers={"Origin": origin}).headers.get("access-control-allow-origin")
        assert preflight == plain
        return preflight

    assert allowed(server.url, friend) is None
    with run_server(tmp_path, environment={"STRAIGHTPCF_CORS_ORIGINS": f"{friend}, https://third.example"}) as other:
        assert allowed(other.url, friend) == friend
        assert allowed(other.url, stranger) is None
        asks = ["-X", "OPTIONS", "-H", "Access-Control-Request-Method: POST", f"{other.url}/denoise"]
        refused = curl("-H", f"Origin: {stranger}", *asks)
        assert (refused.status, refused.problem()["code"]) == (403, "cross_origin")
        assert stranger in refused.problem()["detail"]
        from_outside = ["-H", f"Origin: {friend}", "-H", "Access-Control-Request-Private-Network: true"]
        assert curl(*from_outside, *asks).headers["access-control-allow-private-network"] == "true"


def test_events_pass_proxies_at_once_and_the_trace_reaches_the_log(server: RunningServer, http: httpx2.Client) -> None:
    trace = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"
    id = make(http, traceparent=trace)["id"]
    with http.stream("GET", f"/jobs/{id}/events") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        assert (answer.headers["x-accel-buffering"], answer.headers["cache-control"]) == ("no", "no-store")
        assert sse(answer.iter_lines())[-1]["event"] == "completed"
    assert trace in server.log.read_text()


def test_curl_follows_a_job_as_the_readme_says(server: RunningServer, tmp_path: Path) -> None:
    (tmp_path / "scan.npy").write_bytes(SMALL)
    curl = ["curl", "-sf", "--max-time", "60"]
    made = subprocess.run(
        [*curl, "-F", f"file=@{tmp_path}/scan.npy", "-F", "iterations=1", f"{server.url}/jobs"],
        check=True, capture_output=True,
    )  # fmt: skip
    job = json.loads(made.stdout)
    events = subprocess.run([*curl, "-N", server.url + job["links"]["events"]], check=True, capture_output=True).stdout
    assert b"event: completed" in events
    subprocess.run([*curl, "-o", tmp_path / "out.npy", server.url + job["links"]["result"]], check=True)
    assert np.load(tmp_path / "out.npy").shape == (300, 3)
