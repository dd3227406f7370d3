"""A skill that gives NaN or inf: the tick is braked, three in a row are a fault."""

from __future__ import annotations

import math

import numpy as np
import pytest
from puck import GOAL, Listener, Puck, Scripted, driver_of, follow, pilot_for

from hiernav.nav.planners import StraightPlanner


def spoilt(value: float, ticks: set[int]):
    calls = iter(range(10**9))

    def skill(observations: np.ndarray) -> np.ndarray:
        action = follow(observations)
        if next(calls) in ticks:
            action[0, 1] = value
        return action

    return skill


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_two_bad_actions_are_braked_and_driven_on(value):
    robot = Puck(noise=1e-3)
    result = driver_of(robot, pilot_for(StraightPlanner(), skill=spoilt(value, {3, 4}))).run(GOAL)
    assert result.reached and result.guard["non_finite"] == 2
    assert all(action.any() for action in robot.sent), "zeros need not be a robot's brake"
    moves = [entry for entry in robot.log[robot.log.index("send") :] if entry != "read"]
    assert moves[:6] == ["send"] * 3 + ["brake"] * 2 + ["send"]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_the_third_is_a_fault_in_its_own_tick(value):
    robot, seen = Puck(noise=1e-3), Listener()
    driver = driver_of(robot, pilot_for(StraightPlanner(), skill=spoilt(value, {3, 4, 5})), observers=[seen])
    result = driver.run(GOAL)
    assert result.reason == "fault" and "action not finite 3 times in a row, first in channel 1" in result.fault
    assert seen.records[-1].index == 5 and seen.records[-1].sent is None
    assert np.isfinite(robot.sent).all()


def test_a_tick_that_is_braked_long_after_a_wait_is_not_taken_for_a_robot_that_does_not_stop():
    def script(step: int, straight: np.ndarray) -> np.ndarray:
        if step in (3, 5):
            (driver.pause if step == 3 else driver.resume)()
        return 0.2 * straight * (math.nan if step == 50 else 1.0)

    driver = driver_of(Puck(noise=1e-3), Scripted(script))
    result = driver.run(GOAL)
    assert result.reached and result.guard["non_finite"] == 1 and result.holds == {"paused": 1}
    assert result.seconds > 5.0
