"""Measure the service around the filter: what HTTP costs, what waits, what stays in memory, how soon a job goes on.

python -m benchmarks.service [--points 50000] [--jobs 500] [--only overhead livez held kill memory]
"""

from __future__ import annotations

import argparse
import asyncio
import io
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import numpy as np
import numpy.typing as npt

from benchmarks.command import positive
from straightpcf.clients.sdk import Client

PARTS = ("overhead", "livez", "held", "kill", "memory")
OVERHEAD_TARGET, LIVEZ_TARGET_SECONDS, MEMORY_TARGET = 0.05, 0.050, 0.10


class Server:
    """A `straightpcf serve` process."""

    def __init__(self, data_dir: Path) -> None:
        self.data_dir = data_dir
        self.log = data_dir.parent / "server.log"
        command = [sys.executable, "-m", "straightpcf.clients.cli", "serve", "--port", "0", "--device", "cpu"]
        with self.log.open("wb") as sink:
            self.process = subprocess.Popen([*command, "--data-dir", str(data_dir)], stdout=sink, stderr=sink)
        while (found := re.search(r"running on (http://\S+)", self.log.read_text())) is None:
            assert self.process.poll() is None, self.log.read_text()
            time.sleep(0.01)
        self.url = found[1]

    def wait_until_ready(self) -> None:
        """Return when its worker is warm."""
        with httpx2.Client() as client:
            while client.get(f"{self.url}/readyz").status_code != 200:
                time.sleep(0.02)

    def children(self) -> list[int]:
        """Return its worker, and python's resource tracker."""
        path = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return [int(pid) for pid in path.read_text().split()]

    def worker(self) -> int:
        """Return its worker."""
        return next(pid for pid in self.children() if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes())


@contextmanager
def running() -> Iterator[Server]:
    """Lend a server that is warm, with an empty data directory."""
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder) / "data")
        try:
            server.wait_until_ready()
            yield server
        finally:
            server.process.send_signal(signal.SIGTERM)
            server.process.wait()


def noisy_sphere(points: int) -> npt.NDArray[np.float64]:
    """Return (points, 3) float64 on a unit sphere, with noise_std 0.02."""
    random = np.random.default_rng(0)
    xyz = random.standard_normal((points, 3))
    xyz /= np.linalg.norm(xyz, axis=1, keepdims=True)
    return xyz + 0.02 * random.standard_normal((points, 3))


def overhead(points: int, repeats: int) -> None:
    """Compare POST /denoise with the call in this process, one after the other, both warm."""
    from straightpcf.model.filter import load_filter
    from straightpcf.points.options import DenoiseOptions

    xyz, one = noisy_sphere(points), DenoiseOptions(iterations=1)
    np.save(buffer := io.BytesIO(), xyz)
    here = load_filter(device="cpu")
    here.denoise(noisy_sphere(2000), one)
    inside, outside = [], []
    with running() as server, httpx2.Client(timeout=None) as client:
        for _ in range(repeats):
            began = time.perf_counter()
            here.denoise(xyz, one)
            inside.append(time.perf_counter() - began)
            began = time.perf_counter()
            answer = client.post(f"{server.url}/denoise?iterations=1", content=buffer.getvalue())
            outside.append(time.perf_counter() - began)
            assert answer.status_code == 200, answer.text
    a, b = statistics.median(inside), statistics.median(outside)
    print(
        f"overhead: {points} points, 1 pass: in process {a:.3f} s, POST /denoise {b:.3f} s: {b / a - 1:+.1%}", end=" "
    )
    print(f"(target: below {OVERHEAD_TARGET:.0%}; medians of {repeats})")


def livez(points: int) -> None:
    """Time /livez while the worker has every core."""
    np.save(buffer := io.BytesIO(), noisy_sphere(points))
    with running() as server, Client(server.url) as sdk, httpx2.Client(base_url=server.url) as client:
        job = sdk.jobs.create(buffer.getvalue(), iterations=3)
        while job.refresh().state != "processing":
            time.sleep(0.05)
        seconds: list[float] = []
        while len(seconds) < 2000 and not (len(seconds) % 100 == 0 and job.refresh().finished):
            began = time.perf_counter()
            client.get("/livez").raise_for_status()
            seconds.append(time.perf_counter() - began)
            time.sleep(0.005)
        job.cancel()
    p50, p99, most = (1000 * float(np.quantile(seconds, q)) for q in (0.5, 0.99, 1.0))
    print(
        f"livez: {len(seconds)} requests beside a job: median {p50:.1f} ms, p99 {p99:.1f} ms, most {most:.1f} ms",
        end=" ",
    )
    print(f"(target: p99 below {1000 * LIVEZ_TARGET_SECONDS:.0f} ms)")


