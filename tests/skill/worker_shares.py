"""A training with two workers whose every transition is known beforehand, because all actions are random."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import tiny_run
import torch
from tensordict import TensorDict

from hiernav.config import TrainConfig
from hiernav.run import Run
from hiernav.skill.machines import WorkerCollector, make_acting_policy, make_env
from hiernav.skill.train import Progress, SkillTrainer

SHARE = 128
"""Transitions that a worker delivers at a time."""
SETTINGS = (
    "skill.workers=2",
    "skill.total_steps=1024",
    "skill.checkpoint_every_steps=512",
    "skill.learning_starts=1023",
    "skill.eval_episodes=1",
)
"""Two segments of two batches each, all of random actions, and updates at the very end."""


def trainer_in(folder: Path, collector: str, *overrides: str) -> SkillTrainer:
    run = Run.create(tiny_run.config(folder, f"skill.collector={collector}", *SETTINGS, *overrides))
    return SkillTrainer(run.config, run)


def worker_here(config: TrainConfig, random_frames: int = 10**9) -> WorkerCollector:
    """A worker of a training, in this process."""
    return WorkerCollector(
        make_env(config),
        make_acting_policy(config),
        frames_per_batch=SHARE,
        total_frames=-1,
        init_random_frames=random_frames,
        auto_register_policy_transforms=False,
    )


def shares(config: TrainConfig, place: tuple[int, int, int], count: int) -> list[TensorDict]:
    """The first shares (M,) of a segment, by (its first step, index of the worker, generation of the worker)."""
    worker = worker_here(config)
    worker.begin(config, place)
    found = [data.reshape(-1) for data, _ in zip(worker, range(count), strict=False)]
    worker.shutdown()
    return found


def train_and_kill(trainer: SkillTrainer, kill: Callable[[SkillTrainer], None]) -> TensorDict:
    """Train to the end, with a worker killed after the first batch; all transitions in the order of the replay."""
    seen: list[TensorDict] = []

    def display(now: Progress) -> None:
        if now.steps == 2 * SHARE:
            kill(trainer)
        seen[:] = [trainer.replay._data[: now.steps].clone()]

    trainer.train(display)
    return seen[0]


def check_that_others_lost_nothing(trainer: SkillTrainer, replay: TensorDict) -> None:
    """Worker 0 is as if nothing had happened; what worker 1 could not deliver came from its successor."""
    config = trainer.config
    undisturbed = shares(config, (0, 0, 0), 2)
    after = zip(shares(config, (512, 0, 0), 2), shares(config, (512, 1, 1), 2), strict=True)
    expected = [
        *(undisturbed[0], shares(config, (0, 1, 0), 1)[0]),
        *(undisturbed[1], shares(config, (0, 1, 1), 1)[0]),
        *(share for both in after for share in both),
    ]
    assert len(replay) == len(trainer.replay) == 1024
    for key in ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "done")):
        assert torch.equal(replay[key], torch.cat([share[key] for share in expected])), key
