"""What a worker collects is decided by its place in the run alone, and no other worker loses by its death."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tiny_run

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")
pytest.importorskip("torchrl", reason="needs the extra hiernav[train]")

import worker_shares as workers  # noqa: E402

from hiernav.config import ConfigError, TrainConfig  # noqa: E402
from hiernav.nav.planners import StraightPlanner  # noqa: E402
from hiernav.run import Run  # noqa: E402
from hiernav.skill import machines  # noqa: E402
from hiernav.skill.env import PhysicsDiverged  # noqa: E402
from hiernav.skill.machines import Cluster, Processes, find_machines, make_acting_policy  # noqa: E402
from hiernav.skill.train import SkillTrainer  # noqa: E402

pytestmark = pytest.mark.train


def names_of_metrics(folder: Path) -> dict[str, set[str]]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return {line["stage"]: set(line) for line in lines}


def test_a_place_in_the_run_decides_all_that_a_worker_collects(tmp_path: Path) -> None:
    config = tiny_run.config(tmp_path, *workers.SETTINGS)
    first = workers.shares(config, (0, 0, 0), 2)
    kept = workers.worker_here(config)
    for place in ((512, 1, 0), (0, 0, 0)):
        kept.begin(config, place)
        again = [data.reshape(-1) for data, _ in zip(kept, range(2), strict=False)]
    for ours, theirs in zip(first, again, strict=True):
        assert torch.equal(ours["observation"], theirs["observation"])
        assert torch.equal(ours["action"], theirs["action"])


def test_no_two_places_share_a_world_or_a_random_number(tmp_path: Path) -> None:
    config = tiny_run.config(tmp_path, *workers.SETTINGS)
    places = [(0, 0, 0), (0, 1, 0), (0, 0, 1), (512, 0, 0), (1, 0, 0)]
    collected = [workers.shares(config, place, 1)[0] for place in places]
    starts = {tuple(data["observation"][0].tolist()) for data in collected}
    actions = {tuple(data["action"][0].tolist()) for data in collected}
    assert len(starts) == len(actions) == len(places)


def test_runs_of_other_seeds_share_no_random_number(tmp_path: Path) -> None:
    collected = [
        workers.shares(tiny_run.config(tmp_path, *workers.SETTINGS, f"seed={seed}"), (0, 0, 0), 1)[0] for seed in (0, 1)
    ]
    assert not torch.equal(collected[0]["action"], collected[1]["action"])


def test_a_worker_acts_by_the_weights_it_is_given(tmp_path: Path) -> None:
    config = tiny_run.config(tmp_path, *workers.SETTINGS)
    weights = make_acting_policy(config).state_dict()
    worker = workers.worker_here(config, random_frames=0)
    for wanted in (0.5, -0.25):
        for key, value in weights.items():
            if "head" in key:
                value.fill_(0.0)
            if key.endswith("head.bias"):
                value[:2], value[2:] = torch.atanh(torch.tensor(wanted)), -10.0  # the least noise there is: 0.007
        worker.load({key: value.numpy() for key, value in weights.items()})
        worker.begin(config, (0, 0, 0))
        torch.testing.assert_close(worker.next()["action"], torch.full((1, 128, 2), wanted), atol=0.05, rtol=0.0)


def test_an_error_in_a_worker_is_told_when_it_is_asked_for(tmp_path: Path) -> None:
    worker = workers.worker_here(tiny_run.config(tmp_path, *workers.SETTINGS, "skill.num_envs=8"))
    worker.next()
    worker.check()
    worker.env.task.sim.datas[3].qvel[0] = np.nan
    worker.next()
    with pytest.raises(PhysicsDiverged, match="simulation 3 is not finite"):
        worker.check()


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """What each worker was started with, in the place of starting it."""
    calls: list[dict] = []

    def start(make_envs: list, **options: object) -> dict:
        calls.append({"make_env": make_envs[0], **options})
        return calls[-1]

    monkeypatch.setattr(machines, "MultiSyncCollector", start)
    monkeypatch.setattr("torchrl.collectors.distributed.RayCollector", start)
    return calls


class FakeRay:
    """As much of Ray as a training asks for: a cluster of some processors, joined already or not."""

    exceptions = SimpleNamespace(
        AuthenticationError=type("AuthenticationError", (Exception,), {}),
        **dict.fromkeys(("RayActorError", "ObjectLostError", "WorkerCrashedError"), OSError),
    )

    def __init__(self, cpus: float = 8.0, joined: bool = False, error: Exception | None = None) -> None:
        self.cpus, self.joined, self.error = cpus, joined, error
        self.address: object = None

    def is_initialized(self) -> bool:
        return self.joined

    def init(self, address: str | None, **_: object) -> None:
        self.address = address
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if self.error is not None:
            raise self.error
        self.joined = True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": self.cpus}

    def shutdown(self) -> None:
        self.joined = False


def cluster_config(folder: Path, *overrides: str) -> TrainConfig:
    settings = ("skill.collector=ray", "skill.ray_address=10.0.0.1:6379", "skill.workers=2", "threads=2")
    return tiny_run.config(folder, *settings, *overrides)


@pytest.mark.parametrize("collector", ["multi", "ray"])
def test_a_worker_simulates_plans_and_acts_as_the_training_says(tmp_path, monkeypatch, started, collector) -> None:
    monkeypatch.setitem(sys.modules, "ray", FakeRay())
    monkeypatch.delenv("RAY_worker_niceness", raising=False)
    settings = ("skill.num_envs=3", "skill.end_on_fall=true", "threads=1", f"skill.collector={collector}")
    config, planner = cluster_config(tmp_path, *settings), StraightPlanner()
    assert find_machines(config, 96, planner).start(192) is started[0]
    assert (started[0]["frames_per_batch"], started[0]["init_random_frames"]) == (96, 192)
    task = started[0]["make_env"]().task
    assert (task.num_rows, task.option.planner, task.end_on_fall) == (3, planner, True)
    assert started[0]["policy_factory"]().state_dict().keys() == make_acting_policy(config).state_dict().keys()


def test_a_worker_takes_as_many_threads_as_are_set_and_the_trainer_has_its_own_again(tmp_path, monkeypatch, started):
    monkeypatch.setitem(sys.modules, "ray", FakeRay())
    config, asked = cluster_config(tmp_path), list[int]()
    here, there = Processes(config, 64), Cluster(config, 64)
    here.start(0)
    there.start(0)
    assert started[0]["num_threads"] == started[0]["num_sub_threads"] == 2
    assert started[1]["remote_configs"]["num_cpus"] == 2
    monkeypatch.setattr(torch, "set_num_threads", asked.append)
    started[0]["make_env"]()
    here.close()
    assert asked == [2, 2]


def test_ctrl_c_ends_no_worker_before_the_trainer_does(tmp_path, started) -> None:
    Processes(cluster_config(tmp_path), 64).start(0)
    before = signal.getsignal(signal.SIGINT)
    try:
        started[0]["init_fn"]()
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("kind", [ConnectionError, FakeRay.exceptions.AuthenticationError])
def test_a_cluster_that_cannot_be_joined_is_named(tmp_path, monkeypatch, kind: type[Exception]) -> None:
    monkeypatch.setitem(sys.modules, "ray", FakeRay(error=kind("nobody there\n")))
    with pytest.raises(ConfigError, match="skill.ray_address = '10.0.0.1:6379': nobody there; is `ray start"):
        Cluster(cluster_config(tmp_path), 64)


@pytest.mark.parametrize("joined", [False, True])
def test_a_training_leaves_the_cluster_that_it_joined_and_no_other(tmp_path, monkeypatch, joined: bool) -> None:
    ray = FakeRay(cpus=4.0, joined=joined)
    monkeypatch.setitem(sys.modules, "ray", ray)
    cluster = Cluster(cluster_config(tmp_path), 64)
    assert ray.joined and ray.address == (None if joined else "10.0.0.1:6379")
    cluster.close()
    assert ray.joined is joined


@pytest.mark.parametrize(("asked", "sent"), [(None, "0"), ("1", "1")])
def test_a_cluster_sends_usage_statistics_only_where_that_was_asked_for(tmp_path, monkeypatch, asked, sent) -> None:
    seen: list[str | None] = []

    class Watched(FakeRay):
        def init(self, address: str | None, **options: object) -> None:
            seen.append(os.environ.get("RAY_USAGE_STATS_ENABLED"))
            super().init(address, **options)

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", asked or "")
    if asked is None:
        del os.environ["RAY_USAGE_STATS_ENABLED"]
    monkeypatch.setitem(sys.modules, "ray", Watched())
    Cluster(cluster_config(tmp_path), 64)
    assert seen == [sent]


def test_sigterm_is_still_answered_by_the_training_that_joined_a_cluster(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", FakeRay())
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        Cluster(cluster_config(tmp_path), 64)
        assert signal.getsignal(signal.SIGTERM) == signal.default_int_handler
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_cluster_with_too_few_processors_is_refused_and_left(tmp_path, monkeypatch) -> None:
    ray = FakeRay(cpus=3.0)
    monkeypatch.setitem(sys.modules, "ray", ray)
    with pytest.raises(ConfigError, match="workers = 2 with threads = 2 need 4 processors; the Ray cluster has 3"):
        Cluster(cluster_config(tmp_path), 64)
    assert not ray.joined


def test_a_training_goes_on_when_a_process_is_killed_and_the_others_lose_nothing(tmp_path, caplog) -> None:
    def kill(trainer: SkillTrainer) -> None:
        os.kill(trainer.batches.workers[1].collector.procs[0].pid, signal.SIGKILL)

    trainer = workers.trainer_in(tmp_path / "multi", "multi")
    replay = workers.train_and_kill(trainer, kill)
    assert [record.args[0] for record in caplog.records if "died" in record.msg] == [1]
    workers.check_that_others_lost_nothing(trainer, replay)
    assert trainer.finished and trainer.learner.updates == 25 and trainer.best_actor is not None
    workers.trainer_in(tmp_path / "local", "local").train()
    assert names_of_metrics(tmp_path / "multi") == names_of_metrics(tmp_path / "local") != {}


@pytest.mark.slow
def test_an_interrupted_training_with_workers_equals_an_uninterrupted_one_to_the_bit(tmp_path: Path) -> None:
    settings = ("skill.learning_starts=256", "skill.overlap=true")
    straight = workers.trainer_in(tmp_path / "straight", "multi", *settings)
    straight.train()

    def interrupt(now: object) -> None:
        if now.steps > 512:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        workers.trainer_in(tmp_path / "resumed", "multi", *settings).train(interrupt)
    run = Run.open(tmp_path / "resumed")
    resumed = SkillTrainer(run.config, run)
    assert resumed.resume() == 512
    resumed.train()
    ours, theirs = straight.learner.actor.state_dict(), resumed.learner.actor.state_dict()
    assert all(torch.equal(value, theirs[key]) for key, value in ours.items())
    lines = [(tmp_path / name / "metrics.jsonl").read_bytes() for name in ("straight", "resumed")]
    assert lines[0] == lines[1]
