"""How batches of transitions are made: by simulations in this process, in other processes, or on a Ray cluster.

A run is cut into segments. Each begins with freshly drawn episodes, whose worlds and noise follow from the seed and the
place of the segment in the run alone, so that a segment can be collected again as it was.
"""

from __future__ import annotations

from collections.abc import Generator
from itertools import islice
from typing import Protocol

from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.modules import ProbabilisticActor

from hiernav.config import SkillConfig, TrainConfig
from hiernav.nav.option import Planner
from hiernav.sim.factory import RandomLayouts, make_task
from hiernav.sim.layout import WorldSpec, parse_world
from hiernav.sim.robots import get_robot
from hiernav.skill.env import NavigationEnv

_BATCH_FRAMES = 128
"""Steps collected by one process between two bursts of updates, at least one per simulation."""
_SEGMENT_STEPS = 150
"""Steps of every simulation that a segment is made of at least: its end cuts all episodes short."""


class Batches(Protocol):
    """Where the trainer's transitions come from."""

    frames: int
    """Most transitions of a batch."""

    def segment(self, steps: int, frames: int, again: int = 0) -> Generator[TensorDict]:
        """Batches (M,) of about `frames` transitions of fresh episodes, for a run that has `steps` of them so far.

        `again` says how often that failed before: each time other worlds are drawn.
        """
        ...

    def close(self) -> None:
        """Stop whatever was started; safe to call twice."""
        ...


class LocalBatches:
    """One batch of simulations in this process, stepped by torchrl's Collector.

    Args:
        config: the training.
        policy: the learner's, whose weights may change between batches.
        planner: guides the robots; the expert by default.
    """

    def __init__(self, config: TrainConfig, policy: ProbabilisticActor, planner: Planner | None = None) -> None:
        self.config, self.policy = config, policy
        skill = config.skill
        self.frames = frames_of_batch(skill.num_envs, skill.total_steps)
        self.task = make_task(config, skill.num_envs, planner, training=True)
        self._env = NavigationEnv(self.task)

    def segment(self, steps: int, frames: int, again: int = 0) -> Generator[TensorDict]:
        skill = self.config.skill
        self.task.draw_from(training_layouts(self.config, *place_of(again, steps)))
        per_batch = frames_of_batch(skill.num_envs, frames)
        collector = Collector(
            self._env,
            self.policy,
            frames_per_batch=per_batch,
            total_frames=-1,  # one that comes to an end closes the simulations, which the next segment needs
            init_random_frames=random_batches(self.config, steps, per_batch) * per_batch,
            auto_register_policy_transforms=False,
        )
        try:
            for data in islice(collector, whole_batches(frames, per_batch)):
                yield data.reshape(-1)
        finally:
            collector.shutdown(close_env=False)

    def close(self) -> None:
        self.task.sim.close()


def make_batches(config: TrainConfig, policy: ProbabilisticActor, planner: Planner | None = None) -> Batches:
    """The source of batches that `skill.collector` names; nothing is started before its first segment."""
    if config.skill.collector == "local":
        return LocalBatches(config, policy, planner)
    from hiernav.skill.workers import WorkerBatches

    return WorkerBatches(config, policy, planner)


def frames_of_batch(num_envs: int, frames: int) -> int:
    """Steps of a batch of `num_envs` simulations, where `frames` steps are wanted in all."""
    return num_envs * max(1, min(_BATCH_FRAMES, frames) // num_envs)


def whole_batches(frames: int, per_batch: int) -> int:
    """Batches of a segment of at least so many frames: it ends past the evaluation that is due, not just before."""
    return -(-frames // per_batch)


def segment_frames(skill: SkillConfig, steps: int) -> int:
    """Steps wanted of the segment that begins after so many, summed over the simulations of all workers.

    The last one takes with it what would be too little for another.
    """
    least = _SEGMENT_STEPS * skill.num_envs * (1 if skill.collector == "local" else skill.workers)
    frames, left = max(skill.checkpoint_every_steps, least), skill.total_steps - steps
    return left if left < frames + least else frames


def random_batches(config: TrainConfig, steps: int, frames: int) -> int:
    """How many batches of `frames` are still to be collected with random actions, after `steps`."""
    return -(-max(0, config.skill.learning_starts - steps) // frames)


def place_of(again: int, *place: int) -> tuple[int, ...]:
    """A place in the run, whose first try is named as if there were no other."""
    return (*place, again) if again else place


def training_layouts(config: TrainConfig, steps: int, *place: int) -> RandomLayouts:
    """The worlds of a segment that begins after so many steps: a stream for every place, none like another."""
    worlds = training_worlds(config.skill, steps)
    return RandomLayouts(worlds, (config.seed, 2, steps, *place), get_robot(config.robot).radius)


def training_worlds(skill: SkillConfig, steps: int) -> list[WorldSpec]:
    """Worlds that episodes are drawn from after so many steps: the first one, and one more at a time."""
    worlds, ramp = [parse_world(text) for text in skill.worlds], skill.phase_in * skill.total_steps
    return worlds if steps >= ramp else worlds[: 1 + int(steps / ramp * (len(worlds) - 1))]
