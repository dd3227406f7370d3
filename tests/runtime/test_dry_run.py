"""What a dry run finds wrong with a robot before anything moves."""

from __future__ import annotations

import numpy as np
import pytest
from puck import Puck
from recorded_drive import BUNDLE

from hiernav.nav.bundle import load_bundle
from hiernav.runtime import dry_run
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.settings import Settings


@pytest.mark.parametrize(
    ("readings", "error"),
    [
        ({}, None),
        ({"position_fix": np.zeros(3)}, "position_fix has 3 values, 2 are expected"),
        ({"gyro": np.zeros(1), "lidar": np.zeros(360)}, "gyro has 1 values, 3 are expected, lidar has 360"),
        ({"rotation": np.zeros(9)}, "rotation has 9 values, 4 are expected"),
        ({"extra": {"joint_sin": np.zeros(12)}}, None),
    ],
)  # fmt: skip
def test_a_sensor_of_another_size_is_an_error_that_names_it(monkeypatch, readings, error):
    monkeypatch.setattr(dry_run, "WAKES", 1)
    robot = Puck(
        control_period=0.02, sees=lambda frame: SensorFrame(frame.stamp, **{"lidar": np.zeros(10), **readings})
    )
    robot.realtime = {}
    found = dry_run.report(lambda: load_bundle(BUNDLE), lambda: robot, Settings())["robot"]
    assert found["control period"] == "20 ms"
    assert ("error" in found) == (error is not None) and (error or "") in found.get("error", "")
