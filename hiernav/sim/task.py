"""The navigation task: a batch of robots in sampled worlds, their options, observations and rewards.

One implementation under the TorchRL environment, the Gymnasium environment and the evaluation. The option lives in
here because the next observation must hold the waypoints of the next state, which may have been replanned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hiernav.config import RewardConfig
from hiernav.nav.agent import observe
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.lidar import lidar_closeness
from hiernav.nav.observation import ObservationLayout
from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.option import OptionStep, WaypointOption
from hiernav.nav.recovery import Recovery
from hiernav.sim.batch import BatchSim
from hiernav.sim.layout import Layout, WorldSpec, inside
from hiernav.sim.reward import reward_terms, weighted_sum
from hiernav.sim.robots import RobotSpec
from hiernav.sim.scene import scene_for

LayoutSource = Callable[[int], Layout]
"""Row -> the layout of its next episode."""


@dataclass
class TaskStep:
    """Outcome of one control step; new arrays every time."""

    observation: np.ndarray
    """(N, D) float32 of the state after the step."""
    reward: np.ndarray
    """(N,)"""
    terms: dict[str, np.ndarray]
    """Unweighted reward terms, (N,) each."""
    reached: np.ndarray
    """(N,) bool: goal within 0.3 m."""
    left: np.ndarray
    """(N,) bool: centre outside the field."""
    truncated: np.ndarray
    """(N,) bool: cap on steps reached."""
    collided: np.ndarray
    """(N,) bool: contact with an obstacle during the step."""
    fallen: np.ndarray
    """(N,) bool: the episode ends because the robot has turned over."""
    broken: np.ndarray
    """(N,) bool: the physics is no longer finite."""
    option: OptionStep
    plan: np.ndarray
    """(N, K, 2) what the skill follows, world frame [m]: the option's plan, or a way out (`Recovery`)."""

    @property
    def terminated(self) -> np.ndarray:
        """(N,) bool: the episode has ended for good (goal, field left, fallen, broken)."""
        return self.reached | self.left | self.fallen | self.broken


