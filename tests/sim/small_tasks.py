"""Tasks in layouts put together by hand, and robots put where the answer is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scenery import layout_of

from hiernav.config import TrainConfig
from hiernav.nav.option import PlanQuery
from hiernav.sim.factory import make_task
from hiernav.sim.layout import Layout, parse_world
from hiernav.sim.task import NavigationTask, TaskStep

WORLD = parse_world("pillar(2,2,10)")


class Straight:
    """Ten waypoints 0.1 m apart along +x."""

    def plan(self, query: PlanQuery) -> np.ndarray:
        return query.position[:, None] + 0.1 * np.arange(1, 11)[:, None] * [1.0, 0.0]


class Silent:
    """A planner that finds nothing."""

    def plan(self, query: PlanQuery) -> np.ndarray:
        return np.full((len(query.position), 10, 2), np.nan)


def task_of(*layouts: Layout, config: TrainConfig | None = None, planner: object = None) -> NavigationTask:
    """A task with one row for each layout, reset to it; robots are guided along +x."""
    task = make_task(config or TrainConfig(), len(layouts), planner or Straight(), [WORLD, parse_world("gremlin")])
    task.reset(layouts=layouts)
    return task


def teleport(task: NavigationTask, *poses: ArrayLike) -> TaskStep:
    """One control step without action, before which row r is put at rest at the r-th pose."""
    for data, pose in zip(task.sim.datas, poses, strict=True):
        task.robot.place(data.qpos, np.asarray(pose, float))
        data.qvel[:] = 0.0
    return still(task)


def still(task: NavigationTask) -> TaskStep:
    return task.step(np.zeros((task.num_rows, task.robot.action_dim)))


def facing_goal(start: ArrayLike = (-1.0, 1.5, 0.0), **things: object) -> Layout:
    """The goal at (1.5, 1.5), straight ahead along +x."""
    return layout_of(start=start, **things)
