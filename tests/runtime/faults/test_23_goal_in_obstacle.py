"""A goal inside an obstacle: the nearest free point within tolerance, or a clear code."""

from __future__ import annotations

import numpy as np
import pytest
from puck import Puck, driver_of, map_with, pilot_for

from hiernav.nav.goal import GoalRefused, place_goal
from hiernav.nav.planners import ShortestPathPlanner
from hiernav.runtime.driver_config import DriverConfig


def drive(occupancy, goal, tolerance=0.3):
    robot = Puck(control_period=0.02, noise=1e-3)
    pilot = pilot_for(ShortestPathPlanner(), period=0.02)
    config = DriverConfig(goal_tolerance=tolerance, goal_radius=0.2)
    driver = driver_of(robot, pilot, occupancy=lambda stamp: occupancy, config=config)
    return robot, driver, driver.run(np.array(goal))


def test_a_goal_in_the_edge_of_an_obstacle_is_moved_to_the_nearest_free_point():
    occupancy = map_with((1.0, 0.0, 0.2, 0.2))
    placed = place_goal(occupancy, np.zeros(2), np.array([0.85, 0.0]), 0.3)
    assert not occupancy.occupied_at(placed) and np.linalg.norm(placed - [0.85, 0.0]) <= 0.1
    placed = place_goal(occupancy, np.zeros(2), np.array([0.85, 0.0]), 0.3, 0.1)
    robot, driver, result = drive(occupancy, [0.85, 0.0])
    assert result.reached and np.linalg.norm(robot.position - placed) < 0.25


def test_a_goal_is_moved_to_where_the_robot_fits_if_that_is_near_enough_else_to_a_free_point():
    occupancy, goal = map_with((1.0, 0.0, 0.2, 0.2)), np.array([0.85, 0.0])
    roomy = place_goal(occupancy, np.zeros(2), goal, 0.3, 0.1)
    assert occupancy.clearance_at(roomy) >= 0.1 and np.linalg.norm(roomy - goal) < 0.2
    free = place_goal(occupancy, np.zeros(2), goal, 0.1, 0.1)
    assert not occupancy.occupied_at(free) and np.linalg.norm(free - goal) <= 0.1
    beside = np.array([0.75, 0.0])
    assert (place_goal(occupancy, np.zeros(2), beside, 0.3, 0.1) == beside).all(), "a free goal is nobody's to move"


@pytest.mark.parametrize("x", [0.75, 0.79, 0.82, 0.85])
def test_a_goal_in_or_beside_an_obstacle_is_reached_by_a_robot_that_goes_to_the_end_of_its_plan(x):
    _, _, result = drive(map_with((1.0, 0.0, 0.2, 0.2)), [x, 0.0])
    assert result.reached


def test_a_goal_deep_inside_is_refused_by_code_and_nothing_moves():
    robot, _, result = drive(map_with((1.0, 0.0, 0.6, 0.6)), [1.0, 0.0])
    assert result.reason == "goal_occupied" and result.refused and result.steps == 0
    assert result.detail == "goal (1, 0) lies in an obstacle, and no point within 0.3 m is free"
    assert not robot.sent


@pytest.mark.parametrize("goal", [[2.5, 0.0], [0.0, -1e9]])
def test_a_goal_outside_the_map_is_refused_by_code(goal):
    robot, _, result = drive(map_with(), goal)
    assert result.reason == "goal_outside" and "x from -2 to 2, y from -2 to 2 m" in result.detail
    assert not robot.sent


def test_a_free_goal_stays_where_it_is():
    goal = np.array([0.3, 0.4])
    assert (place_goal(map_with(), np.zeros(2), goal, 0.3) == goal).all()
    with pytest.raises(GoalRefused, match="outside"):
        place_goal(map_with(), np.zeros(2), np.array([np.nan, 0.0]), 0.3)