class NavigationTask:
    """N robots, each with a world, a goal and an option.

    Args:
        robot: which robot.
        worlds: every kind of world that `layouts` may draw; the scene gets enough obstacle slots for any of them.
        layouts: draws the layout of a row's next episode.
        option: plans for the N rows; its planner is what guides the robots.
        layout: of the observation.
        reward: weights of its terms.
        threads: that step the physics.
        end_on_fall: whether an episode ends when the robot has turned over; a training aid, no protocol has it.
        max_steps: a cap on an episode's steps below that of its world, likewise.
    """

    def __init__(
        self,
        robot: RobotSpec,
        worlds: Sequence[WorldSpec],
        layouts: LayoutSource,
        option: WaypointOption,
        layout: ObservationLayout,
        reward: RewardConfig | None = None,
        threads: int = 1,
        end_on_fall: bool = False,
        max_steps: int | None = None,
    ) -> None:
        self.robot, self.layout, self.option = robot, layout, option
        self.num_rows = option.num_rows
        self.reward = reward or RewardConfig()
        self.sim = BatchSim(robot, self.num_rows, scene_for(worlds), threads)
        self.end_on_fall = end_on_fall
        self.recovery: Recovery | None = None
        """Ways out for robots that are stuck; none in training."""
        self._cap = np.iinfo(np.int64).max if max_steps is None else max_steps
        self.layout_source = layouts
        self.layouts: list[Layout] = [None] * self.num_rows  # type: ignore[list-item]
        self._maps: list[OccupancyMap] = [None] * self.num_rows  # type: ignore[list-item]
        self.goal = np.zeros((self.num_rows, 2))
        self._extent = np.zeros((self.num_rows, 4))
        self.steps = np.zeros(self.num_rows, dtype=np.int64)
        self._max_steps = np.zeros(self.num_rows, dtype=np.int64)
        self._discs = np.full((self.num_rows, 1, 3), np.nan)
        self._moving = np.zeros(self.num_rows, dtype=bool)
        self.observation = np.zeros((self.num_rows, layout.size), dtype=np.float32)
        self.plan = option.plan.copy()
        """(N, K, 2) what the skill follows, world frame [m]."""

    @property
    def pose(self) -> np.ndarray:
        """(N, 3) true pose, world frame [m, m, rad]."""
        return self.sim.pose

    def draw_from(self, layouts: LayoutSource) -> None:
        """Draw the layouts of future episodes from another source."""
        self.layout_source = layouts

    def reset(self, rows: np.ndarray | None = None, layouts: Sequence[Layout] | None = None) -> np.ndarray:
        """Start new episodes in some rows (all by default), in drawn or given layouts.

        Returns:
            (N, D) float32 observations; rows that were not reset keep theirs.
        """
        rows = np.arange(self.num_rows) if rows is None else np.asarray(rows)
        if not len(rows):
            return self.observation
        drawn = [self.layout_source(int(row)) for row in rows] if layouts is None else list(layouts)
        self.sim.reset(rows, drawn)
        for row, layout in zip(rows, drawn, strict=True):
            self.layouts[row] = layout
            self._maps[row] = layout.occupancy(0.0)
            self.goal[row], self._extent[row] = layout.goal, layout.extent
            self._max_steps[row] = min(layout.spec.max_steps, self._cap)
            self._moving[row] = len(layout.gremlins) > 0
            self._set_discs(row, layout.obstacle_discs(0.0))
        self.steps[rows] = 0
        self.option.reset(rows)
        if self.recovery is not None:
            self.recovery.reset(rows)
        self._observe(rows)
        return self.observation

    def step(self, actions: np.ndarray) -> TaskStep:
        """One control step of all rows with actions (N, A) in [-1, 1]."""
        if None in self.layouts:
            raise RuntimeError("reset every row of the task before its first step")
        before, line = self.sim.pose[:, :2], self.option.line()
        self.sim.step(actions)
        self.steps += 1
        for row in np.flatnonzero(self._moving).tolist():
            now = float(self.sim.time[row])
            self._maps[row] = self.layouts[row].occupancy(now)
            self._set_discs(row, self.layouts[row].obstacle_discs(now))
        after = self.sim.pose[:, :2]
        broken = ~self.sim.finite
        reached = np.linalg.norm(after - self.goal, axis=-1) <= GOAL_RADIUS
        left = ~inside(after, self._extent) & ~broken
        reached &= ~left
        collided = self.sim.collided
        upright = self.sim.upright
        fallen = upright < 0.0
        terms = reward_terms(self.reward, before, after, line, self.goal, collided, reached, left, upright)
        if broken.any():
            terms = {name: np.where(broken, 0.0, values) for name, values in terms.items()}
        option = self._observe(None)
        return TaskStep(
            observation=self.observation,
            reward=weighted_sum(self.reward, terms),
            terms=terms,
            reached=reached,
            left=left,
            truncated=(self.steps >= self._max_steps) & ~(reached | left | broken | (fallen & self.end_on_fall)),
            collided=collided,
            fallen=fallen & self.end_on_fall,
            broken=broken,
            option=option,
            plan=self.plan,
        )

    def _observe(self, rows: np.ndarray | None) -> OptionStep:
        """Let the options of some rows (all if None) end or go on, then observe."""
        maps = self._maps if rows is None else [self._maps[row] for row in rows]
        pick = slice(None) if rows is None else rows  # of all rows no copy is made
        pose, goal = self.sim.pose[pick], self.goal[pick]
        sensors = {name: values[pick] for name, values in self.sim.sensors.items()}
        sensors["lidar"] = lidar_closeness(pose, self._discs[pick])
        time = self.steps[pick] * self.robot.control_period
        option, plan, built = observe(
            self.option, self.recovery, self.layout, pose, sensors, goal, maps, time, self.sim.time[pick], rows
        )
        if not np.isfinite(built).all():
            built = np.nan_to_num(built)  # a broken row is reported, not passed on
        if rows is None:
            self.observation, self.plan = built, plan
        else:
            self.observation, self.plan = self.observation.copy(), self.plan.copy()
            self.observation[rows], self.plan[rows] = built, plan
        return option

    def _set_discs(self, row: int, discs: np.ndarray) -> None:
        if len(discs) > self._discs.shape[1]:
            wider = np.full((self.num_rows, len(discs), 3), np.nan)
            wider[:, : self._discs.shape[1]] = self._discs
            self._discs = wider
        self._discs[row] = np.nan
        self._discs[row, : len(discs)] = discs
