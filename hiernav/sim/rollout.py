"""Episodes driven to their end: every layout of a list once, however long each one takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hiernav.nav.agent import Skill
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.path import arc_lengths
from hiernav.nav.recovery import Recovery
from hiernav.nav.search import PathField
from hiernav.nav.termination import TerminationReason
from hiernav.sim.layout import Layout
from hiernav.sim.task import NavigationTask, TaskStep


@dataclass
class Episode:
    """What became of one episode."""

    seed: int
    reached: bool
    reason: str
    """"goal", "left_field", "timeout", "fallen" (a timeout, on its back) or "physics"."""
    steps: int
    cap: int
    collisions: int
    """Control steps with a contact."""
    return_: float
    path_length: float
    """Driven [m]."""
    shortest_length: float
    """Of the shortest path for a disc of the robot's radius, up to the goal's radius [m]."""
    replans: dict[str, int]
    refused: int
    recoveries: int
    """Times the robot stood still and was given a way out."""

    @property
    def steps_counted(self) -> int:
        """Steps to the goal; a failure counts as the cap (paper section V)."""
        return self.steps if self.reached else self.cap

    @property
    def spl(self) -> float:
        """Success weighted by path length (Anderson et al. 2018)."""
        if not self.reached:
            return 0.0
        return self.shortest_length / max(self.path_length, self.shortest_length, 1e-9)


def run_episodes(
    task: NavigationTask,
    skill: Skill,
    layouts: Sequence[Layout],
    on_episode: Callable[[int, Episode], None] | None = None,
    on_step: Callable[[TaskStep], None] | None = None,
    recover: bool = True,
) -> list[Episode]:
    """Drive every layout to its end, `task.num_rows` at a time; results in the order of the layouts.

    A free row takes the next layout, and the run ends when the last one is done, so short episodes are not favoured.

    Args:
        skill: observations (N, D) -> actions (N, A).
        on_episode: called with the index of the layout and the episode, in the order in which they end.
        on_step: called after every control step, before `on_episode` and before rows that ended start anew.
        recover: whether a robot that stands still gets a way out, as it does when deployed (`Recovery`).
    """
    if not layouts:
        return []
    results: list[Episode | None] = [None] * len(layouts)
    rows = min(task.num_rows, len(layouts))
    current = np.full(task.num_rows, -1)
    current[:rows] = np.arange(rows)
    waiting = rows
    guided = "goal" not in task.layout.names
    task.recovery = (
        Recovery(task.num_rows, task.robot.control_period, task.robot.radius) if recover and guided else None
    )
    # rows without an episode of their own repeat one and are not looked at
    task.reset(layouts=[layouts[row % rows] for row in range(task.num_rows)])
    driven, earned = (np.zeros(task.num_rows) for _ in range(2))
    collisions = np.zeros(task.num_rows, dtype=np.int64)
    while (current >= 0).any():
        idle = current < 0
        task.goal[idle] = task.pose[idle, :2]  # where it is: a robot at its goal asks for no plans
        before = task.pose[:, :2]
        step = task.step(skill(task.observation))
        driven += np.linalg.norm(task.pose[:, :2] - before, axis=-1)
        earned += step.reward
        collisions += step.collided
        if on_step is not None:
            on_step(step)
        ended = np.flatnonzero((step.terminated | step.truncated) & (current >= 0))
        if not len(ended):
            continue
        for row in ended.tolist():
            episode = _ended(task, step, row, int(collisions[row]), float(earned[row]), float(driven[row]))
            results[current[row]] = episode
            if on_episode is not None:
                on_episode(int(current[row]), episode)
        following = np.arange(waiting, min(waiting + len(ended), len(layouts)))
        waiting += len(following)
        current[ended] = -1
        current[ended[: len(following)]] = following
        again = ended[: len(following)]
        task.reset(again, [layouts[index] for index in following.tolist()])
        for values in (driven, earned, collisions):
            values[ended] = 0
    return [episode for episode in results if episode is not None]


def _ended(
    task: NavigationTask, step: TaskStep, row: int, collisions: int, return_: float, path_length: float
) -> Episode:
    """The episode of a row that ended with this step."""
    layout, counts = task.layouts[row], task.option.counts[row]
    return Episode(
        seed=layout.seed,
        reached=bool(step.reached[row]),
        reason=_reason(step, row, fallen=bool(task.sim.upright[row] < 0.0)),
        steps=int(task.steps[row]),
        cap=layout.spec.max_steps,
        collisions=collisions,
        return_=return_,
        path_length=path_length,
        shortest_length=shortest_length(layout, task.robot.radius),
        replans={r.name.lower(): int(counts[r]) for r in TerminationReason if r != TerminationReason.NONE},
        refused=int(task.option.refused[row]),
        recoveries=0 if task.recovery is None else int(task.recovery.counts[row]),
    )


def shortest_length(layout: Layout, radius: float) -> float:
    """Length [m] of the shortest path for a disc of `radius`, from the start to within the goal's radius."""
    field = PathField(layout.occupancy(0.0), layout.goal, radius)
    path = field.path_from(layout.start[:2])
    if path is None:
        return float("nan")
    return max(0.0, float(arc_lengths(field.smooth(path)[None])[0, -1]) - GOAL_RADIUS)


def _reason(step: TaskStep, row: int, fallen: bool) -> str:
    if step.broken[row]:
        return "physics"
    if step.reached[row]:
        return "goal"
    if step.left[row]:
        return "left_field"
    return "fallen" if fallen else "timeout"