def held(requests: int) -> None:
    """Hold many POST /denoise at once, and see that each is answered."""
    np.save(buffer := io.BytesIO(), noisy_sphere(400))

    async def ask_all(url: str) -> list[int]:
        limits = httpx2.Limits(max_connections=None)
        async with httpx2.AsyncClient(base_url=url, timeout=None, limits=limits) as client:

            async def ask() -> int:
                return (await client.post("/denoise?iterations=1", content=buffer.getvalue())).status_code

            return list(await asyncio.gather(*(ask() for _ in range(requests))))

    with running() as server:
        began = time.perf_counter()
        codes = asyncio.run(ask_all(server.url))
        seconds = time.perf_counter() - began
    print(f"held: {requests} POST /denoise of 400 points at once: {codes.count(200)} answered 200 in {seconds:.1f} s")


def kill(points: int) -> None:
    """Time from kill -9 to the moment when the job is worked on again: its worker, then the server."""
    np.save(buffer := io.BytesIO(), noisy_sphere(points))
    with running() as server, Client(server.url) as sdk:
        job = sdk.jobs.create(buffer.getvalue(), iterations=10)
        _until_attempt(job, 1)
        began = time.perf_counter()
        os.kill(server.worker(), signal.SIGKILL)
        _until_attempt(job, 2)
        worker = time.perf_counter() - began
        began = time.perf_counter()
        server.process.kill()
        server.process.wait()
        with Client((again := Server(server.data_dir)).url) as other:
            job = other.jobs.get(job.id)
            _until_attempt(job, 3)
            after = time.perf_counter() - began
            job.delete()
        again.process.send_signal(signal.SIGTERM)
        again.process.wait()
    print(
        f"kill -9: of the worker: its job is worked on again after {worker:.1f} s; "
        f"of the server, started anew at once: {after:.1f} s"
    )


def _until_attempt(job, attempt: int) -> None:  # type: ignore[no-untyped-def]
    while (info := job.refresh()).attempts < attempt or info.state != "processing":
        time.sleep(0.02)


def memory(jobs: int, points: int) -> None:
    """Watch the resident memory of server and worker over many jobs."""
    np.save(buffer := io.BytesIO(), noisy_sphere(points))
    levels: dict[int, tuple[float, float]] = {}
    with running() as server, httpx2.Client(timeout=None) as client:
        began = time.perf_counter()
        for n in range(1, jobs + 1):
            client.post(f"{server.url}/denoise?iterations=1", content=buffer.getvalue()).raise_for_status()
            if n in (1, 10, 50) or n % 50 == 0:
                levels[n] = (_rss(server.process.pid), _rss(server.worker()))
                print(f"  after job {n}: server {levels[n][0]:.0f} MiB, worker {levels[n][1]:.0f} MiB", flush=True)
        seconds = time.perf_counter() - began
    if jobs > 50:
        grown = [last / first - 1 for first, last in zip(levels[50], levels[max(levels)], strict=True)]
        print(
            f"memory: {jobs} jobs of {points} points in {seconds:.0f} s: server {grown[0]:+.1%}, "
            f"worker {grown[1]:+.1%} since job 50 (target: within {MEMORY_TARGET:.0%})"
        )


def _rss(pid: int) -> float:
    """Return resident memory in MiB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=positive, default=50_000)
    parser.add_argument("--repeats", type=positive, default=3)
    parser.add_argument("--held", type=positive, default=300)
    parser.add_argument("--jobs", type=positive, default=500)
    parser.add_argument("--job-points", type=positive, default=20_000)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    args = parser.parse_args()
    print(f"{os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}, {threading.active_count()} thread here")
    if "overhead" in args.only:
        overhead(args.points, args.repeats)
    if "livez" in args.only:
        livez(args.points)
    if "held" in args.only:
        held(args.held)
    if "kill" in args.only:
        kill(args.points)
    if "memory" in args.only:
        memory(args.jobs, args.job_points)


if __name__ == "__main__":
    main()
