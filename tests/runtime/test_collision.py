from __future__ import annotations

import math

import pytest

from hiernav.nav.occupancy import OccupancyMap
from hiernav.runtime.collision import time_to_collision
from tests.runtime.puck import map_with

RADIUS, HORIZON = 0.1, 2.0
WALL = map_with((1.5, 0.0, 0.5, 1.9))
"""Its near face lies at x = 1."""


def ttc(occupancy: OccupancyMap, x: float, vx: float, y: float = 0.0) -> float:
    return time_to_collision(occupancy, (x, y), (vx, 0.0), RADIUS, HORIZON)


@pytest.mark.parametrize("speed", [0.3, 1.0, 1.5])
@pytest.mark.parametrize("x", [-0.31, 0.02, 0.4, 0.77])
def test_a_wall_ahead_is_met_when_the_disc_touches_it(x: float, speed: float):
    room = 1.0 - RADIUS - x
    if room < speed * HORIZON:
        # never later than it is, and earlier by a pixel at most
        assert room - 0.05 <= speed * ttc(WALL, x, speed) <= room + 1e-6
    else:
        assert math.isinf(ttc(WALL, x, speed))


def test_a_robot_that_touches_may_get_away_but_not_nearer():
    assert math.isinf(ttc(WALL, 0.93, -0.5))
    assert ttc(WALL, 0.93, 0.5) <= 0.1


def test_what_comes_after_an_obstacle_that_was_left_counts():
    between = map_with((-1.5, 0.0, 0.5, 1.9), (0.7, 0.0, 0.2, 1.9))
    assert 0.0 < ttc(between, -0.95, 1.0) <= 0.5 - RADIUS + 0.95 + 1e-6


def test_a_robot_that_stands_meets_nothing():
    assert math.isinf(ttc(WALL, 0.85, 0.0))
