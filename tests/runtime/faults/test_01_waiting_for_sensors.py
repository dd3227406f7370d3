"""Sensors that say nothing for 50, 300 or 1000 ms: driven on, waited for, a fault."""

from __future__ import annotations

from dataclasses import replace

import pytest
from puck import GOAL, Listener, Puck, driver_of

from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode

SILENT_FROM = 0.6
SILENT = ["whole frames", "inertial sensors", "lidar"]


def drive_through_silence(seconds: float, silent: str) -> tuple[Puck, Listener, object]:
    last: list[SensorFrame] = []

    def sees(frame: SensorFrame) -> SensorFrame:
        if not SILENT_FROM <= frame.stamp < SILENT_FROM + seconds:
            last[:] = [frame]
            return frame
        if silent == "whole frames":
            return last[0]
        if silent == "lidar":
            return replace(frame, lidar=None)
        return replace(frame, velocimeter=None, gyro=None, magnetometer=None, accelerometer=None)

    robot, seen = Puck(noise=1e-3, control_period=0.02, sees=sees), Listener()
    driver = driver_of(robot, observers=[seen])
    return robot, seen, driver.run(GOAL)


@pytest.mark.parametrize("silent", SILENT)
def test_50_ms_are_bridged_by_prediction(silent):
    _, seen, result = drive_through_silence(0.05, silent)
    assert result.reached and not result.holds


@pytest.mark.parametrize("silent", SILENT)
def test_after_300_ms_the_robot_holds_and_goes_on_by_itself(silent):
    _, seen, result = drive_through_silence(0.3, silent)
    held = [record for record in seen.records if record.mode is Mode.HOLD]
    assert result.reached and sum(result.holds.values()) == 1
    assert held and all(record.sent is None for record in held)
    assert held[0].time - SILENT_FROM <= 0.3 and held[-1].time <= SILENT_FROM + 0.3 + 0.1


@pytest.mark.parametrize("silent", SILENT)
def test_1000_ms_are_a_fault(silent):
    robot, seen, result = drive_through_silence(1.0, silent)
    assert result.reason == "fault" and " for 0.8" in result.fault
    assert seen.records[-1].mode is Mode.FAULT and robot.log[-1] == "brake"
