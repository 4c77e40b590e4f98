"""As many threads as CPUs that the process may run on, not as the machine has."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from straightpcf.model import cpus
from straightpcf.model.cpus import usable_cpus
from straightpcf.model.filter import Filter
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.normals import recompute_normals
from straightpcf.model.train.loop import train
from straightpcf.points.errors import InvalidOptions
from straightpcf.points.options import DenoiseOptions
from straightpcf.service.settings import Settings
from tests.clouds import noisy, sphere, torus


def test_a_process_that_is_held_to_some_cpus_has_those(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 5, 6}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(cpus, "_CGROUP", Path("/none"))
    assert usable_cpus() == 3
    network = StraightPCF(width=16, distance_width=16)
    assert Filter(network).threads == 3
    assert Filter(network, threads=2).threads == 2


@pytest.mark.parametrize(
    ("membership", "said", "usable"),
    [
        ("0::/", {"cpu.max": "150000 100000\n"}, 2),  # in a container, of Docker or Kubernetes
        ("0::/a.slice/b.service", {"a.slice/b.service/cpu.max": "max 100000\n", "a.slice/cpu.max": "9 100\n"}, 1),
        ("0::/a.slice/b.service", {"a.slice/cpu.max": "400000 100000\n"}, 4),
        ("0::/", {"cpu.max": "max 100000\n"}, 8),
        ("0::/", {"cpu.max": "6400000 100000\n"}, 8),
        ("0::/", {"cpu.max": "?\n"}, 8),
        ("0::/", {}, 8),
        (
            "4:memory:/of/the/host\n3:cpu,cpuacct:/of/the/host\n0::/",  # version 1, whose paths are the host's
            {"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"},
            3,
        ),
        ("3:cpu:/", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
    ],
)
def test_a_process_that_is_granted_the_time_of_some_cpus_has_as_many_threads(
    membership: str, said: dict[str, str], usable: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "membership").write_text(f"{membership}\n")
    for name, text in said.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(cpus, "_CGROUP", tmp_path / "membership")
    monkeypatch.setattr(cpus, "_CGROUPS", tmp_path)
    assert usable_cpus() == usable


@pytest.mark.parametrize("threads", [-1, 0, 1.5, 1025, 99_999_999_999])
def test_threads_are_in_1_to_1024(threads: float, tmp_path: Path) -> None:
    said = re.escape(f"threads is {threads}; it must be a whole number in 1..1024")
    with pytest.raises(InvalidOptions, match=said):
        Filter(StraightPCF(width=16, distance_width=16), threads=threads)  # type: ignore[arg-type]
    with pytest.raises(InvalidOptions, match=said):
        Settings(threads=threads)  # type: ignore[arg-type]
    with pytest.raises(InvalidOptions, match=said):
        train("vm", data=tmp_path / "none.npz", run_dir=tmp_path, iterations=1, threads=threads)  # type: ignore[arg-type]


@pytest.mark.parametrize(("there", "usable"), [(8, 8), (None, 1)])
def test_where_the_system_cannot_say_all_are_taken(
    there: int | None, usable: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: there)
    monkeypatch.setattr(cpus, "_CGROUP", Path("/none"))
    assert usable_cpus() == usable


def test_no_more_threads_look_up_neighbours_than_a_filter_has(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[int] = []

    class Tree(cKDTree):  # type: ignore[misc]
        def query(self, *args: object, workers: int = 1, **options: object) -> tuple[np.ndarray, np.ndarray]:
            taken.append(workers)
            return super().query(*args, workers=workers, **options)

    for module in ("patches", "tiles", "spread", "outliers"):
        monkeypatch.setattr(f"straightpcf.model.{module}.cKDTree", Tree)
    network = StraightPCF(width=16, distance_width=16)
    monkeypatch.setattr("straightpcf.model.filter.MIN_TILE_POINTS", 4000)
    cloud, results = noisy(torus(4400), 0.01), []
    for threads in (1, 2):
        taken.clear()
        model = Filter(network, threads=threads, coverage=1, tile_points=4000)
        results.append(model.denoise(cloud, DenoiseOptions(iterations=1)).xyz)
        assert max(taken) == threads
        assert min(taken) >= 1
    assert results[0].tobytes() == results[1].tobytes()


def test_normals_do_not_depend_on_the_threads() -> None:
    xyz = sphere(2000)
    np.testing.assert_array_equal(recompute_normals(xyz, xyz, workers=2), recompute_normals(xyz, xyz))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # Python 3.12's, of any fork beside threads
def test_a_forked_process_denoises_as_its_parent_does() -> None:
    """Threads do not come along: neither the filter's own nor OpenMP's, for which torch would wait for ever."""
    filter, cloud = Filter(StraightPCF(width=16, distance_width=16), threads=2), noisy(torus(200), 0.01)
    options, many = DenoiseOptions(iterations=1), torch.ones(1 << 17)
    expected = filter.denoise(cloud, options).xyz
    assert (many + many).sum() == 1 << 18  # more than torch gives to one thread
    context = multiprocessing.get_context("fork")
    results = context.SimpleQueue()

    def work() -> None:
        found = filter.denoise(cloud, options).xyz
        results.put((found, float((many + many).sum())))

    child = context.Process(target=work, daemon=True)
    child.start()
    child.join(30)
    if child.is_alive():
        child.kill()
        pytest.fail("the forked process hangs")
    found, total = results.get()
    np.testing.assert_array_equal(found, expected)
    assert total == 1 << 18


def test_a_filter_can_be_handed_to_another_process_or_copied() -> None:
    """As `multiprocessing.Pool.map` does with what it is to call."""
    filter, cloud = Filter(StraightPCF(width=16, distance_width=16), threads=1), noisy(torus(60), 0.01)
    expected = filter.denoise(cloud, DenoiseOptions(iterations=1)).xyz
    for again in (pickle.loads(pickle.dumps(filter)), copy.deepcopy(filter)):
        np.testing.assert_array_equal(again.denoise(cloud, DenoiseOptions(iterations=1)).xyz, expected)
