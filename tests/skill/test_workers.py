"""A dead worker is replaced and given up in the end; batches keep their order, and updates their place between them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import tiny_run

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")
pytest.importorskip("torchrl", reason="needs the extra hiernav[train]")

from tensordict import TensorDict  # noqa: E402

from hiernav.nav.planners import StraightPlanner  # noqa: E402
from hiernav.run import WorkersLost  # noqa: E402
from hiernav.skill import workers  # noqa: E402
from hiernav.skill.env import PhysicsDiverged  # noqa: E402
from hiernav.skill.workers import Order, Worker, WorkerBatches  # noqa: E402

pytestmark = pytest.mark.train


class Scripted:
    """Machines on which worker k, counted in the order of their start, dies after `lives[k]` shares (None: never)."""

    deaths = (RuntimeError,)

    def __init__(self, *lives: int | None, error: Exception | None = None) -> None:
        self.lives, self.error = list(lives), error or RuntimeError("gone\nand more")
        self.random_frames: list[int] = []
        self.stopped, self.closed = 0, 0
        self.failure: Exception | None = None

    def start(self, random_frames: int) -> ScriptedCollector:
        self.random_frames.append(random_frames)
        return ScriptedCollector(self, self.lives.pop(0) if self.lives else None)

    def close(self) -> None:
        self.closed += 1


class ScriptedCollector:
    """Delivers shares of one transition that tell where they come from and by which weights."""

    def __init__(self, machines: Scripted, shares: int | None) -> None:
        self.machines, self.shares = machines, shares

    def map_fn(self, method: str, arguments: list[tuple[Any, ...]] | None = None) -> None:
        if method == "begin":
            self.place = arguments[0][1]
        elif method == "load":
            self.weight = float(arguments[0][0]["weight"])
        elif method == "check" and self.machines.failure is not None:
            raise self.machines.failure

    def __iter__(self) -> Iterator[TensorDict]:
        while self.shares is None or self.shares > 0:
            place, weight = torch.tensor([[self.place]]), torch.tensor([[self.weight]])
            yield TensorDict({"place": place, "weight": weight}, [1, 1])
            self.shares = None if self.shares is None else self.shares - 1
        raise self.machines.error

    def shutdown(self) -> None:
        self.machines.stopped += 1


class OneSlow(Scripted):
    """Machines on which the worker started last is in the middle of its second share until `end`, and dies then."""

    def __init__(self) -> None:
        super().__init__()
        self.end = threading.Event()
        self.busy, self.stopped_while_busy = False, False

    def start(self, random_frames: int) -> ScriptedCollector:
        self.random_frames.append(random_frames)
        return (SlowCollector if len(self.random_frames) == 2 else ScriptedCollector)(self, None)


class SlowCollector(ScriptedCollector):
    machines: OneSlow

    def __iter__(self) -> Iterator[TensorDict]:
        yield next(super().__iter__())
        self.machines.busy = True
        self.machines.end.wait(60.0)
        self.machines.busy = False
        raise self.machines.error

    def shutdown(self) -> None:
        super().shutdown()
        self.machines.stopped_while_busy |= self.machines.busy
        self.machines.end.set()


class OneWeight(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("weight", torch.zeros(()))


@pytest.fixture
def config(tmp_path: Path):
    return tiny_run.config(tmp_path, "skill.workers=2", "skill.num_envs=1", "skill.learning_starts=0")


def order(segment: int = 0, random_frames: int = 0, again: int = 0) -> Order:
    return Order(segment, again, random_frames, {"weight": torch.zeros(()).numpy()}, threading.Event())


def places(*shares: TensorDict) -> list[tuple[int, ...]]:
    return [tuple(place) for share in shares for place in share["place"].tolist()]


def test_a_worker_that_dies_is_replaced_by_one_in_worlds_of_its_own(config, caplog) -> None:
    machines = Scripted(2, None)
    worker = Worker(1, config, machines)
    collected = [worker.collect(order()) for _ in range(4)]
    assert places(*collected) == [(0, 1, 0), (0, 1, 0), (0, 1, 1), (0, 1, 1)]
    assert caplog.messages == ["worker 1 died and is replaced: gone"]
    assert machines.stopped == 1


def test_a_worker_that_dies_is_named_by_one_number(config, caplog) -> None:
    worker = Worker(1, config, Scripted(0, 1, error=RuntimeError("a process failed: worker 0 (exit code -9).")))
    worker.collect(order())
    assert caplog.messages == ["worker 1 died and is replaced: a process failed: worker 1 (exit code -9)."]
    with pytest.raises(WorkersLost, match="worker 1 died 3 times .*: worker 1 failed to start$"):
        Worker(1, config, Scripted(0, 0, 0, error=RuntimeError("Worker 0 failed to start"))).collect(order())


def test_a_segment_begins_anew_for_a_worker_that_lives_on(config) -> None:
    worker = Worker(0, config, Scripted())
    collected = [worker.collect(order(segment)) for segment in (0, 0, 256)]
    assert places(*collected) == [(0, 0, 0), (0, 0, 0), (256, 0, 0)]


def test_a_successor_acts_at_random_for_as_long_as_is_left(config) -> None:
    machines = Scripted(1, None)
    worker = Worker(0, config, machines)
    for left in (30, 20, 10):
        worker.collect(order(random_frames=left))
    assert machines.random_frames == [30, 20]


def test_a_worker_that_never_delivers_ends_the_training(config) -> None:
    machines = Scripted(1, 0, 0, 0, 0)
    worker = Worker(1, config, machines)
    worker.collect(order())
    with pytest.raises(WorkersLost, match="worker 1 died 3 times without delivering anything, at last of: gone"):
        worker.collect(order())
    assert len(machines.random_frames) == 3


def test_a_worker_may_die_often_as_long_as_it_delivers(config) -> None:
    worker = Worker(0, config, Scripted(*[1] * 8))
    assert [worker.collect(order())["place"][0, 2].item() for _ in range(8)] == list(range(8))


def test_no_successor_is_started_once_nobody_waits(config) -> None:
    machines, late = Scripted(0, None), order()
    late.stopping.set()
    with pytest.raises(WorkersLost):
        Worker(0, config, machines).collect(late)
    assert len(machines.random_frames) == 1


@pytest.mark.parametrize("error", [ValueError("a bad world"), PhysicsDiverged("a bad world")])
def test_an_error_that_is_no_death_reaches_the_trainer(config, error) -> None:
    machines = Scripted(0, error=error)
    with pytest.raises(type(error), match="a bad world"):
        Worker(0, config, machines).collect(order())
    assert len(machines.random_frames) == 1


def test_a_share_in_which_physics_broke_is_not_delivered(config) -> None:
    machines = Scripted()
    worker = Worker(0, config, machines)
    worker.collect(order())
    machines.failure = PhysicsDiverged("simulation 3 is not finite")
    with pytest.raises(PhysicsDiverged, match="simulation 3"):
        worker.collect(order())
    assert len(machines.random_frames) == 1


def test_a_segment_that_is_tried_again_has_other_worlds_in_every_worker(config) -> None:
    machines = Scripted()
    shares = [Worker(index, config, machines).collect(order(256, again=2)) for index in (0, 1)]
    assert places(*shares) == [(256, 0, 0, 2), (256, 1, 0, 2)]


@pytest.mark.parametrize(("overlap", "acted_by"), [("false", [0, 1, 2]), ("true", [0, 0, 1])])
def test_a_batch_holds_all_shares_in_order_collected_by_the_weights_of_its_time(
    config, monkeypatch, tmp_path, overlap, acted_by
) -> None:
    machines = Scripted(None, 2)
    monkeypatch.setattr(workers, "find_machines", lambda *_: machines)
    overlapped = tiny_run.config(tmp_path, "skill.workers=2", "skill.collector=multi", f"skill.overlap={overlap}")
    policy = OneWeight()
    batches = WorkerBatches(overlapped, policy)
    weights, found = [], []
    for data in batches.segment(512, 3 * batches.frames):
        found.append(places(data))
        weights.append(data["weight"].tolist())
        policy.weight += 1  # an update
    batches.close()
    batches.close()
    assert found == [[(512, 0, 0), (512, 1, 0)]] * 2 + [[(512, 0, 0), (512, 1, 1)]]
    assert weights == [[float(weight)] * 2 for weight in acted_by]
    assert machines.stopped == 3 and machines.closed == 1


def test_workers_share_what_is_left_of_the_random_actions_and_plan_as_the_trainer_says(monkeypatch, tmp_path) -> None:
    machines, asked, planner = Scripted(1, 1), [], StraightPlanner()
    monkeypatch.setattr(workers, "find_machines", lambda *given: asked.append(given) or machines)
    config = tiny_run.config(tmp_path, "skill.workers=2", "skill.collector=multi", "skill.learning_starts=600")
    batches = WorkerBatches(config, OneWeight(), planner)
    assert (batches.share, batches.frames) == (128, 256)
    assert len(list(batches.segment(0, 512))) == 2
    batches.close()
    assert asked == [(config, 128, planner)]
    assert machines.random_frames == [3 * 128] * 2 + [2 * 128] * 2, "successors act at random for one batch less"


def test_no_worker_is_stopped_in_the_middle_of_its_share_and_none_is_replaced_after_the_end(
    monkeypatch, tmp_path
) -> None:
    machines = OneSlow()

    def wait(shares: list) -> None:
        machines.end.set()
        wait_for(shares)

    wait_for = workers.wait
    monkeypatch.setattr(workers, "wait", wait)
    monkeypatch.setattr(workers, "find_machines", lambda *_: machines)
    config = tiny_run.config(tmp_path, "skill.workers=2", "skill.collector=multi", "skill.overlap=true")
    batches = WorkerBatches(config, OneWeight())
    next(batches.segment(0, 3 * batches.frames))
    batches.close()
    assert not machines.stopped_while_busy
    assert (len(machines.random_frames), machines.stopped, machines.closed) == (2, 2, 1)


@pytest.mark.parametrize(
    ("settings", "share"),
    [
        (["skill.num_envs=8", "skill.checkpoint_every_steps=5000"], 128),
        (["skill.num_envs=8", "skill.checkpoint_every_steps=128"], 128),
        (["skill.num_envs=8", "skill.total_steps=128", "skill.learning_starts=0"], 64),
        (["skill.num_envs=48", "skill.checkpoint_every_steps=5000"], 96),
        (["skill.num_envs=500", "skill.checkpoint_every_steps=100"], 500),
    ],
)
def test_a_share_is_whole_steps_of_all_simulations_and_fits_the_segment(tmp_path, settings, share) -> None:
    config = tiny_run.config(tmp_path, "skill.workers=2", "skill.total_steps=10000", *settings)
    batches = WorkerBatches(config, OneWeight())
    assert (batches.share, batches.frames) == (share, 2 * share)
    batches.close()
