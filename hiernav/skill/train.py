"""Training of the skill: batches from torchrl's collectors, a replay buffer on disk, and the learner.

The run is cut into segments of `segment_frames`. Each one starts from freshly drawn episodes and ends with a
checkpoint, so a resumed run repeats exactly what an uninterrupted one would have done: physics need not be saved. Two
things end that: a replay buffer that has wrapped (`Replay`), and a worker that has died, whose successors' worlds are
not those that a resumed run draws for it. A segment in which the physics broke is tried again in other worlds.
"""

from __future__ import annotations

import json
import shutil
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
import torch
from tensordict import TensorDict

from hiernav.config import SkillConfig, TrainConfig
from hiernav.device import Recorded, choose_device, random_state, restore_random_state
from hiernav.files import write_json
from hiernav.nav.mirror import mirror_of
from hiernav.nav.option import Planner
from hiernav.nav.planners import COUNTS, VerifiedPlanner
from hiernav.nav.termination import TerminationReason
from hiernav.run import PhysicsBroke, Run, RunError, TrainingDiverged
from hiernav.sim.factory import make_task, skill_layout
from hiernav.sim.layout import parse_world
from hiernav.sim.reward import TERMS
from hiernav.sim.robots import get_robot
from hiernav.sim.rollout import run_episodes
from hiernav.sim.worlds import sample_layout
from hiernav.skill.collect import make_batches, segment_frames
from hiernav.skill.env import PhysicsDiverged
from hiernav.skill.networks import Actor
from hiernav.skill.replay import HalfMirror, Replay
from hiernav.skill.sac import Learner, SacSettings

_WINDOW = 200
"""Episodes that running means are taken over."""
_EVALUATION_SEED = 0xE7A1
_COLLISION = 0.01
"""Share of an arrival that a collision costs where actors are compared."""
_LOGGED = tuple(("next", key) for key in ("terms", "reward", "reason", "collided"))
_ENDS = tuple(r for r in TerminationReason if r not in (TerminationReason.NONE, TerminationReason.START))
"""Why plans end in the course of an episode: its first one is made before any step."""


@dataclass
class Progress:
    """What a progress display may want to show."""

    steps: int
    total_steps: int
    updates: int
    steps_per_second: float
    reach_rate: float
    evaluation: float | None


@dataclass
class _Episodes:
    """Running statistics of the episodes that ended lately."""

    reached: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))

    def add(self, data: TensorDict) -> None:
        ended = data["next", "done"].squeeze(-1)
        self.reached.extend(data["next", "reached"].squeeze(-1)[ended].float().tolist())
        self.steps.extend(data["next", "episode_steps"].squeeze(-1)[ended].float().tolist())

    @property
    def reach_rate(self) -> float:
        return float(np.mean(self.reached)) if self.reached else float("nan")


def make_learner(config: TrainConfig) -> Learner:
    """An untrained learner for a configuration."""
    skill = config.skill
    settings = SacSettings(
        hidden=skill.hidden,
        discount=skill.discount,
        tau=skill.tau,
        learning_rate=skill.learning_rate,
        init_alpha=skill.init_alpha,
        alpha_floor=skill.alpha_floor,
        target_entropy=skill.target_entropy,
        actor_average=skill.actor_average,
        layer_norm=skill.layer_norm,
        precision=skill.precision,
    )
    device = choose_device(skill.device, "skill.device")
    return Learner(skill_layout(config), get_robot(config.robot).action_dim, settings, device)


def alpha_floor(skill: SkillConfig, steps: int) -> float:
    """Floor of the temperature after so many steps: falls geometrically during `alpha_fall`."""
    first, last = skill.alpha_floor, skill.alpha_floor_end
    if last is None or first == 0.0:
        return first
    begin, end = skill.alpha_fall
    share = min(max((steps / skill.total_steps - begin) / (end - begin), 0.0), 1.0)
    return first * (max(last, 1e-6) / first) ** share


def merit(evaluation: dict[str, float]) -> tuple[float, float]:
    """What makes one evaluation better than another: reach rate less a hundredth per collision, then fewer steps."""
    return evaluation["reach_rate"] - _COLLISION * evaluation["collisions_mean"], -evaluation["steps_mean"]


