"""Obstacles that move, in what the planner is asked and in what ends a plan: where they are, and where they will be."""

from __future__ import annotations

import numpy as np
from small_tasks import Straight, facing_goal, still, task_of

from hiernav.config import load_config
from hiernav.nav.option import PlanQuery
from hiernav.nav.planners import ShortestPathPlanner, VerifiedPlanner
from hiernav.nav.prediction import AHEAD_S
from hiernav.nav.termination import TerminationReason
from hiernav.sim.task import NavigationTask

CROSSING = facing_goal(start=(-1.0, 1.5, 0.0), gremlins=[(-0.5, 1.2)])
"""The gremlin comes onto the straight way to the goal, 0.5 m ahead of the robot, and leaves it again."""


class Watching(Straight):
    """Goes straight, and keeps what it was asked with the time it was asked at."""

    def __init__(self) -> None:
        self.asked: list[tuple[float, PlanQuery]] = []
        self.task: NavigationTask | None = None

    def plan(self, query: PlanQuery) -> np.ndarray:
        self.asked.append((0.0 if self.task is None else float(self.task.sim.time[0]), query))
        return super().plan(query)


def gremlin_at(time: float) -> np.ndarray:
    return CROSSING.gremlin_positions(time)[0]


def test_every_query_shows_the_map_of_its_moment() -> None:
    planner = Watching()
    task = task_of(CROSSING, planner=planner, config=load_config(None, ["option.period=10"]))
    planner.task, task.option.predict = task, False
    for _ in range(60):
        still(task)
    assert len(planner.asked) >= 6
    for time, query in planner.asked:
        assert query.occupancy[0].occupied_at(gremlin_at(time))
        assert not query.occupancy[0].occupied_at(gremlin_at(time + np.pi))


def test_what_has_been_watched_is_shown_where_it_will_be() -> None:
    planner = Watching()
    task = task_of(CROSSING, planner=planner, config=load_config(None, ["option.period=5"]))
    planner.task = task
    for _ in range(120):
        still(task)
    known = [(time, query.occupancy[0]) for time, query in planner.asked if time > 1.0]
    assert len(known) >= 6
    for time, occupancy in known:
        ahead = [gremlin_at(time + AHEAD_S - older) for older in (0.0, 0.1)]
        assert all(occupancy.occupied_at(point) for point in ahead)
        assert not occupancy.occupied_at(gremlin_at(time))


def test_an_obstacle_that_will_come_onto_the_plan_ends_it_before_it_does() -> None:
    ended, crossing_later = [], facing_goal(start=(-1.0, 1.5, 0.0), gremlins=[(-0.5, 1.02)])
    for predict in (True, False):
        task = task_of(crossing_later)
        task.option.predict = predict
        ended.append(next(time for time, reason in reasons_of(task, 100) if reason == TerminationReason.INVALID))
    assert 0.25 < ended[1] - ended[0] < 1.0


def reasons_of(task: NavigationTask, steps: int) -> list[tuple[float, int]]:
    found = []
    for _ in range(steps):
        step = still(task)
        found.append((float(task.sim.time[0]), int(step.option.reason[0])))
    return found


def test_an_obstacle_that_comes_onto_the_plan_ends_it_in_that_step() -> None:
    task = task_of(CROSSING)
    task.option.predict = False
    ended = [time for time, reason in reasons_of(task, 100) if reason == TerminationReason.INVALID]
    assert ended
    plan = task.option.plan[0]
    assert not CROSSING.occupancy(ended[0]).is_free(plan, task.robot.radius).all()
    assert CROSSING.occupancy(ended[0] - task.robot.control_period).is_free(plan, task.robot.radius).all()
    # the first plan was free when it was made, so that only the motion can have ended it
    assert CROSSING.occupancy(0.0).is_free(plan, task.robot.radius).all() and ended[0] > 0.3


def test_in_the_paper_s_rule_it_drives_on() -> None:
    task = task_of(CROSSING, config=load_config(None, ["option.invalid=false"]))
    assert {reason for _, reason in reasons_of(task, 100)} == {TerminationReason.NONE}


def test_a_verified_planner_leads_around_where_the_obstacle_is_now() -> None:
    planner = VerifiedPlanner(Straight(), ShortestPathPlanner(0.1, 0.1), 0.1)
    task = task_of(CROSSING, planner=planner)
    task.option.predict = False
    for _ in range(100):
        still(task)
        now = CROSSING.occupancy(float(task.sim.time[0]))
        assert now.is_free(task.option.plan[0], task.robot.radius - 0.03).all()
    assert planner.tally["repairs"] > 0
