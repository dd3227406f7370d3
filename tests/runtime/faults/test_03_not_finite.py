"""NaN, infinity or an absurd number in one channel."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from puck import GOAL, Puck, Scripted, driver_of
from runtime_motion import FIX_SIGMA, estimator_for, follow, frames, recorded

from hiernav.runtime.estimate import Trust
from hiernav.runtime.robot import VECTOR_SENSORS, SensorFrame


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("sensor", [*VECTOR_SENSORS, "position_fix"])
@pytest.mark.parametrize(("robot", "worst"), [("car", 1.5 * FIX_SIGMA), ("doggo", 2.0 * FIX_SIGMA)])
def test_a_channel_that_is_not_finite_is_rejected_and_the_state_stays_finite(robot, worst, sensor, value):
    motion = recorded(robot)
    rng = np.random.default_rng(7)

    def damage(frame: SensorFrame) -> SensorFrame:
        reading = getattr(frame, sensor)
        if reading is None or frame.stamp == 0.0 or rng.random() > 0.3:
            return frame
        reading = reading.copy()
        reading[rng.integers(len(reading))] = value
        return replace(frame, **{sensor: reading})

    errors = follow(motion, estimator_for(motion), frames(motion), damage)
    for estimate in errors.estimates:
        assert np.isfinite(estimate.pose).all() and np.isfinite(estimate.velocity).all()
        assert np.isfinite(estimate.covariance).all() and math.isfinite(estimate.yaw_rate)
    assert errors.position_rms < worst


@pytest.mark.parametrize("begin", [0.0, 1.0])
@pytest.mark.parametrize("sensor", ["accelerometer", "gyro", "velocimeter"])
def test_a_sensor_that_only_gives_nan_is_held_for_and_lost_from_the_start_on_as_well(sensor, begin):
    motion = recorded("point")
    garbage = {sensor: np.full(3, math.nan)}

    def damage(frame: SensorFrame) -> SensorFrame:
        return frame if frame.stamp < begin else replace(frame, **garbage)

    errors = follow(motion, estimator_for(motion), frames(motion), damage)
    trust = {estimate.stamp: estimate.trust for estimate in errors.estimates}
    assert all(value is Trust.GOOD for stamp, value in trust.items() if stamp < begin + 0.2)
    assert all(value is Trust.HOLD for stamp, value in trust.items() if begin + 0.3 < stamp < begin + 0.75)
    assert all(value is Trust.LOST for stamp, value in trust.items() if stamp > begin + 0.85)
    assert errors.estimates[-1].why.startswith(sensor)


def test_a_sensor_that_gives_nan_at_first_is_trusted_once_it_measures():
    motion = recorded("point")

    def damage(frame: SensorFrame) -> SensorFrame:
        return frame if frame.stamp >= 0.5 else replace(frame, gyro=np.full(3, math.nan))

    errors = follow(motion, estimator_for(motion), frames(motion), damage)
    assert any(estimate.trust is Trust.HOLD for estimate in errors.estimates)
    assert all(estimate.trust is Trust.GOOD for estimate in errors.estimates if estimate.stamp >= 0.5)


def test_a_robot_whose_gyro_never_measures_does_not_drive_on():
    robot = Puck(control_period=0.02, noise=1e-3, sees=lambda frame: replace(frame, gyro=np.full(3, math.nan)))
    result = driver_of(robot).run(GOAL)
    assert result.reason == "fault" and result.fault.startswith("gyro says nothing usable for 0.8")
    assert robot.log[-1] == "brake"


@pytest.mark.parametrize("value", [math.nan, -math.inf, 1e30, -0.5, 1.5])
@pytest.mark.parametrize("begin", [0.0, 0.6])
def test_a_robot_whose_lidar_says_nonsense_does_not_drive_on(begin, value):
    def sees(frame: SensorFrame) -> SensorFrame:
        return frame if frame.stamp < begin else replace(frame, lidar=np.array([*[0.2] * 9, value]))

    robot, pilot = Puck(control_period=0.02, noise=1e-3, sees=sees), Scripted()
    result = driver_of(robot, pilot).run(GOAL)
    assert result.reason == "fault" and result.fault.startswith("lidar says nothing usable for 0.8")
    assert sum(result.holds.values()) == 1 and robot.log[-1] == "brake"
    assert all(0.0 <= terms["lidar"].min() and terms["lidar"].max() <= 1.0 for terms in pilot.seen)


@pytest.mark.parametrize("value", [math.nan, 1e6, -1e300])
def test_a_robot_whose_joints_say_nonsense_does_not_drive_on(value):
    def sees(frame: SensorFrame) -> SensorFrame:
        return replace(frame, extra={"joint_sin": np.array([0.5, 0.5 if frame.stamp < 0.6 else value])})

    robot, pilot = Puck(control_period=0.02, noise=1e-3, sees=sees), Scripted()
    result = driver_of(robot, pilot).run(GOAL)
    assert result.reason == "fault" and result.fault.startswith("joint_sin says nothing usable for 0.8")
    assert all((terms["joint_sin"] == 0.5).all() for terms in pilot.seen)
