"""An obstacle moves onto the path: the robot slows down, plans anew, stops with a margin, and goes on when it can."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from puck import Listener, Puck, driver_of, map_with, pilot_for
from shipped import ROOT

from hiernav.nav.planners import ShortestPathPlanner, StraightPlanner, VerifiedPlanner
from hiernav.runtime.collision import time_to_collision
from hiernav.runtime.guard import Guard, GuardConfig
from hiernav.runtime.noise import EXACT
from hiernav.runtime.settings import load_settings
from hiernav.runtime.sim_robot import SimRobot
from hiernav.runtime.supervisor import Mode
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.worlds import sample_layout

PERIOD, GOAL = 0.02, np.array([1.5, 0.0])
OPEN = map_with()
PILLAR = map_with((0.8, 0.0, 0.15, 0.15))
GATE = map_with((0.8, 0.0, 0.15, 2.0))


def drive(blocked, begins: float, ends: float):
    seen, robot = Listener(), Puck(control_period=PERIOD, noise=1e-3, position=np.array([-1.0, 0.0]))
    pilot = pilot_for(VerifiedPlanner(StraightPlanner(), ShortestPathPlanner(), 0.1), period=PERIOD)
    driver = driver_of(
        robot,
        pilot,
        occupancy=lambda stamp: blocked if begins <= stamp < ends else OPEN,
        observers=[seen],
        guard=Guard(2, GuardConfig(slow_ttc=1.0)),
    )
    return seen, robot, driver.run(GOAL, max_steps=3000)


def clearances(seen: Listener, blocked) -> np.ndarray:
    there = [record for record in seen.records if record.occupancy is blocked]
    return blocked.clearance_at(np.array([record.estimate.pose[:2] for record in there]))


def test_an_obstacle_with_a_way_around_is_driven_around():
    seen, robot, result = drive(PILLAR, 1.5, 1e9)
    assert result.reached and not result.holds
    assert result.replans["invalid"] >= 1
    assert clearances(seen, PILLAR).min() > 0.08


def test_a_closed_way_is_waited_at_with_a_margin_and_driven_on_when_it_opens():
    seen, robot, result = drive(GATE, 1.5, 5.5)
    assert result.reached and result.holds == {"no way to the goal": 1}
    assert clearances(seen, GATE).min() > 0.1
    held = [record for record in seen.records if record.mode is Mode.HOLD]
    assert held and all(record.sent is None for record in held)
    assert 5.4 < held[-1].time < 5.6


def test_a_way_that_stays_closed_is_given_up():
    _, robot, result = drive(GATE, 1.5, 1e9)
    assert (result.reason, result.stopped) == ("unreachable", True)


def test_just_before_an_obstacle_the_robot_is_slowed_down_in_proportion():
    seen, _, result = drive(map_with((0.8, 0.0, 0.15, 2.0)), 2.9, 6.0)
    slowed = [record.speed_scale for record in seen.records if record.speed_scale < 1.0]
    assert slowed and min(slowed) < 0.8 and result.guard["slowed"] == len(slowed)


@pytest.mark.parametrize(("name", "heading", "share"), [("point", 0.5 * np.pi, 0.5), ("car", np.pi, 0.5)])
def test_a_robot_that_is_driven_at_a_wall_meets_it_slowly(name, heading, share):
    """Whatever the policy wants: full speed ahead, with the settings that ship and without."""
    wall = map_with((0.0, 1.3, 2.9, 0.3), half=3.0)
    open_field = sample_layout(parse_world("pillar(3,3,1)"), seed=1)
    layout = replace(open_field, pillars=np.array([[2.8, -2.8]]), start=np.array([0.0, -1.5, heading]))
    settings = load_settings([ROOT / "deploy" / f"{name}.yaml"]).guard

    def speed_at_the_wall(config: GuardConfig) -> float:
        robot, guard = SimRobot(get_robot(name), layout, EXACT), Guard(2, config)
        action = np.array([1.0, 0.0 if name == "point" else 1.0])
        while True:
            truth = robot.truth()
            (x, y, yaw), (vx, vy) = truth.pose.tolist(), truth.velocity.tolist()
            if y + robot.spec.radius >= 1.0:
                return math.hypot(vx, vy)
            ttc = time_to_collision(wall, (x, y), (vx, vy), robot.spec.radius, settings.slow_ttc)
            body = (math.cos(yaw) * vx + math.sin(yaw) * vy, math.cos(yaw) * vy - math.sin(yaw) * vx)
            robot.send(guard.check(action, ttc=ttc, velocity=body).action)

    assert speed_at_the_wall(settings) < share * speed_at_the_wall(replace(settings, slow_ttc=None))
