"""The pilot, and the agent of a bundle without one: plans of the newest goal alone."""

from __future__ import annotations

import numpy as np
from puck import PERIOD, pilot_for
from shipped import open_shipped

from hiernav.nav.occupancy import empty_map
from hiernav.nav.planners import StraightPlanner
from hiernav.runtime.estimate import Estimate
from hiernav.runtime.pilot import Decision
from hiernav.runtime.policy import make_agent

FIELD = empty_map((3.0, 3.0))


def test_a_plan_that_is_on_its_way_to_another_goal_is_not_followed():
    pilot = pilot_for(StraightPlanner(), delay=2.5 * PERIOD)

    def act(tick: int, goal: tuple[float, float]) -> Decision:
        now = tick * PERIOD
        estimate = Estimate(now, np.zeros(3), np.zeros(2), np.eye(6), upright=1.0, yaw_rate=0.0)
        return pilot.act(now, estimate, {}, np.array(goal), FIELD)

    before = [act(tick, (2.0, 0.0)) for tick in range(2)]
    after = [act(tick, (0.0, 2.0)) for tick in range(2, 8)]
    assert not any(decision.has_plan for decision in before)
    led = [decision.plan[-1].round(9).tolist() for decision in after if decision.has_plan]
    assert led == [[0.0, 1.0]] * 3
    assert [round(decision.overdue, 9) for decision in after[:3]] == [0.0, PERIOD, 2 * PERIOD]


def test_a_bundle_drives_as_many_robots_as_are_asked_for():
    bundle = open_shipped("point")
    agent = make_agent(bundle, 0.1, rows=2)
    readings = {name: np.zeros((2, size)) for name, size in bundle.layout.sensors.items()}
    goals = np.array([[2.0, 0.0], [0.0, 2.0]])
    step = agent.act(np.zeros((2, 3)), readings, goals, [FIELD] * 2)
    assert step.action.shape == (2, 2)
    assert (np.linalg.norm(goals - step.plan[:, -1], axis=1) < 1.5).all(), "each plan leads to its own goal"
