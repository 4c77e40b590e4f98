"""The gRPC service, over a socket, by the official client."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

grpc = pytest.importorskip("grpc")

from google.protobuf.descriptor_pb2 import FileDescriptorProto  # noqa: E402
from google.rpc import error_details_pb2  # noqa: E402
from grpc_health.v1 import health_pb2, health_pb2_grpc  # noqa: E402
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc  # noqa: E402
from grpc_status import rpc_status  # noqa: E402

from straightpcf.points.errors import ERRORS_BY_CODE  # noqa: E402
from straightpcf.points.wire import straightpcf_pb2 as pb  # noqa: E402
from straightpcf.points.wire.messages import event_message, event_of, message_of, plain_of  # noqa: E402
from straightpcf.points.wire.straightpcf_pb2_grpc import DenoiseServiceStub  # noqa: E402
from straightpcf.service.api.errors import GRPC_STATUS_BY_CODE  # noqa: E402
from tests.clouds import noisy, sphere, torus  # noqa: E402
from tests.conftest import RunningServer, run_server  # noqa: E402
from tests.waiting import wait_for  # noqa: E402

POINTS = 400


def npy(xyz: Any) -> bytes:
    np.save(buffer := io.BytesIO(), xyz)
    return buffer.getvalue()


SMALL = npy(noisy(torus(POINTS), 0.01))
LARGE = npy(noisy(sphere(60_000), 0.01))  # each pass takes the worker seconds
LONG = npy(noisy(sphere(12_000), 0.01))  # all ten passes do, but the first patch comes soon


@pytest.fixture
def channel(server: RunningServer) -> Iterator[Any]:
    with grpc.insecure_channel(server.grpc_url.removeprefix("grpc://")) as channel:
        yield channel


@pytest.fixture
def stub(channel: Any) -> Any:
    return DenoiseServiceStub(channel)


def parts(kind: type, config: Any, body: bytes, size: int = 5000) -> Iterator[Any]:
    yield kind(config=config)
    for start in range(0, len(body), size):
        yield kind(chunk=body[start : start + size])


def denoise_parts(body: bytes, *, iterations: int = 1, **config: Any) -> Iterator[Any]:
    job = pb.JobConfig(filename="cloud.npy", options=pb.DenoiseOptions(iterations=iterations))
    return parts(pb.DenoiseRequest, pb.DenoiseConfig(job=job, **config), body)


def error_of(call: Callable[[], Any]) -> tuple[str, Any]:
    """Return the status and the ErrorInfo that a call ends with."""
    with pytest.raises(grpc.RpcError) as caught:
        call()
    info = error_details_pb2.ErrorInfo()
    for detail in rpc_status.from_call(caught.value).details:
        detail.Unpack(info)
    return caught.value.code().name, info


def test_denoise_streams_patches_the_file_and_a_summary(server: RunningServer, stub: Any) -> None:
    answers = list(stub.Denoise(denoise_parts(SMALL, patches=True, return_file=True)))
    kinds = [answer.WhichOneof("part") for answer in answers]
    assert kinds[0] == "accepted"
    assert kinds[-1] == "summary"
    file = b"".join(answer.chunk for answer in answers if answer.WhichOneof("part") == "chunk")
    xyz = np.load(io.BytesIO(file))
    seen = np.full((POINTS, 3), np.nan)
    for answer in answers:
        if answer.WhichOneof("part") == "patch":
            assert answer.patch.points == POINTS
            seen[list(answer.patch.indices)] = np.reshape(answer.patch.xyz, (-1, 3))
    np.testing.assert_allclose(seen, xyz)
    summary = answers[-1].summary
    assert (summary.state, summary.report.points, summary.result.bytes) == (pb.JOB_STATE_SUCCEEDED, POINTS, len(file))
    rest = httpx2.post(f"{server.url}/denoise?iterations=1&filename=cloud.npy", content=SMALL, timeout=60)
    assert rest.content == file
    wait_for(lambda: not server.spooled_files())


def test_an_empty_file_is_refused_at_once(server: RunningServer, stub: Any) -> None:
    config = pb.JobConfig(filename="a.ply", id="empty")
    for call in (
        lambda: stub.CreateJob(parts(pb.CreateJobRequest, config, b"")),
        lambda: list(stub.Denoise(parts(pb.DenoiseRequest, pb.DenoiseConfig(job=config), b""))),
    ):
        status, info = error_of(call)
        assert (status, info.reason) == ("INVALID_ARGUMENT", "MALFORMED_FILE")
    assert httpx2.get(f"{server.url}/jobs").json()["jobs"] == []


def test_denoise_without_patches_tells_progress(stub: Any) -> None:
    answers = list(stub.Denoise(denoise_parts(SMALL)))
    told = [answer.progress.progress for answer in answers if answer.WhichOneof("part") == "progress"]
    assert told
    assert told == sorted(told)
    assert not any(answer.chunk for answer in answers)


def test_a_job_made_by_one_transport_is_seen_by_the_other(server: RunningServer, stub: Any) -> None:
    config = pb.JobConfig(id="both", filename="cloud.npy", options=pb.DenoiseOptions(iterations=1))
    made = stub.CreateJob(parts(pb.CreateJobRequest, config, SMALL))
    assert made.state in (pb.JOB_STATE_QUEUED, pb.JOB_STATE_STARTING, pb.JOB_STATE_PROCESSING)
    done = stub.GetJob(pb.GetJobRequest(id="both", wait_seconds=60))
    with httpx2.Client(base_url=server.url) as rest:
        shown = rest.get("/jobs/both").json()
        shown.pop("links")
        assert plain_of(done) == shown
        again = rest.put("/jobs/both?iterations=1&filename=cloud.npy", content=SMALL)
        assert (again.status_code, again.json()["created_at"]) == (200, shown["created_at"])
        whole = rest.get("/jobs/both/result").content
        events = list(stub.WatchJob(pb.WatchJobRequest(id="both")))
        lines = rest.get("/jobs/both/events").text.split("\n\n")
        assert [event_of(event)[0] for event in events] == [
            line.split("event: ")[1].split("\n")[0] for line in lines if "event: " in line
        ]
    answers = list(stub.DownloadResult(pb.DownloadResultRequest(id="both", offset=100)))
    assert answers[0].result.sha256 == shown["result"]["sha256"]
    assert b"".join(answer.chunk for answer in answers[1:]) == whole[100:]
    listed = stub.ListJobs(pb.ListJobsRequest(states=[pb.JOB_STATE_SUCCEEDED], limit=1))
    assert [job.id for job in listed.jobs] == ["both"]
    stub.DeleteJob(pb.DeleteJobRequest(id="both"))
    assert httpx2.get(f"{server.url}/jobs/both").status_code == 404


def test_an_error_says_its_code_and_the_request(stub: Any) -> None:
    metadata = (("x-request-id", "mine-7"),)
    status, info = error_of(lambda: stub.GetJob(pb.GetJobRequest(id="nowhere"), metadata=metadata))
    assert (status, info.reason, info.domain) == ("NOT_FOUND", "NOT_FOUND", "straightpcf")
    assert dict(info.metadata) == {"retryable": "false", "request_id": "mine-7"}
    broken = npy(torus(POINTS))[:2000]
    status, info = error_of(lambda: list(stub.Denoise(denoise_parts(broken))))
    assert (status, info.reason) == ("INVALID_ARGUMENT", "MALFORMED_FILE")
    config = pb.JobConfig(options=pb.DenoiseOptions(iterations=99))
    status, info = error_of(lambda: stub.CreateJob(parts(pb.CreateJobRequest, config, SMALL)))
    assert (status, info.reason) == ("INVALID_ARGUMENT", "INVALID_OPTIONS")


@pytest.mark.parametrize(
    "name", ["no config", "nothing", "config twice", "bad state", "bad offset", "bad wait", "bad after"]
)
def test_a_call_against_the_contract_is_refused(stub: Any, name: str) -> None:
    chunk, config = pb.CreateJobRequest(chunk=SMALL), pb.CreateJobRequest(config=pb.JobConfig())
    calls: dict[str, Callable[[], Any]] = {
        "no config": lambda: stub.CreateJob(iter([chunk])),
        "nothing": lambda: stub.CreateJob(iter([])),
        "config twice": lambda: stub.CreateJob(iter([config, config])),
        "bad state": lambda: stub.ListJobs(pb.ListJobsRequest(states=[77])),  # type: ignore[list-item]
        "bad offset": lambda: list(stub.DownloadResult(pb.DownloadResultRequest(id=done(stub), offset=10**9))),
        "bad after": lambda: list(stub.WatchJob(pb.WatchJobRequest(id="x", after=2**63))),
        "bad wait": lambda: stub.GetJob(pb.GetJobRequest(id="x", wait_seconds=float("nan"))),
    }
    status, info = error_of(calls[name])
    assert (status, info.reason) in {
        ("INVALID_ARGUMENT", "INVALID_REQUEST"),
        ("OUT_OF_RANGE", "RANGE_NOT_SATISFIABLE"),
    }


@pytest.mark.parametrize("said", [len(SMALL) - 1, len(SMALL) + 1, 0])
def test_a_file_of_another_size_than_was_said_makes_no_job(stub: Any, said: int) -> None:
    before = list(stub.ListJobs(pb.ListJobsRequest()).jobs)
    config = pb.JobConfig(filename="cloud.npy", bytes=said)
    status, info = error_of(lambda: stub.CreateJob(parts(pb.CreateJobRequest, config, SMALL)))
    assert (status, info.reason) == ("INVALID_ARGUMENT", "INVALID_REQUEST")
    assert list(stub.ListJobs(pb.ListJobsRequest()).jobs) == before


def test_a_file_that_is_said_to_be_too_large_is_refused_before_it_comes(stub: Any) -> None:
    config = pb.CreateJobRequest(config=pb.JobConfig(filename="cloud.npy", bytes=2**62))
    status, info = error_of(lambda: stub.CreateJob(iter([config])))
    assert (status, info.reason) == ("INVALID_ARGUMENT", "TOO_MANY_BYTES")


def test_two_idempotency_keys_are_refused(stub: Any) -> None:
    config = parts(pb.CreateJobRequest, pb.JobConfig(filename="cloud.npy"), SMALL)
    keys = [("idempotency-key", key) for key in ("one", "other")]
    status, info = error_of(lambda: stub.CreateJob(config, metadata=keys))
    assert (status, info.reason) == ("INVALID_ARGUMENT", "INVALID_REQUEST")


@pytest.mark.parametrize("size", [2**20 + 5000, 2**22])
def test_a_message_that_is_too_large_is_refused_with_its_code(channel: Any, stub: Any, size: int) -> None:
    """As of a client that sends its file in one: gRPC's own answer has no code, and is for what is larger still."""
    config = pb.JobConfig(filename="cloud.xyz")
    status, info = error_of(lambda: stub.CreateJob(parts(pb.CreateJobRequest, config, bytes(size), size)))
    assert (status, info.reason) == ("INVALID_ARGUMENT", "TOO_MANY_BYTES")
    assert info.metadata["request_id"]
    with pytest.raises(grpc.RpcError, match=rf"has \d+ bytes; the limit is {2**20 + 4096}: send a file"):
        stub.GetJob(pb.GetJobRequest(id="x" * size))


