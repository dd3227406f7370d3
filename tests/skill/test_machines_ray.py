"""The claims about workers, on a Ray cluster that is started on this machine."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("torchrl", reason="needs the extra hiernav[train]")
ray = pytest.importorskip("ray", reason="needs the extra hiernav[ray]")

import tiny_run  # noqa: E402
import worker_shares as workers  # noqa: E402

from hiernav import cli  # noqa: E402
from hiernav.commands import exits  # noqa: E402
from hiernav.skill.train import SkillTrainer  # noqa: E402

pytestmark = [pytest.mark.train, pytest.mark.slow]
HERE = "skill.ray_address=local"
"""A cluster of the test's own, whatever else runs on this machine."""


def test_a_training_goes_on_when_an_actor_is_killed_and_the_others_lose_nothing(tmp_path, caplog) -> None:
    def kill(trainer: SkillTrainer) -> None:
        ray.kill(trainer.batches.workers[1].collector.remote_collectors[0])

    trainer = workers.trainer_in(tmp_path / "ray", "ray", HERE)
    replay = workers.train_and_kill(trainer, kill)
    assert [record.args[0] for record in caplog.records if "died" in record.msg] == [1]
    workers.check_that_others_lost_nothing(trainer, replay)
    assert trainer.finished and trainer.learner.updates == 25
    assert not ray.is_initialized()


def test_a_cluster_makes_the_run_that_the_processes_of_one_machine_make(tmp_path: Path) -> None:
    for collector in ("multi", "ray"):
        workers.trainer_in(tmp_path / collector, collector, HERE, "skill.learning_starts=256").train()
    lines = [(tmp_path / collector / "metrics.jsonl").read_bytes() for collector in ("multi", "ray")]
    assert lines[0] == lines[1] != b""


def test_more_workers_than_processors_are_refused_with_both_numbers(tmp_path, capsys) -> None:
    settings = tiny_run.arguments(tmp_path / "run", HERE, "planner.epochs=1")
    assert cli.main(["train", "--collector", "ray", "--workers", "1000", *settings]) == exits.BAD_INPUT
    assert "need 1000 processors; the Ray cluster has" in capsys.readouterr().err
    assert not ray.is_initialized()
