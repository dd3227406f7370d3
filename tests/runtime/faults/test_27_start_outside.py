"""A start outside the map or inside an obstacle: a clear code, and no motion; one that is merely tight is left."""

from __future__ import annotations

import numpy as np
import pytest
from puck import Puck, driver_of, map_with, pilot_for

from hiernav.nav.planners import ShortestPathPlanner

GOAL = np.array([-1.0, 0.0])


def drive(position):
    occupancy = map_with((1.0, 0.0, 0.3, 0.3))
    robot = Puck(control_period=0.02, noise=1e-3, position=np.array(position))
    pilot = pilot_for(ShortestPathPlanner(), period=0.02)
    return robot, driver_of(robot, pilot, occupancy=lambda stamp: occupancy).run(GOAL, max_steps=1000)


@pytest.mark.parametrize(
    ("position", "code"),
    [([3.0, 0.0], "start_outside"), ([0.0, -2.2], "start_outside"), ([1.0, 0.0], "start_occupied")],
)
def test_it_is_refused_by_code_and_nothing_moves(position, code):
    robot, result = drive(position)
    assert result.reason == code and result.refused and result.steps == 0
    assert f"({position[0]:g}" in result.detail or f"({position[0]:.1f}"[:3] in result.detail
    assert not robot.sent


def test_a_robot_closer_to_an_obstacle_than_its_radius_may_leave():
    robot, result = drive([0.64, 0.0])
    assert result.reached and robot.position[0] < -0.6
