"""NaN, infinity or an absurd number in one channel."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from runtime_motion import FIX_SIGMA, estimator_for, follow, frames, recorded

from hiernav.runtime.estimator import Trust
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


def test_a_sensor_that_only_gives_nan_is_lost():
    motion = recorded("point")

    def damage(frame: SensorFrame) -> SensorFrame:
        return frame if frame.stamp < 1.0 else replace(frame, gyro=np.full(3, math.nan))

    errors = follow(motion, estimator_for(motion), frames(motion), damage)
    assert errors.estimates[-1].trust is Trust.LOST
    assert errors.estimates[-1].why.startswith("gyro")
