"""What a worker collects is decided by its place in the run alone, and no other worker loses by its death."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import tiny_run

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")
pytest.importorskip("torchrl", reason="needs the extra hiernav[train]")

import worker_shares as workers  # noqa: E402

from hiernav.run import Run  # noqa: E402
from hiernav.skill.env import PhysicsDiverged  # noqa: E402
from hiernav.skill.machines import make_acting_policy  # noqa: E402
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
