"""A robot that has fallen: a fault in the third tick, and none of its actuators is driven any more."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from puck import GOAL, Listener, Puck, Scripted, driver_of

from hiernav.runtime.estimate import EstimatorConfig
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.guard import Guard, GuardConfig
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode

PERIOD, LIMIT = 0.02, math.radians(75)


def rolling_over(degrees: float):
    """What a robot sees that rolls over at 0.5 s at 300 degrees a second, and lies there."""

    def sees(frame: SensorFrame) -> SensorFrame:
        since = frame.stamp - 0.5
        angle = math.radians(min(max(since, 0.0) * 300.0, degrees))
        turning = 0.0 < since < degrees / 300.0
        return replace(
            frame,
            accelerometer=np.array([0.0, 9.81 * math.sin(angle), 9.81 * math.cos(angle)]),
            magnetometer=np.array([0.0, -0.5 * math.cos(angle), 0.5 * math.sin(angle)]),
            gyro=np.array([math.radians(300.0) if turning else 0.0, 0.0, 0.0]),
        )

    return sees


def drive(degrees: float):
    robot, seen = Puck(control_period=PERIOD, noise=1e-3, sees=rolling_over(degrees)), Listener()
    pilot = Scripted(lambda step, straight: 0.2 * straight)
    guard = Guard(2, GuardConfig(tilt_limit=LIMIT))
    driver = driver_of(robot, pilot, estimator=Estimator(EstimatorConfig(confirm=False)), guard=guard, observers=[seen])
    return robot, seen, driver.run(GOAL, max_steps=400)


@pytest.mark.parametrize("degrees", [90.0, 120.0, 180.0])
def test_a_fallen_robot_is_a_fault_and_stays_braked(degrees):
    robot, seen, result = drive(degrees)
    assert result.reason == "fault" and "tilted by" in result.fault and "the limit is 75" in result.fault
    assert seen.records[-1].mode is Mode.FAULT and seen.records[-1].sent is None
    down = [record for record in seen.records if record.estimate.upright < math.cos(LIMIT)]
    assert len(down) == 3 and not any(record.sent is not None and record.sent.any() for record in down)


def test_a_robot_that_merely_leans_goes_on():
    _, _, result = drive(50.0)
    assert result.reached or result.reason == "timeout"
    assert result.fault is None


@pytest.mark.parametrize("paused", [False, True])
def test_a_robot_that_falls_while_it_is_braked_is_a_fault_too(paused):
    """Whether it has no goal yet, or waits on its way to one."""
    seen, robot = Listener(), Puck(control_period=PERIOD, noise=1e-3, sees=rolling_over(180.0))
    guard = Guard(2, GuardConfig(tilt_limit=LIMIT))
    estimator = Estimator(EstimatorConfig(confirm=False))
    driver = driver_of(robot, Scripted(), estimator=estimator, guard=guard, observers=[seen])

    class Operator(Listener):
        def tick(self, record):
            if record.index == 5 and paused:
                driver.set_goal(GOAL)
            if record.index == 10 and paused:
                driver.pause()
            if record.index == 100:
                driver.quit()

    driver.audience.observers.append(Operator())
    driver.serve()
    down = [record for record in seen.records if record.estimate.upright < math.cos(LIMIT)]
    assert "tilted by" in driver.supervisor.fault
    assert [record.mode for record in down[:3]] == [Mode.HOLD if paused else Mode.READY] * 2 + [Mode.FAULT]


def test_a_robot_that_lies_there_is_not_moved_by_the_next_goal():
    guard = Guard(1, GuardConfig(tilt_limit=LIMIT))
    guard.reset()
    fallen = guard.check(np.array([1.0]), upright=-1.0)
    assert fallen.fault is None and fallen.action[0] == 0.0
    assert guard.check(np.array([1.0]), upright=1.0).action[0] == 1.0