def test_a_message_of_a_mebibyte_is_taken(stub: Any) -> None:
    body = b"0 0 0\n" * (2**20 // 6)
    config = pb.JobConfig(filename="cloud.xyz", options=pb.DenoiseOptions(iterations=1), bytes=len(body))
    job = stub.CreateJob(parts(pb.CreateJobRequest, config, body, len(body)))
    stub.DeleteJob(pb.DeleteJobRequest(id=job.id))


def test_a_stream_of_another_schema_is_the_callers_fault(server: RunningServer, channel: Any) -> None:
    call = channel.stream_unary("/straightpcf.v1.DenoiseService/CreateJob")
    status, info = error_of(lambda: call(iter([b"\xff\xff"])))
    assert (status, info.reason) == ("INVALID_ARGUMENT", "INVALID_REQUEST")
    assert f"request {info.metadata['request_id']}" not in server.log.read_text()


@pytest.mark.parametrize(
    "method", ["GetJob", "ListJobs", "CancelJob", "DeleteJob", "WatchJob", "StreamPatches", "GetServerInfo"]
)
def test_a_request_of_another_schema_is_too(channel: Any, method: str) -> None:
    kind = channel.unary_stream if method in ("WatchJob", "StreamPatches") else channel.unary_unary
    call = kind(f"/straightpcf.v1.DenoiseService/{method}")
    latin_1 = b"\x0a\x04caf\xe9\x1a\x04caf\xe9"  # an id, a cursor: clients in C++ send any bytes as a string
    sent = b"\xff\xff" if method == "GetServerInfo" else latin_1  # Empty, which has room for any field
    status, info = error_of(lambda: list(answer) if hasattr(answer := call(sent), "__next__") else answer)
    assert (status, info.reason) == ("INVALID_ARGUMENT", "INVALID_REQUEST")
    assert info.metadata["request_id"]


def test_states_may_be_asked_for_any_number_of_times(stub: Any) -> None:
    id = done(stub)
    asked = [pb.JOB_STATE_SUCCEEDED] * 300_000  # SQLite takes a tenth of that as values
    assert id in {job.id for job in stub.ListJobs(pb.ListJobsRequest(states=asked, limit=200)).jobs}


def done(stub: Any) -> str:
    config = pb.JobConfig(filename="cloud.npy", options=pb.DenoiseOptions(iterations=1))
    job = stub.CreateJob(parts(pb.CreateJobRequest, config, SMALL))
    return str(stub.GetJob(pb.GetJobRequest(id=job.id, wait_seconds=60)).id)


def test_callers_who_choose_the_same_id_get_the_same_result(server: RunningServer, stub: Any) -> None:
    job = pb.JobConfig(id="ours", filename="cloud.npy", options=pb.DenoiseOptions(iterations=1))

    def summary(_: int) -> Any:
        config = pb.DenoiseConfig(job=job, return_file=True)
        return list(stub.Denoise(parts(pb.DenoiseRequest, config, SMALL)))[-1].summary

    with ThreadPoolExecutor(3) as callers:
        summaries = [*callers.map(summary, range(3)), summary(3)]  # the last comes when the others have gone
    assert (summaries[0].state, summaries[0].attempts) == (pb.JOB_STATE_SUCCEEDED, 1)
    assert summaries == [summaries[0]] * 4
    stub.DeleteJob(pb.DeleteJobRequest(id="ours"))


@pytest.mark.parametrize("ending", ["cancel", "deadline"])
def test_a_call_that_ends_early_frees_the_worker_and_leaves_nothing(
    server: RunningServer, stub: Any, ending: str
) -> None:
    cloud = LARGE if ending == "deadline" else LONG
    upload = denoise_parts(cloud, iterations=10, patches=True)
    call = stub.Denoise(upload, timeout=3 if ending == "deadline" else None)
    with suppress(grpc.RpcError):
        for answer in call:
            if ending == "cancel" and answer.WhichOneof("part") == "patch":
                call.cancel()
    assert call.code().name == {"cancel": "CANCELLED", "deadline": "DEADLINE_EXCEEDED"}[ending]
    wait_for(lambda: not httpx2.get(f"{server.url}/jobs").json()["jobs"] and not server.spooled_files())


def test_health_and_reflection_answer(channel: Any) -> None:
    check = health_pb2_grpc.HealthStub(channel).Check
    for service in ("", "straightpcf.v1.DenoiseService"):
        request = health_pb2.HealthCheckRequest(service=service)
        wait_for(lambda: check(request).status == health_pb2.HealthCheckResponse.SERVING)  # noqa: B023
    ask = reflection_pb2.ServerReflectionRequest
    questions = iter([ask(list_services=""), ask(file_containing_symbol="straightpcf.v1.DenoiseService")])
    names, file = reflection_pb2_grpc.ServerReflectionStub(channel).ServerReflectionInfo(questions)
    assert "straightpcf.v1.DenoiseService" in {item.name for item in names.list_services_response.service}
    described = FileDescriptorProto.FromString(file.file_descriptor_response.file_descriptor_proto[0])
    assert "Denoise" in {method.name for method in described.service[0].method}


def test_keys_hold_for_grpc_too(tmp_path: Path) -> None:
    keys = {"STRAIGHTPCF_API_KEYS": "alpha,beta"}
    with (
        run_server(tmp_path, "--grpc-port", "0", environment=keys) as server,
        grpc.insecure_channel(server.grpc_url.removeprefix("grpc://")) as channel,
    ):
        stub = DenoiseServiceStub(channel)
        status, info = error_of(lambda: stub.ListJobs(pb.ListJobsRequest()))
        assert (status, info.reason) == ("UNAUTHENTICATED", "UNAUTHORIZED")
        alpha, beta = ((("authorization", f"Bearer {key}"),) for key in ("alpha", "beta"))
        job = stub.CreateJob(parts(pb.CreateJobRequest, pb.JobConfig(), SMALL), metadata=alpha)
        status, info = error_of(lambda: stub.GetJob(pb.GetJobRequest(id=job.id), metadata=beta))
        assert (status, info.reason) == ("NOT_FOUND", "NOT_FOUND")
        stub.DeleteJob(pb.DeleteJobRequest(id=job.id), metadata=alpha)


def test_every_code_has_a_status() -> None:
    assert set(GRPC_STATUS_BY_CODE) == set(ERRORS_BY_CODE)
    assert all(hasattr(grpc.StatusCode, name) for name in GRPC_STATUS_BY_CODE.values())


def test_messages_keep_what_json_says() -> None:
    preview = {"iteration": 2, "indices": [3, 4], "xyz": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]}
    message = event_message("preview", 5, "2026-11-21T12:00:00.123Z", preview)
    assert event_of(message) == ("preview", 5, preview)
    assert plain_of(message)["at"] == "2026-11-21T12:00:00.123Z"
    for options in (
        {"iterations": "auto", "seed": 0, "strength": 1.0, "normals": "keep"},
        {"iterations": 3, "seed": 9, "strength": 0.0, "normals": "recompute"},
    ):
        job = plain_of(message_of(pb.Job, {"options": options, "state": "canceled", "name": None}))
        assert (job["options"], job["state"], job["name"]) == (options, "canceled", None)