def kept(evaluations: Sequence[dict[str, float]], episodes: int) -> dict[str, float]:
    """The evaluation of the actor that a training leaves: the last that is not worse by more than chance explains.

    That is two standard errors of the difference in merit, of `episodes` each. Taking whichever evaluation is the
    highest would take the luckiest instead, and give away what was learned after it.
    """
    chosen = best = evaluations[0]
    for evaluation in evaluations[1:]:
        chance = 2.0 * ((_merit_variance(evaluation, episodes) + _merit_variance(best, episodes)) / episodes) ** 0.5
        if merit(evaluation)[0] >= merit(best)[0] - chance:
            chosen = evaluation
        best = max(best, evaluation, key=merit)
    return chosen


def _merit_variance(evaluation: dict[str, float], episodes: int) -> float:
    """Variance of the merit of single episodes, with one more that arrived and one more that did not: never 0."""
    rate = evaluation["reach_rate"]
    # evaluations of older runs know the variance of arrivals alone
    mean, variance = merit(evaluation)[0], evaluation.get("merit_std", (rate * (1.0 - rate)) ** 0.5) ** 2
    squares = (episodes * (variance + mean**2) + 1.0) / (episodes + 2)
    return squares - ((episodes * mean + 1.0) / (episodes + 2)) ** 2


class TorchSkill:
    """The learner's deterministic policy as a `Skill`: observations (N, D) -> actions (N, A), numpy in and out."""

    def __init__(self, actor: torch.nn.Module) -> None:
        self.actor = actor

    @torch.no_grad()
    def __call__(self, observation: np.ndarray) -> np.ndarray:
        return self.actor.mean_action(torch.from_numpy(observation)).numpy()


