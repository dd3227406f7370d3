"""Sensors that fall silent: the estimate goes on, asks to hold, and is lost, in this order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runtime_motion import estimator_for, follow, frames, recorded

from hiernav.runtime.estimate import Trust
from hiernav.runtime.robot import VECTOR_SENSORS, SensorFrame

BEGIN = 1.5


def silent(sensors, seconds):
    def damage(frame: SensorFrame) -> SensorFrame:
        if not BEGIN <= frame.stamp < BEGIN + seconds:
            return frame
        return replace(frame, **dict.fromkeys(sensors))

    return damage


@pytest.mark.parametrize("sensors", [VECTOR_SENSORS, *((name,) for name in VECTOR_SENSORS)])
@pytest.mark.parametrize(("seconds", "worst"), [(0.05, Trust.GOOD), (0.3, Trust.HOLD), (1.0, Trust.LOST)])
def test_a_dropout_is_predicted_through_then_held_then_lost(sensors, seconds, worst):
    motion = recorded("point")
    errors = follow(motion, estimator_for(motion), frames(motion), silent(sensors, seconds))
    trust = [estimate.trust for estimate in errors.estimates]
    assert max(trust) is worst
    while_silent = [each for each in errors.estimates if BEGIN <= each.stamp < BEGIN + seconds]
    assert while_silent[0].trust is Trust.GOOD
    if worst is not Trust.GOOD:
        assert any(each.why.startswith(sensors) for each in while_silent)
    # a turn that nobody measured shows in the first heading: it is believed with the tenth
    assert all(each.trust is Trust.GOOD for each in errors.estimates if each.stamp > BEGIN + seconds + 0.19)
    assert np.isfinite([each.pose for each in errors.estimates]).all()


def test_a_robot_without_a_sensor_is_not_said_to_have_lost_it():
    motion = recorded("point")
    errors = follow(motion, estimator_for(motion), frames(motion), lambda frame: replace(frame, accelerometer=None))
    assert all(estimate.trust is Trust.GOOD for estimate in errors.estimates)


def test_dead_reckoning_without_a_position_fix_is_trusted_for_two_seconds():
    motion = recorded("point")
    errors = follow(motion, estimator_for(motion), frames(motion), silent(["position_fix", "fix_stamp"], 99.0))
    first = next(each.stamp for each in errors.estimates if each.trust is Trust.HOLD)
    assert BEGIN + 1.8 < first < BEGIN + 2.05
    assert errors.position[-1] < 0.3


@pytest.mark.parametrize("term", ["lidar", "joint_sin"])
@pytest.mark.parametrize(("seconds", "worst"), [(0.05, Trust.GOOD), (0.3, Trust.HOLD), (1.0, Trust.LOST)])
def test_lidar_and_joints_that_the_skill_alone_needs_are_held_for_and_lost_too(term, seconds, worst):
    motion = recorded("point")

    def damage(frame: SensorFrame) -> SensorFrame:
        terms = {"lidar": np.full(10, 0.5), "joint_sin": np.full(12, -0.5)}
        if BEGIN <= frame.stamp < BEGIN + seconds:
            del terms[term]
        return replace(frame, lidar=terms.pop("lidar", None), extra=terms)

    errors = follow(motion, estimator_for(motion), frames(motion), damage)
    assert max(estimate.trust for estimate in errors.estimates) is worst
    assert all(each.trust is Trust.GOOD for each in errors.estimates if not 0.0 <= each.stamp - BEGIN < seconds + 0.05)
    assert all(each.why.startswith(term) for each in errors.estimates if each.trust is not Trust.GOOD)


def test_a_lidar_that_reads_the_same_is_that_of_a_robot_that_stands():
    motion = recorded("point")
    errors = follow(motion, estimator_for(motion), frames(motion), lambda frame: replace(frame, lidar=np.full(10, 0.5)))
    assert all(estimate.trust is Trust.GOOD for estimate in errors.estimates)
