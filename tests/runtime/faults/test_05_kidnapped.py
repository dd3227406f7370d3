"""A robot that is carried away: the filter starts again, and plans made before are void."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runtime_motion import estimator_for, frames, recorded

from hiernav.runtime.robot import SensorFrame

AWAY = np.array([3.0, -2.0])


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
def test_a_carried_away_robot_finds_itself_after_ten_rejected_fixes_and_says_so(robot):
    motion = recorded(robot)

    def carry(frame: SensorFrame) -> SensorFrame:
        if frame.stamp < 1.0 or frame.position_fix is None:
            return frame
        return replace(frame, position_fix=frame.position_fix + AWAY)

    estimator = estimator_for(motion)
    restarts = []
    for k, frame in enumerate(frames(motion)):
        estimate = estimator.update(carry(frame))
        assert estimate is not None
        restarts.append(estimate.restarts)
        away = np.linalg.norm(estimate.pose[:2] - motion.poses[k, :2] - (AWAY if estimate.restarts else 0.0))
        assert away < 0.3
    assert restarts[0] == 0 and restarts[-1] == 1
    begun = motion.stamps[restarts.index(1)]
    assert 1.0 + 9 * 0.08 <= begun <= 1.0 + 10 * 0.1 + 0.1
    assert estimator.counts["position_fix_rejected"] == 10