class SkillTrainer:
    """One training of the skill within a run folder.

    Args:
        config: what to train.
        run: to train into.
        planner: guides the robots; the expert by default.
        make: makes the learner once torch is seeded: for another loss or algorithm, such as a subclass of `Learner`
            with an `update` of its own.

    Raises:
        RunError: the run's skill is another run's or a bundle's, or there is no room for the replay.
    """

    def __init__(
        self,
        config: TrainConfig,
        run: Run,
        planner: Planner | None = None,
        make: Callable[[TrainConfig], Learner] = make_learner,
    ) -> None:
        self.config, self.run, self.planner = config, run, planner
        if (run.load("skill") or {}).get("imported"):
            raise RunError(
                f"the skill of {run.path} comes from another run or a bundle: it drives, but cannot be trained on"
            )
        self._plans = self._plan_counts()
        skill = config.skill
        seeds = np.random.SeedSequence((config.seed, 1)).generate_state(1)
        torch.manual_seed(int(seeds[0]))
        self.learner = make(config)
        self.batches = make_batches(config, self.learner.policy, planner)
        layout, self._robot = skill_layout(config), get_robot(config.robot)
        self._replay_folder = run.path / "skill" / "replay"
        self._broken_file = run.path / "skill" / "broken.json"
        with run.writing():
            self.replay = Replay(
                self._replay_folder,
                min(skill.buffer_size, skill.total_steps + self.batches.frames),
                layout.size,
                self._robot.action_dim,
                skill.batch_size,
                self.learner.device,
            )
        self._mirror = HalfMirror(mirror_of(config.robot, layout), self.learner.device) if skill.mirror else None
        self._learn = Recorded(self._learn_from, self.learner.device)
        self.steps = 0
        self.evaluations: list[dict[str, float]] = []
        self.best_actor: dict[str, torch.Tensor] | None = None
        self._due = 0.0
        self._saved: int | None = None
        self._episodes = _Episodes()

    def resume(self) -> int | None:
        """Go back to the last checkpoint; its number of steps, or None if there is none.

        Raises:
            RunError: the skill cannot be trained on: its replay is gone.
        """
        state = self.run.load("skill", rewind=True)
        if state is None:
            return None
        self.learner.load_state_dict(state["learner"])
        self.replay.load_state_dict(state["replay"])
        restore_random_state(state, self.learner.device)
        self.steps, self._due = state["steps"], state["due"]
        self._saved = self.steps
        self.evaluations, self.best_actor = state["evaluations"], state["best_actor"]
        self._episodes.reached.extend(state["reached"])
        self._episodes.steps.extend(state["episode_steps"])
        if self.replay.fresh and len(self.replay) and not self.finished:
            shutil.rmtree(self._replay_folder)  # else it would be taken for the lost one the next time
            raise RunError(
                f"{self._replay_folder} is missing, without which the skill cannot be trained on from step "
                f"{self.steps:,}: copy it from where the run was made; a finished training leaves none, so begin a new "
                "run to train for longer"
            )
        return self.steps

    @property
    def finished(self) -> bool:
        """Whether all steps are done, or an evaluation reached the rate to stop at."""
        skill = self.config.skill
        enough = skill.stop_reach_rate is not None and any(
            evaluation["reach_rate"] >= skill.stop_reach_rate for evaluation in self.evaluations
        )
        return enough or self.steps >= skill.total_steps

    def train(self, on_progress: Callable[[Progress], None] | None = None) -> None:
        """Train to the end, checkpointing on the way.

        Raises:
            TrainingDiverged: a loss, a weight or the physics is not finite.
            WorkersLost: the workers that simulate cannot be kept alive.
            RunError: the run folder cannot be written to.
        """
        with closing(self.batches):
            while not self.finished:
                self._segment(on_progress)
                if self.steps >= self._next_evaluation() or self.steps >= self.config.skill.total_steps:
                    self._evaluate()
                self._save()
        shutil.rmtree(self._replay_folder, ignore_errors=True)

    def _segment(self, on_progress: Callable[[Progress], None] | None) -> None:
        skill, began, first, updates = self.config.skill, time.perf_counter(), self.steps, self.learner.updates
        frames = segment_frames(skill, self.steps)
        window: list[TensorDict] = []
        try:
            with closing(self.batches.segment(first, frames, self._broken().get(str(first), 0))) as batches:
                for data in batches:
                    data["next", "reward"] *= skill.reward_scale
                    self._episodes.add(data)
                    window.append(data.select(*_LOGGED).reshape(-1))
                    self.replay.extend(data.reshape(-1))
                    self.steps += data.numel()
                    metrics = self._update(data.numel())
                    if on_progress is not None:
                        on_progress(self._progress((self.steps - first) / (time.perf_counter() - began)))
        except PhysicsDiverged as error:
            self._note_broken(first)
            raise PhysicsBroke(self._ending(str(error), "goes on from there in other worlds")) from error
        self.run.log("skill", self.steps, {**metrics, **self._statistics(torch.cat(window))})
        seconds = time.perf_counter() - began
        rates = {"steps_per_second": self.steps - first, "updates_per_second": self.learner.updates - updates}
        self.run.log_rates("skill", self.steps, {name: count / seconds for name, count in rates.items()})

    def _progress(self, rate: float) -> Progress:
        evaluation = self.evaluations[-1]["reach_rate"] if self.evaluations else None
        return Progress(
            steps=self.steps,
            total_steps=self.config.skill.total_steps,
            updates=self.learner.updates,
            steps_per_second=rate,
            reach_rate=self._episodes.reach_rate,
            evaluation=evaluation,
        )

    def _update(self, frames: int) -> dict[str, float]:
        skill = self.config.skill
        if self.steps <= skill.learning_starts or len(self.replay) < skill.batch_size:
            return {}
        self._due += frames * skill.updates_per_step
        self.learner.set_alpha_floor(alpha_floor(skill, self.steps))
        metrics: dict[str, torch.Tensor] = {}
        batches = int(self._due)
        for rows in self.replay.draw(batches):
            metrics = self._learn(rows)
        self._due -= batches
        self.learner.publish()
        values = {key: float(value) for key, value in metrics.items()}
        broken = [key for key, value in values.items() if not np.isfinite(value)]
        if not self.learner.finite:  # the last update of all can break them without a trace in its losses
            broken.append("weights")
        if broken:
            file = self.run.path / "config.yaml"
            what = f"{', '.join(broken)} not finite after {self.learner.updates} updates"
            raise TrainingDiverged(self._ending(what, f"repeats it, with another seed in {file} other worlds follow"))
        return values

    def _ending(self, what: str, resumed: str) -> str:
        """One line on what ended the training, and what resuming it does."""
        kept = (
            "there is no checkpoint yet" if self._saved is None else f"the last checkpoint is of step {self._saved:,}"
        )
        return (
            f"{what}; this was at step {self.steps:,} of training, and {kept}: "
            f"`hiernav train --resume {self.run.path}` {resumed}"
        )

    def _broken(self) -> dict[str, int]:
        """How often the physics broke in the segment that begins after so many steps."""
        return json.loads(self._broken_file.read_text()) if self._broken_file.exists() else {}

    def _note_broken(self, steps: int) -> None:
        times = self._broken()
        times[str(steps)] = times.get(str(steps), 0) + 1
        with self.run.writing():
            write_json(self._broken_file, times)

    def _learn_from(self, rows: torch.Tensor) -> dict[str, torch.Tensor]:
        """One update on the transitions in those rows (B,) of the replay buffer, half of them reflected on request."""
        batch = self.replay.batch(rows)
        if self._mirror is not None:
            self._mirror(batch)
        return self.learner.update(batch)

    def _statistics(self, data: TensorDict) -> dict[str, float]:
        terms = data["next", "terms"].mean(0).tolist()
        reasons = torch.bincount(data["next", "reason"].reshape(-1).long(), minlength=len(TerminationReason))
        return {
            "reach_rate": self._episodes.reach_rate,
            "episode_steps": float(np.mean(self._episodes.steps)) if self._episodes.steps else float("nan"),
            "collisions_per_step": float(data["next", "collided"].float().mean()),
            "updates": self.learner.updates,
            "reward_per_step": float(data["next", "reward"].mean()) / self.config.skill.reward_scale,
            **{f"reward/{name}": value for name, value in zip(TERMS, terms, strict=True)},
            **{f"replans/{r.name.lower()}": float(reasons[r] / reasons.sum()) for r in _ENDS},
            **self._new_plans(),
        }

    def _new_plans(self) -> dict[str, float]:
        """Proposals, repairs and refusals in training, since the last time."""
        before, self._plans = self._plans, self._plan_counts()
        return {f"plans/{name}": float(count - before[name]) for name, count in self._plans.items()}

    def _plan_counts(self) -> dict[str, int]:
        """Of a network that plans for the simulations of this process; empty where the plans are made elsewhere."""
        if self.config.skill.collector != "local" or not isinstance(self.planner, VerifiedPlanner):
            return {}
        counts = self.planner.counts()
        return {name: counts[name] for name in COUNTS}

    def _next_evaluation(self) -> float:
        every = self.config.skill.eval_every_steps
        done = self.evaluations[-1]["step"] if self.evaluations else 0
        return (done // every + 1) * every

    def _evaluate(self) -> None:
        """Reach rate of the averaged, noiseless policy on worlds that are never trained on; keeps the best actor."""
        skill = self.config.skill
        radius = self._robot.radius
        seeds = np.random.SeedSequence((self.config.seed, _EVALUATION_SEED)).generate_state(skill.eval_episodes)
        worlds = [parse_world(text) for text in skill.worlds]
        layouts = [sample_layout(worlds[i % len(worlds)], int(seed), radius) for i, seed in enumerate(seeds)]
        task = make_task(self.config, min(64, skill.eval_episodes), self.planner)
        episodes = run_episodes(task, TorchSkill(self.learner.average), layouts)
        reached, collisions = (np.array([getattr(e, name) for e in episodes]) for name in ("reached", "collisions"))
        result = {
            "step": self.steps,
            "reach_rate": float(reached.mean()),
            "steps_mean": float(np.mean([e.steps_counted for e in episodes])),
            "collisions_mean": float(collisions.mean()),
            "merit_std": float((reached - _COLLISION * collisions).std()),
            "return_mean": float(np.mean([e.return_ for e in episodes])),
        }

        self.evaluations.append(result)
        if kept(self.evaluations, skill.eval_episodes) is result:
            self.best_actor = {key: value.clone() for key, value in self.learner.average.state_dict().items()}
        self.run.log("evaluation", self.steps, {k: v for k, v in result.items() if k != "step"})
        self._plans = self._plan_counts()  # those of the evaluation are not the training's

    def _save(self) -> None:
        with self.run.writing():
            self.replay.flush()  # a checkpoint that outlives a power failure must not speak of rows that do not
        self.run.save(
            "skill",
            {
                "learner": self.learner.state_dict(),
                "replay": self.replay.state_dict(),
                **random_state(self.learner.device),
                "steps": self.steps,
                "due": self._due,
                "evaluations": self.evaluations,
                "best_actor": self.best_actor,
                "reached": list(self._episodes.reached),
                "episode_steps": list(self._episodes.steps),
            },
        )
        self._saved = self.steps


def load_actor(config: TrainConfig, state: dict) -> Actor:
    """The best actor of a skill checkpoint.

    Raises:
        RunError: the checkpoint is from before the first evaluation.
    """
    if state["best_actor"] is None:
        raise RunError("the skill has not been evaluated yet: train for longer")
    actor = Actor(skill_layout(config), get_robot(config.robot).action_dim, config.skill.hidden, layer_norm=False)
    actor.load_state_dict(state["best_actor"])
    return actor.eval()