def test_the_committed_stubs_are_what_the_schema_gives(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    source = Path(__file__).parents[2] / "src"
    outs = [f"--{kind}_out={tmp_path}" for kind in ("python", "pyi", "grpc_python")]
    schema = "straightpcf/points/wire/straightpcf.proto"
    subprocess.run([sys.executable, "-m", "grpc_tools.protoc", "-I", str(source), *outs, schema], check=True)
    for made in (tmp_path / "straightpcf/points/wire").iterdir():
        same = [line for line in made.read_text().splitlines() if "VERSION" not in line]
        kept = [line for line in (source / "straightpcf/points/wire" / made.name).read_text().splitlines()]
        if made.suffix == ".py" and "grpc" in made.name:  # its version line follows grpcio-tools
            kept = [line for line in kept if "VERSION" not in line]
            assert same == kept
        elif made.suffix == ".pyi":
            assert made.read_text().splitlines() == kept


def test_a_call_that_never_says_its_config_is_told_before_the_server_ends(tmp_path: Path) -> None:
    with (
        run_server(tmp_path, "--grpc-port", "0", environment={"STRAIGHTPCF_SHUTDOWN_SECONDS": "2"}) as server,
        grpc.insecure_channel(server.grpc_url.removeprefix("grpc://")) as channel,
    ):
        over = threading.Event()

        def nothing() -> Iterator[Any]:
            over.wait()
            yield from ()

        call = DenoiseServiceStub(channel).CreateJob.future(nothing())
        time.sleep(0.5)  # for the call to come in: it leaves no trace
        server.process.send_signal(signal.SIGTERM)
        status, info = error_of(call.result)
        assert (status, info.reason) == ("UNAVAILABLE", "SERVER_BUSY")
        over.set()
        server.process.wait(timeout=20)


def test_sigterm_lets_a_call_finish(tmp_path: Path) -> None:
    with (
        run_server(tmp_path, "--grpc-port", "0") as server,
        grpc.insecure_channel(server.grpc_url.removeprefix("grpc://")) as channel,
    ):
        server.wait_until_ready()
        answers = DenoiseServiceStub(channel).Denoise(denoise_parts(npy(noisy(torus(1500), 0.01)), return_file=True))
        assert next(answers).WhichOneof("part") == "accepted"
        server.process.send_signal(signal.SIGTERM)
        assert list(answers)[-1].summary.state == pb.JOB_STATE_SUCCEEDED
        server.process.wait(timeout=20)
