"""A plan with NaN or outside the map is not followed, whoever made it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from puck import GOAL, Listener, Puck, driver_of, pilot_for

from hiernav.nav.option import PlanQuery
from hiernav.nav.planners import StraightPlanner


class Spoilt:
    """Straight plans, every second of which has `value` as the x of one waypoint."""

    def __init__(self, value: float) -> None:
        self.value, self.calls = value, 0

    def plan(self, query: PlanQuery) -> np.ndarray:
        plans = StraightPlanner().plan(query)
        self.calls += 1
        if self.calls % 2:
            plans[:, 4, 0] = self.value
        return plans


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 2.5, -9.0, 1e300])
@pytest.mark.parametrize("delay", [None, 0.02])
def test_it_is_rejected_counted_and_asked_for_again(value, delay):
    robot, seen = Puck(noise=1e-3, control_period=0.02), Listener()
    pilot = pilot_for(Spoilt(value), delay, period=0.02)
    result = driver_of(robot, pilot, observers=[seen]).run(GOAL)
    assert result.reached
    assert result.planner["rejected"] == pilot.rejected > 0
    plans = [record.plan for record in seen.records if record.sent is not None]
    assert plans and all(np.isfinite(plan).all() and (np.abs(plan) <= 2.0).all() for plan in plans)
    assert all(np.isfinite(action).all() for action in robot.sent)


def test_nothing_but_unsound_plans_never_move_the_robot():
    robot = Puck(noise=1e-3, control_period=0.02)

    class Never(Spoilt):
        def plan(self, query: PlanQuery) -> np.ndarray:
            self.calls = 0
            return super().plan(query)

    result = driver_of(robot, pilot_for(Never(math.nan), period=0.02)).run(GOAL)
    assert result.reason == "unreachable" and not robot.sent
