"""A robot that is carried away: the filter starts again, and plans made before are void."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runtime_motion import estimator_for, frames, recorded

from hiernav.runtime.estimate import Trust
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


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
@pytest.mark.parametrize("readings", [200, 5])
def test_a_heading_that_is_off_is_waited_for_as_long_as_it_may_yet_be_believed(robot, readings):
    """Ten readings of the quadruped take longer than it may go without one that was used."""
    motion, turn, turned = recorded(robot), np.array([[np.cos(0.8), -np.sin(0.8)], [np.sin(0.8), np.cos(0.8)]]), 0

    def damage(frame: SensorFrame) -> SensorFrame:
        nonlocal turned
        if frame.stamp < 1.0:
            return frame
        turned += 1
        if turned > readings:
            return replace(frame, magnetometer=None)
        ahead = turn @ frame.magnetometer[:2]
        return replace(frame, magnetometer=np.append(ahead, frame.magnetometer[2]))

    estimator = estimator_for(motion)
    trust = [estimator.update(damage(frame)).trust for frame in frames(motion)]
    if readings == 5:  # the rest never comes
        assert trust[-1] is Trust.LOST
        assert estimator.counts["magnetometer_reinit"] == 0
    else:
        assert Trust.LOST not in trust and trust[-1] is Trust.GOOD
        assert estimator.counts["magnetometer_reinit"] == 1
