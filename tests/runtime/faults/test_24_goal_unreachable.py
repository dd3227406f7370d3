"""A goal that no way leads to, and a map that is all obstacle: a code within two seconds, and no motion."""

from __future__ import annotations

import numpy as np
import pytest
from puck import Puck, driver_of, map_with, pilot_for

from hiernav.nav.option import PlanQuery
from hiernav.nav.planners import ShortestPathPlanner, StraightPlanner


@pytest.mark.parametrize("delay", [None, 0.02])
def test_a_walled_in_goal_is_unreachable_within_two_seconds(delay):
    ring = map_with((1.0, 0.6, 0.7, 0.1), (1.0, -0.6, 0.7, 0.1), (0.4, 0.0, 0.1, 0.7), (1.6, 0.0, 0.1, 0.7))
    robot = Puck(control_period=0.02, noise=1e-3)
    pilot = pilot_for(ShortestPathPlanner(), delay, period=0.02)
    driver = driver_of(robot, pilot, occupancy=lambda stamp: ring)
    result = driver.run(np.array([1.0, 0.0]))
    assert (result.reason, result.steps, result.refused) == ("unreachable", 0, True)
    assert driver.clock.now() < 2.0 and not robot.sent


def test_where_everything_is_occupied_nothing_moves():
    full = map_with((0.0, 0.0, 3.0, 3.0))
    robot = Puck(control_period=0.02, noise=1e-3)
    driver = driver_of(robot, pilot_for(ShortestPathPlanner(), period=0.02), occupancy=lambda stamp: full)
    result = driver.run(np.array([1.0, 0.0]))
    assert result.reason == "start_occupied" and result.refused
    assert driver.clock.now() < 2.0 and not robot.sent


def test_a_robot_that_wants_another_plan_and_is_always_refused_waits_and_gives_up():
    period, asked = 0.02, []

    class Once(StraightPlanner):
        def plan(self, query: PlanQuery) -> np.ndarray:
            asked.append(query)
            return np.full((1, 10, 2), np.nan) if len(asked) > 1 else super().plan(query)

    robot, pilot = Puck(control_period=period, noise=1e-3), pilot_for(Once(), period=period)
    driver = driver_of(robot, pilot)
    inner = driver._step

    def step(now: float) -> None:
        if round(now / period) == 20:
            pilot.replan()
        inner(now)

    driver._step = step
    result = driver.run(np.array([1.5, 0.0]))
    assert result.reason == "unreachable" and result.holds == {"no way to the goal": 1}
    assert robot.position[0] < 0.5, "it has not gone on along the plan that it was to replace"
    assert len(asked) <= 1 + round(10.2 / period), "once at each step"
