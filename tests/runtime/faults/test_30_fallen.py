"""A robot that has fallen: a fault in the third tick, and none of its actuators is driven any more."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from puck import GOAL, Listener, Puck, Scripted, driver_of

from hiernav.runtime.estimator import Estimator, EstimatorConfig
from hiernav.runtime.guard import Guard, GuardConfig
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode

PERIOD, LIMIT = 0.02, math.radians(75)


def drive(degrees: float):
    """A robot that rolls over at 0.5 s at 300 degrees a second, and lies there."""

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

    robot, seen = Puck(control_period=PERIOD, noise=1e-3, sees=sees), Listener()
    pilot = Scripted(lambda step, straight: 0.2 * straight)
    guard = Guard(2, GuardConfig(tilt_limit=LIMIT))
    driver = driver_of(robot, pilot, estimator=Estimator(EstimatorConfig()), guard=guard, observers=[seen])
    return robot, seen, driver.run(GOAL, max_steps=400)


@pytest.mark.parametrize("degrees", [90.0, 120.0, 180.0])
def test_a_fallen_robot_is_a_fault_and_stays_braked(degrees):
    robot, seen, result = drive(degrees)
    assert result.reason == "fault" and "tilted by" in result.fault and "the limit is 75" in result.fault
    assert seen.records[-1].mode is Mode.FAULT and seen.records[-1].sent is None
    down = [record for record in seen.records if record.estimate.upright < math.cos(LIMIT)]
    assert len(down) == 3


def test_a_robot_that_merely_leans_goes_on():
    _, _, result = drive(50.0)
    assert result.reached or result.reason == "timeout"
    assert result.fault is None
