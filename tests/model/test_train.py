"""Three stages run, resume where they stopped, and give the same weights for the same seed."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from straightpcf.model.checkpoint import load_checkpoint
from straightpcf.model.filter import DEFAULT_WEIGHTS
from straightpcf.model.nets.straightpcf import StraightPCF
from straightpcf.model.train import Stage, TrainStep, loop, stages, train
from straightpcf.model.train.data import Batch, PatchSource
from straightpcf.model.train.losses import coupled_loss, velocity_loss
from straightpcf.model.train.soap import SOAP
from straightpcf.model.train.state import average_with, read_network
from straightpcf.model.train.team import Team
from straightpcf.model.turns import turns
from straightpcf.points.errors import InvalidOptions, MalformedFile

pytestmark = pytest.mark.usefixtures("few_to_validate_with")


@pytest.fixture(scope="module")
def velocity_run(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train("vm", data=data, run_dir=tmp_path_factory.mktemp("vm"), iterations=3, batch_size=2, threads=1, rows=32)


def weights(path: Path) -> dict[str, torch.Tensor]:
    return read_network(path)[0].state_dict()


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def test_an_optimiser_loaded_counts_its_steps_where_the_parameters_are() -> None:
    # On a GPU the count must be there: what a captured graph reads from the host stands still.
    here = torch.nn.Parameter(torch.zeros(4, 4))
    here.grad = torch.ones(4, 4)
    optimiser = SOAP([here])
    optimiser.step()
    there = torch.nn.Parameter(torch.zeros(4, 4, device="meta"))
    other = SOAP([there])
    other.load_state_dict(optimiser.state_dict())
    assert other.state[there]["step"].device == there.device


def test_an_optimiser_does_without_torchs_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)  # to import it takes seconds, and is refused now
    (parameter := torch.nn.Parameter(torch.zeros(4, 4))).grad = torch.ones(4, 4)
    (optimiser := SOAP([parameter])).step()
    optimiser.zero_grad()
    optimiser.load_state_dict(optimiser.state_dict())
    assert parameter.grad is None


def test_soap_finds_the_axes_of_an_ill_conditioned_problem() -> None:
    torch.manual_seed(0)
    left, right = (torch.linalg.qr(torch.randn(12, 12)).Q for _ in range(2))
    scale = torch.logspace(0, -1, 12)
    wanted = torch.randn(12, 12)

    def distance_after(steps: int, optimiser_of: type[torch.optim.Optimizer]) -> float:
        w = torch.nn.Parameter(torch.zeros(12, 12))
        optimiser = optimiser_of([w], lr=0.1)
        for step in range(1, steps + 1):
            optimiser.zero_grad()
            (scale[:, None] * (left @ (w - wanted) @ right) * scale).square().sum().backward()
            optimiser.step()
            if isinstance(optimiser, SOAP) and step % 10 == 0:
                optimiser.turn_bases()
        return (w.detach() - wanted).norm().item()

    assert distance_after(200, SOAP) < 0.05 * distance_after(200, torch.optim.Adam)


@pytest.mark.parametrize(("device", "chosen"), [("cuda", []), ("cuda:1", [torch.device("cuda:1")])])
def test_training_makes_a_device_current_where_one_is_named(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, chosen: list[torch.device]
) -> None:
    # torch.cuda.set_device refuses "cuda", which is the current one anyway.
    current: list[torch.device] = []

    class Sent(Exception):  # noqa: N818
        pass

    def send(*_: object) -> None:
        raise Sent

    monkeypatch.setattr(loop, "device_named", lambda name: name)
    monkeypatch.setattr(torch.cuda, "set_device", current.append)
    monkeypatch.setattr(torch.nn.Module, "to", send)
    with pytest.raises(Sent):
        train("vm", data=data, run_dir=tmp_path, iterations=1, device=device)
    assert current == chosen


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("stage", ["vm", "cvm"])
def test_a_stage_runs_as_a_cuda_graph(data: Path, tmp_path: Path, velocity_run: Path, stage: Stage) -> None:
    init = None if stage == "vm" else velocity_run
    path = train(stage, data=data, run_dir=tmp_path, iterations=5, batch_size=4, device="cuda", init=init)
    assert all(torch.isfinite(tensor).all() for tensor in weights(path).values())


def test_the_same_seed_gives_the_same_weights(data: Path, tmp_path: Path, velocity_run: Path) -> None:
    again = train("vm", data=data, run_dir=tmp_path, iterations=3, batch_size=2, threads=1, rows=32)
    assert same(weights(again), weights(velocity_run))


def test_a_later_stage_asks_for_the_one_before(data: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidOptions, match="init"):
        train("cvm", data=data, run_dir=tmp_path, iterations=1, batch_size=2, threads=1, rows=32)


def test_one_call_trains_all_stages_goes_on_where_it_stopped_and_freezes_what_it_should(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = [replace(run, iterations=10, batch_size=2) for run in stages.RUNS]
    monkeypatch.setattr(stages, "RUNS", runs)
    seen: list[tuple[str, int]] = []

    def call(*, stopping: bool) -> Path | None:
        return stages.train_stages(
            tmp_path, data=[data], share=0.1, threads=1, rows=32,
            on_step=lambda run, step: seen.append((run.name, step.iteration)), stop=lambda: stopping,
        )  # fmt: skip

    for _ in runs[:-1]:
        assert call(stopping=True) is None
    last = tmp_path / "dm" / loop.STATE_FILE
    assert call(stopping=False) == last
    assert seen == [(run.name, 1) for run in runs]
    coupled, full = weights(tmp_path / "cvm" / loop.STATE_FILE), weights(last)
    assert {name.split(".")[0] for name in full if not torch.equal(coupled[name], full[name])} == {"distance_module"}
    assert call(stopping=False) == last
    assert len(seen) == len(runs)  # nothing is left to do


def test_a_resumed_run_goes_on_from_its_state(data: Path, tmp_path: Path) -> None:
    seen: list[int] = []
    for iterations in (2, 4):
        train("vm", data=data, run_dir=tmp_path, iterations=iterations, batch_size=2, threads=1, rows=32,
              on_step=lambda step: seen.append(step.iteration))  # fmt: skip
    assert seen == [1, 2, 3, 4]
    assert (tmp_path / "log.csv").read_text().count("stage") == 1


def test_what_an_interruption_lost_stands_in_the_log_once(data: Path, tmp_path: Path) -> None:
    def iterations() -> list[str]:
        return [row.split(",")[1] for row in (tmp_path / "log.csv").read_text().splitlines()]

    (tmp_path / "log.csv").write_text(
        "stage,iteration\nvm,50,1,,1,1\n"
    )  # of a run that was ended before its first state
    train("vm", data=data, run_dir=tmp_path, iterations=2, batch_size=2, threads=1, rows=32)
    assert iterations() == ["iteration", "2"]
    with (tmp_path / "log.csv").open("a") as log:
        log.write("vm,50,1.0,,0.001,1.0\r\nvm,10")  # and then within a line
    train("vm", data=data, run_dir=tmp_path, iterations=3, batch_size=2, threads=1, rows=32)
    assert iterations() == ["iteration", "2", "3"]


def test_an_interrupted_run_ends_with_the_weights_of_an_uninterrupted_one(data: Path, tmp_path: Path) -> None:
    once, twice = tmp_path / "once", tmp_path / "twice"
    train("vm", data=data, run_dir=once, iterations=12, batch_size=1, threads=1, rows=32)
    train("vm", data=data, run_dir=twice, iterations=12, batch_size=1, threads=1, rows=32, minutes=0.0)
    train("vm", data=data, run_dir=twice, iterations=12, batch_size=1, threads=1, rows=32)
    assert same(weights(once / "state.safetensors"), weights(twice / "state.safetensors"))


@pytest.mark.slow
def test_a_shared_run_is_the_same_again_and_where_it_was_interrupted(data: Path, tmp_path: Path) -> None:
    def run(name: str, stops: Sequence[bool] = ()) -> dict[str, torch.Tensor]:
        asked = iter([*stops, *6 * [False]])
        return weights(train("vm", data=data, run_dir=tmp_path / name, iterations=6, batch_size=2, rows=32, threads=1,
                             processes=2, stop=lambda: next(asked)))  # fmt: skip

    once = run("once")
    run("stopped", [False, False, True])
    assert read_network(tmp_path / "stopped" / "state.safetensors")[1]["iteration"] == 3
    assert same(once, run("stopped"))  # and so is every iteration the same again: a whole second run would tell no more


def test_a_directory_in_which_a_run_is_at_work_is_no_other_ones(data: Path, tmp_path: Path) -> None:
    wanted = partial(train, "vm", data=data, run_dir=tmp_path, iterations=1, batch_size=2, threads=1, rows=32)
    refused: list[str] = []

    def another_one(_: TrainStep) -> None:
        state = (tmp_path / "state.safetensors").read_bytes()
        with pytest.raises(InvalidOptions) as error:
            wanted(iterations=5)
        refused.append(str(error.value))
        assert (tmp_path / "state.safetensors").read_bytes() == state

    wanted(on_step=another_one)
    assert refused == [f"another training run is at work in {tmp_path}: give one of its own"]
    wanted(iterations=2)  # what the first one left does not keep the next from going on
    assert read_network(tmp_path / "state.safetensors")[1]["iteration"] == 2


def test_a_run_of_another_stage_or_stack_is_not_gone_on_with(data: Path, tmp_path: Path, velocity_run: Path) -> None:
    run = partial(train, data=data, run_dir=tmp_path, iterations=1, batch_size=1, threads=1, rows=32, init=velocity_run)
    run("cvm")
    for stage, couplings in (("dm", 2), ("cvm", 3), ("vm", 2)):
        with pytest.raises(InvalidOptions, match="takes another directory"):
            run(stage, couplings=couplings)


def test_a_settled_run_keeps_the_statistics_and_can_start_from_its_own_stage(
    data: Path, tmp_path: Path, velocity_run: Path
) -> None:
    path = train(
        "vm",
        data=data,
        run_dir=tmp_path,
        iterations=2,
        batch_size=2,
        threads=1,
        rows=32,
        init=velocity_run,
        settled=True,
    )
    before, after = weights(velocity_run), weights(path)
    moved = {name.rsplit(".", 1)[1] for name in before if not torch.equal(before[name], after[name])}
    assert moved == {"weight", "bias"}


def test_a_run_starts_from_weights_that_ship_and_takes_their_distance_module(data: Path, tmp_path: Path) -> None:
    path = train("cvm", data=data, run_dir=tmp_path, iterations=2, batch_size=1, threads=1, rows=32,
                 init=DEFAULT_WEIGHTS, distance=DEFAULT_WEIGHTS, settled=True)  # fmt: skip
    before, after = load_checkpoint(DEFAULT_WEIGHTS).state_dict(), weights(path)
    moved = {name for name in before if not torch.equal(before[name], after[name])}
    assert moved
    assert {name.split(".")[0] for name in moved} == {"velocity_modules"}
    (broken := tmp_path / "broken.safetensors").write_bytes(b"no header")
    with pytest.raises(MalformedFile, match="is no safetensors file"):
        train("cvm", data=data, run_dir=tmp_path / "none", iterations=1, init=broken)


def test_a_run_that_starts_from_weights_that_ship_rounds_as_the_one_that_goes_on_from_it() -> None:
    # Products round by how their tensors lie in memory, and those of a file lie as they do in the file.
    network = loop._network("dm", DEFAULT_WEIGHTS, 2, resuming=False)
    resumed = loop._network("dm", None, 2, resuming=True)
    resumed.load_state_dict(network.state_dict())
    assert {p.data_ptr() % 64 for p in (*network.parameters(), *network.buffers()) if p.numel() > 1} == {0}
    patch = torch.from_numpy(np.random.default_rng(0).standard_normal((1, 1000, 3)).astype(np.float32))
    assert torch.equal(network.distance_module(0.2 * patch), resumed.distance_module(0.2 * patch))


def test_the_distance_module_may_come_from_another_state(data: Path, tmp_path: Path, velocity_run: Path) -> None:
    def run(stage: Stage, name: str, init: Path, distance: Path | None = None) -> Path:
        return train(stage, data=data, run_dir=tmp_path / name, iterations=1, batch_size=1, threads=1, rows=32,
                     init=init, distance=distance)  # fmt: skip

    coupled = run("cvm", "cvm", velocity_run)
    other = run("dm", "dm", coupled)
    joined = weights(run("cvm", "joined", coupled, distance=other))
    theirs = {name: tensor for name, tensor in weights(other).items() if name.startswith("distance_module")}
    assert same(theirs, joined)


def test_the_mean_of_two_states_is_taken_weight_for_weight(velocity_run: Path) -> None:
    torch.manual_seed(1)
    network = StraightPCF(couplings=1)
    ours = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    theirs = weights(velocity_run)
    average_with(network, velocity_run)
    for name, mean in network.state_dict().items():
        both = (ours[name] + theirs[name]) / 2 if name.startswith("velocity") else ours[name]
        if mean.is_floating_point():
            torch.testing.assert_close(mean, both)


def test_processes_share_a_batch_and_the_weights(data: Path, tmp_path: Path, velocity_run: Path) -> None:
    losses: list[float] = []
    path = train("vm", data=data, run_dir=tmp_path, iterations=3, batch_size=4, threads=1, rows=32, processes=2,
                 settled=True, init=velocity_run, on_step=lambda step: losses.append(step.loss))  # fmt: skip
    assert len(losses) == 3
    assert all(np.isfinite(losses))
    before, after = weights(velocity_run), weights(path)
    moved = {name for name in before if not torch.equal(before[name], after[name])}
    assert {"velocity_modules.0.encoder.conv3.lin.weight", "velocity_modules.0.decoder.lin_3.bias"} <= moved


def test_a_team_gives_the_mean_of_the_gradients(data: Path) -> None:
    torch.manual_seed(0)
    network = StraightPCF(couplings=1).eval()
    trained = network.velocity_modules
    loss_of = partial(velocity_loss, rows=64)
    team = Team(1, network, trained, loss_of, [data], 2, 7)
    source = PatchSource.read(data)
    ours = source.draw(np.random.default_rng(8), 2)

    def gradients(batch: Batch) -> tuple[float, list[torch.Tensor]]:
        trained.zero_grad()
        (loss := loss_of(network, batch)).backward()
        return loss.item(), [p.grad.clone() for p in trained.parameters() if p.grad is not None]

    # The member draws with the generator of its iteration, that also gave its dropout seed.
    rng = np.random.default_rng((7, 1, 1))
    rng.integers(2**62)
    theirs_loss, theirs_gradient = gradients(source.draw(rng, 2))
    ours_loss, ours_gradient = gradients(ours)
    team.start(training=False)
    joined = team.join(torch.tensor(ours_loss))
    team.close()
    assert joined.item() == pytest.approx((ours_loss + theirs_loss) / 2, rel=1e-5)
    found = [p.grad for p in trained.parameters() if p.grad is not None]
    for mean, a, b in zip(found, ours_gradient, theirs_gradient, strict=True):
        torch.testing.assert_close(mean, (a + b) / 2, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("euler_steps", [1, 3])
def test_the_coupled_loss_takes_the_pass_that_the_filter_takes(data: Path, euler_steps: int) -> None:
    torch.manual_seed(0)
    network = StraightPCF(couplings=2).eval()
    batch = PatchSource.read(data).draw(np.random.default_rng(0), 2)
    seen: list[torch.Tensor] = []
    for module in network.velocity_modules:
        module.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    rows, count = 64, 2 * euler_steps
    with torch.no_grad():
        loss = coupled_loss(network, batch, rows, euler_steps)
        trained, seen[:] = seen[:], []
        network(batch.at(batch.time), euler_steps=euler_steps, rows=rows, owned=torch.tensor([rows, rows]),
                distance=(1 - batch.time[:, :, 0]).clamp(max=1), turns=turns(count))  # fmt: skip
    assert torch.isfinite(loss)
    assert len(trained) == len(seen) == count
    for ours, theirs in zip(trained, seen, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_a_run_that_fails_ends_the_processes_that_share_its_batches(data: Path, tmp_path: Path) -> None:
    def fail(step: TrainStep) -> None:
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space"):
        train(
            "vm", data=data, run_dir=tmp_path, iterations=3, batch_size=2, threads=1, rows=32, processes=2, on_step=fail
        )
    for process in multiprocessing.active_children():
        process.join(timeout=30)
    assert not multiprocessing.active_children()


@pytest.mark.skipif(sys.platform == "win32", reason="limits of a file's size are POSIX")
def test_a_state_that_the_disk_has_no_room_for_is_a_files_error_and_the_old_one_stays(
    data: Path, tmp_path: Path
) -> None:
    import resource

    run = partial(train, "vm", data=data, run_dir=tmp_path, batch_size=1, rows=16, threads=1)
    before = run(iterations=1).read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OSError, match="cannot be written"):
            run(iterations=2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "state.safetensors").read_bytes() == before
    assert not (tmp_path / "state.tmp").exists()


def test_a_run_with_its_minutes_used_up_stops_with_its_state_saved(data: Path, tmp_path: Path) -> None:
    path = train("vm", data=data, run_dir=tmp_path, iterations=100, batch_size=2, threads=1, rows=32, minutes=0.0)
    assert read_network(path)[1]["iteration"] == 1


def test_a_device_that_is_fast_saves_no_more_often_than_its_seconds_say_and_at_the_end(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "_LOG_EVERY", 1)
    monkeypatch.setitem(loop._SAVE_SECONDS, "cpu", 3600.0)
    there = []
    path = train(
        "vm", data=data, run_dir=tmp_path, iterations=3, batch_size=1, threads=1,
        on_step=lambda _: there.append((tmp_path / loop.STATE_FILE).exists()),
    )  # fmt: skip
    assert there == [False, False, True]
    assert read_network(path)[1]["iteration"] == 3
    assert len((tmp_path / "log.csv").read_text().splitlines()) == 4


@pytest.mark.parametrize("what", ["the loss is nan at iteration 3", "weights are not finite at iteration 4"])
def test_a_run_that_diverges_says_what_to_do_and_keeps_its_last_good_state(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.setattr(loop, "_LOG_EVERY", 2)

    class Diverging(loop.HostStep):
        done = 0

        def __call__(self, learning_rate: float) -> torch.Tensor:
            self.done += 1
            if self.done == 4:  # the loss is of before the update
                next(self._trained.parameters()).data.fill_(torch.nan)
            return torch.tensor(torch.nan if self.done == 3 and what.startswith("the loss") else 1.0)

    monkeypatch.setattr(loop, "HostStep", Diverging)
    with pytest.raises(InvalidOptions, match=rf"{what}: .* has iteration 2, .* a lower learning rate than 0\.001"):
        train("vm", data=data, run_dir=tmp_path, iterations=6, batch_size=1, threads=1, rows=32)
    state = tmp_path / loop.STATE_FILE
    assert read_network(state)[1]["iteration"] == 2
    assert all(bool(tensor.isfinite().all()) for tensor in weights(state).values())
