"""Stamps that repeat themselves, go backwards, jump ahead, start again or are no numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from puck import GOAL, Listener, Puck, Scripted, driver_of, map_with, pilot_for
from runtime_motion import estimator_for, frames, recorded

from hiernav.nav.planners import StraightPlanner
from hiernav.runtime.estimate import Estimate, Trust
from hiernav.runtime.pilot import Decision
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode

MOTION = recorded("point")
STREAM = list(frames(MOTION))
AT = 60
"""Frame with which the stamps go wrong."""


def moved(frame: SensorFrame, seconds: float) -> SensorFrame:
    """The frame as of a clock that is ahead by `seconds`."""
    fix_stamp = None if frame.fix_stamp is None else frame.fix_stamp + seconds
    return replace(frame, stamp=frame.stamp + seconds, fix_stamp=fix_stamp)


def same(one: Estimate | None, other: Estimate | None) -> bool:
    if one is None or other is None:
        return one is other
    parts = ("stamp", "pose", "velocity", "covariance")
    return all(np.array_equal(getattr(one, part), getattr(other, part)) for part in parts)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 199), st.integers(0, 199)), max_size=40))
def test_frames_from_the_past_mixed_in_change_nothing(insertions):
    late = {at: earlier for at, earlier in insertions if earlier < at}
    clean, disturbed = estimator_for(MOTION), estimator_for(MOTION)
    for k, frame in enumerate(STREAM):
        expected = clean.update(frame)
        estimate = disturbed.update(frame)
        if k in late:
            estimate = disturbed.update(STREAM[late[k]])
        assert expected is not None and estimate is not None
        np.testing.assert_array_equal(estimate.pose, expected.pose)
        np.testing.assert_array_equal(estimate.covariance, expected.covariance)
        assert estimate.stamp == frame.stamp
    assert disturbed.counts["stale_frame"] == len(late)


@pytest.mark.parametrize("stamp", [math.nan, math.inf, -math.inf, -5.0, 0.5, 4.0, 1e9])
def test_a_stamp_that_makes_no_sense_drops_its_frame(stamp):
    estimator = estimator_for(MOTION)
    for frame in STREAM[:60]:
        before = estimator.update(frame)
    after = estimator.update(replace(STREAM[60], stamp=stamp))
    assert before is not None and after is not None
    assert after.stamp == before.stamp
    np.testing.assert_array_equal(after.pose, before.pose)


@pytest.mark.parametrize("ahead", [1.5, 1e9])
def test_one_stamp_far_ahead_costs_its_frame_alone(ahead):
    estimator, reference = estimator_for(MOTION), estimator_for(MOTION)
    for k, frame in enumerate(STREAM):
        if k in (AT, AT + 2):
            estimator.update(replace(frame, stamp=frame.stamp + ahead))
        else:
            assert same(estimator.update(frame), reference.update(frame))
    assert estimator.counts["stale_frame"] == 2
    assert not estimator.counts["gap"] and not estimator.counts["clock_restart"]


@pytest.mark.parametrize("again", [1, 2])
@pytest.mark.parametrize(
    ("seconds", "dropped", "count"),
    [(100.0, 1, "gap"), (-STREAM[AT].stamp, 9, "clock_restart"), (-1e9, 9, "clock_restart")],
)
def test_a_clock_that_is_another_from_now_on_is_gone_on_from_as_if_new(seconds, dropped, count, again):
    """`again`: how often each frame is read, by a loop that is faster than the robot."""
    estimator, fresh = estimator_for(MOTION), estimator_for(MOTION)
    for frame in STREAM[:AT]:
        before = estimator.update(frame)
    later = [moved(frame, seconds) for frame in STREAM[AT:]]
    for frame in later[:dropped]:
        for _ in range(again):
            assert same(estimator.update(frame), before)
    after = None
    for frame in later[dropped:]:
        for _ in range(again):
            after = estimator.update(frame)
        assert same(after, fresh.update(frame))
    assert after is not None and after.restarts > before.restarts
    assert estimator.counts[count] == 1


def test_stamps_that_do_not_follow_each_other_are_no_clock():
    estimator = estimator_for(MOTION)
    for frame in STREAM[:AT]:
        before = estimator.update(frame)
    backwards = [replace(frame, stamp=frame.stamp - 9.0) for frame in reversed(STREAM)]
    stuck = [replace(STREAM[AT], stamp=7.0)] * 100
    scattered = [replace(STREAM[AT], stamp=10.0 * k) for k in range(1, 100)]
    for frame in backwards + stuck + scattered:
        assert same(estimator.update(frame), before)
    assert same(estimator.update(STREAM[AT]), estimator.update(STREAM[AT])) and estimator.counts["clock_restart"] == 0


@pytest.mark.parametrize("seconds", [100.0, -1e9])
def test_a_sensor_that_is_silent_when_the_clock_starts_again_is_missed(seconds):
    estimator = estimator_for(MOTION)
    for frame in STREAM[:AT]:
        estimator.update(frame)
    for frame in STREAM[AT:]:
        estimate = estimator.update(replace(moved(frame, seconds), gyro=None))
    assert estimate is not None and estimate.trust is Trust.LOST and estimate.why.startswith("gyro")


def drive(stamp_at, every: int) -> tuple[Listener, Scripted, object]:
    """A drive in which the frame of each stamp gets another, and only some bring a fix."""
    reads = iter(range(10**9))

    def sees(frame: SensorFrame) -> SensorFrame:
        fix = frame.position_fix if next(reads) % every == 0 else None
        return replace(frame, stamp=stamp_at(frame.stamp), position_fix=fix)

    seen, pilot = Listener(), Scripted()
    driver = driver_of(Puck(control_period=0.02, noise=1e-3, sees=sees), pilot, observers=[seen])
    return seen, pilot, driver.run(GOAL)


def test_a_robot_drives_through_one_stamp_far_ahead():
    _, pilot, result = drive(lambda stamp: 1e9 if abs(stamp - 0.6) < 1e-6 else stamp, every=1)
    assert result.reached and not result.holds and pilot.calls == []
    assert result.estimator["stale_frame"] == 1


@pytest.mark.parametrize("every", [1, 7])
def test_a_robot_whose_clock_starts_again_measures_its_position_anew_and_drives_on_with_another_plan(every):
    seen, pilot, result = drive(lambda stamp: stamp + 50.0 if stamp < 0.6 else stamp - 0.6, every)
    assert result.reached and result.estimator["clock_restart"] == 1
    assert pilot.calls == ["drop"]
    assert result.holds == ({"position and heading are unknown": 1} if every > 1 else {})
    blind = [record for record in seen.records if record.estimate is None]
    assert all(record.sent is None for record in blind) and bool(blind) == (every > 1)
    again = next(record for record in seen.records if record.estimate is not None and record.estimate.restarts > 1)
    assert again.frame.position_fix is not None
    assert np.allclose(again.estimate.pose[:2], again.frame.position_fix, atol=1e-6)


def test_a_plan_from_before_the_clock_started_again_is_not_followed():
    """It is asked for while the robot is armed, and comes once the robot knows where it is now."""

    def sees(frame: SensorFrame) -> SensorFrame:
        if frame.stamp < 0.1:
            return moved(frame, 50.0)
        return moved(frame if frame.stamp > 0.35 else replace(frame, position_fix=None), -0.1)

    seen, robot = Listener(), Puck(control_period=0.02, noise=1e-3, sees=sees)
    pilot = pilot_for(StraightPlanner(), 0.5, period=0.02)
    assert driver_of(robot, pilot, observers=[seen]).run(GOAL).reached
    assert all(record.plan_age >= 0.0 for record in seen.records if record.mode is Mode.RUNNING)


def test_a_plan_that_comes_from_the_future_is_not_adopted():
    pilot = pilot_for(StraightPlanner(), 0.05)

    def act(now: float, stamp: float) -> Decision:
        estimate = Estimate(stamp, np.zeros(3), np.zeros(2), np.eye(6), upright=1.0, yaw_rate=0.0)
        return pilot.act(now, estimate, {}, GOAL, map_with())

    act(0.0, 50.0)
    assert not act(0.1, 0.1).replanned and pilot.late == 1
    assert act(0.2, 0.2).replanned


def test_a_fault_from_a_clock_that_starts_again_can_be_acknowledged():
    """At 10 Hz the frames that must agree take longer than a robot may go without a new one."""
    robot = Puck(noise=1e-3, sees=lambda frame: moved(frame, 50.0 if frame.stamp < 0.95 else -0.95))
    seen = Listener()
    driver = driver_of(robot, observers=[seen])
    inner = driver._step

    def step(now: float) -> None:
        tick = round(10.0 * now)
        if tick in (0, 31):
            driver.set_goal(GOAL)
        if tick == 30:
            assert driver.supervisor.fault.startswith("no new sensor frame for 0.8")
            driver.acknowledge()
        inner(now)
        if tick == 60:
            driver.quit()

    driver._step = step
    driver.serve()
    assert driver.last_result.reached
    assert [event.values["reason"] for event in seen.events if event.kind == "end"] == ["fault", "goal"]
