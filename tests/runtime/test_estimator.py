from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from runtime_motion import FIX_SIGMA, estimator_for, follow, frames, recorded

from hiernav.runtime.estimate import EstimatorConfig, Trust
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.robot import SensorFrame

ROBOTS = ("point", "car", "doggo")


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("seed", [0, 1])
def test_position_is_better_than_one_fix_and_heading_better_than_two_degrees(robot, seed):
    motion = recorded(robot)
    errors = follow(motion, estimator_for(motion), frames(motion, seed), confirmed=False)
    assert len(errors.position) == len(motion.stamps)
    assert errors.position_rms < FIX_SIGMA
    assert errors.yaw_rms < math.radians(2.0)


@pytest.mark.parametrize("robot", ROBOTS)
def test_velocity_is_in_the_world_frame(robot):
    motion = recorded(robot)
    errors = follow(motion, estimator_for(motion), frames(motion), confirmed=False)
    velocity = np.array([estimate.velocity for estimate in errors.estimates])
    dt = motion.stamps[1]
    between = np.diff(motion.poses[:, :2], axis=0) / dt
    assert np.sqrt(np.mean((0.5 * (velocity[1:] + velocity[:-1]) - between) ** 2)) < 0.06


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_covariance_is_honest(robot):
    motion = recorded(robot)
    normalised = []
    for seed in range(5):
        errors = follow(motion, estimator_for(motion), frames(motion, seed))
        for estimate, position in zip(errors.estimates, errors.position, strict=True):
            normalised.append(position**2 / np.trace(estimate.covariance[:2, :2]))
    assert 0.3 < np.mean(normalised) < 3.0


def test_heading_is_right_while_the_body_rolls_and_pitches():
    motion = recorded("doggo")
    assert motion.upright.min() < math.cos(math.radians(40.0))
    flat = follow(motion, Estimator(EstimatorConfig(tilts=False)), frames(motion))
    compensated = follow(motion, estimator_for(motion), frames(motion), confirmed=False)
    assert np.abs(compensated.yaw).max() < math.radians(5.0)
    assert np.abs(flat.yaw).max() > 2.0 * np.abs(compensated.yaw).max()
    upright = np.array([estimate.upright for estimate in compensated.estimates])
    assert np.abs(upright - motion.upright).max() < 0.1


def test_a_repeated_frame_changes_nothing():
    motion = recorded("point")
    stream = list(frames(motion))
    once, twice = estimator_for(motion), estimator_for(motion)
    for frame in stream:
        expected = once.update(frame)
        twice.update(frame)
        again = twice.update(replace(frame, velocimeter=np.full(3, 5.0), position_fix=np.full(2, 5.0)))
        assert expected is not None and again is not None
        np.testing.assert_array_equal(again.pose, expected.pose)
        np.testing.assert_array_equal(again.covariance, expected.covariance)
    assert twice.counts["stale_frame"] == len(stream)


def test_a_frame_from_the_past_is_dropped():
    motion = recorded("point")
    stream = list(frames(motion))
    estimator = estimator_for(motion)
    for frame in stream[:50]:
        before = estimator.update(frame)
    after = estimator.update(stream[10])
    assert before is not None and after is not None
    np.testing.assert_array_equal(after.pose, before.pose)
    assert after.stamp == before.stamp
    assert estimator.counts["stale_frame"] == 1


@pytest.mark.parametrize("fix_stamp", [0.28, 0.2, 99.0, math.nan])
def test_a_fix_that_is_older_or_from_the_future_is_dropped(fix_stamp):
    motion = recorded("point")
    estimator, reference = estimator_for(motion), estimator_for(motion)
    for frame in list(frames(motion))[:17]:
        if frame.stamp <= 0.3:
            estimator.update(frame), reference.update(frame)
        else:
            bad = replace(frame, position_fix=frame.velocimeter[:2] + 0.02, fix_stamp=fix_stamp)
            clean = replace(frame, position_fix=None, fix_stamp=None)
            after, expected = estimator.update(bad), reference.update(clean)
            assert after is not None and expected is not None
            np.testing.assert_array_equal(after.pose, expected.pose)
    assert estimator.counts["stale_fix"] == 1


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("shown", ["once", "until the next"])
@pytest.mark.parametrize("ahead", [0.001, 0.03])
def test_a_fix_measured_a_moment_after_its_frame_is_used_once_the_frames_have_caught_up(shown, ahead, every):
    """As of a beacon that is read in the same call, after the gyro."""
    motion = recorded("point")
    rng = np.random.default_rng(0)
    estimator, shows, worst = estimator_for(motion), {}, 0.0
    for k, frame in enumerate(frames(motion)):
        if shown == "once":
            shows = {"position_fix": None, "fix_stamp": None}
        if k % every == 0:
            fix = motion.poses[k, :2] + FIX_SIGMA * rng.standard_normal(2)
            shows = {"position_fix": fix, "fix_stamp": frame.stamp + ahead}
        estimate = estimator.update(replace(frame, **shows))
        worst = max(worst, estimator.silence("position_fix"))
    assert estimate is not None and np.linalg.norm(estimate.pose[:2] - motion.poses[-1, :2]) < 0.05
    assert worst < 0.13
    assert estimator.counts["stale_fix"] == 0 or (every, ahead) == (1, 0.03), "fixes overtake the one that waits"


def test_a_sensor_of_another_size_is_named():
    motion = recorded("point")
    stream = list(frames(motion))
    estimator = estimator_for(motion)
    estimator.update(replace(stream[0], position_fix=np.zeros(3)))
    assert estimator.lacks == "position_fix: 3 values instead of 2"
    estimator.update(stream[1])
    assert estimator.lacks == "position_fix: 3 values instead of 2"
    estimator.update(replace(stream[5], magnetometer=None))
    assert estimator.lacks == ""
    for frame in stream[6:30]:
        estimate = estimator.update(replace(frame, gyro=np.zeros(4)))
    assert estimate is not None and estimate.trust is Trust.HOLD
    assert estimate.why.startswith("gyro says nothing usable for") and "4 values instead of 3" in estimate.why


def test_a_compass_without_the_worlds_field_is_named():
    motion = recorded("point")
    estimator = estimator_for(motion)
    estimator.update(replace(next(frames(motion)), magnetometer=np.array([40.0, 0.0, 0.0]), position_fix=None))
    assert estimator.lacks == "position_fix: silent, magnetometer: not as strong as the world's field"


@pytest.mark.parametrize("latency", [0.0, 0.08, 0.9])
def test_a_fix_that_is_shown_until_the_next_one_counts_once(latency):
    """Be it good, garbage, or older than the memory; and it is no sign of life of a sensor that says nothing more."""
    motion = recorded("point")
    once, again = estimator_for(motion), estimator_for(motion)
    shown: dict[str, object] = {}
    for frame in frames(motion, latency=latency):
        if frame.stamp > 1.5:
            frame = replace(frame, position_fix=None, fix_stamp=None)
        elif 0.95 < frame.stamp < 1.05 and frame.position_fix is not None:
            frame = replace(frame, position_fix=np.full(2, math.nan))
        if frame.position_fix is not None:
            shown = {"position_fix": frame.position_fix, "fix_stamp": frame.fix_stamp}
        expected, estimate = once.update(frame), again.update(replace(frame, **shown))
        assert expected is not None and estimate is not None
        np.testing.assert_array_equal(estimate.pose, expected.pose)
        np.testing.assert_array_equal(estimate.covariance, expected.covariance)
        assert (estimate.trust, estimate.why) == (expected.trust, expected.why)
    assert again.counts == once.counts and once.counts["fix_not_finite"] == 1
    assert estimate.trust is Trust.HOLD and "position_fix" in estimate.why


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("latency", [0.08, 0.2])
def test_a_late_fix_is_applied_where_the_robot_was_when_it_was_measured(robot, latency):
    motion = recorded(robot)
    late = frames(motion, latency=latency)
    compensated = follow(motion, estimator_for(motion), late)
    trusting = (
        replace(frame, fix_stamp=None if frame.fix_stamp is None else frame.stamp)
        for frame in frames(motion, latency=latency)
    )
    naive = follow(motion, estimator_for(motion), trusting)
    assert compensated.position_rms < 1.3 * FIX_SIGMA
    assert compensated.position_rms < naive.position_rms


def test_a_carried_away_robot_finds_itself_after_ten_rejected_fixes():
    motion = recorded("point")
    away = np.array([3.0, -2.0])

    def carry(frame: SensorFrame) -> SensorFrame:
        if frame.stamp < 1.0 or frame.position_fix is None:
            return frame
        return replace(frame, position_fix=frame.position_fix + away)

    estimator = estimator_for(motion)
    rejected_at_first = None
    for k, frame in enumerate(frames(motion)):
        estimate = estimator.update(carry(frame))
        assert estimate is not None
        if estimator.counts["position_fix_rejected"] == 9:
            rejected_at_first = np.linalg.norm(estimate.pose[:2] - motion.poses[k, :2])
    assert rejected_at_first is not None and rejected_at_first < 0.2
    assert estimator.counts["position_fix_rejected"] == 10
    assert estimator.counts["position_fix_reinit"] == 1
    assert np.linalg.norm(estimate.pose[:2] - motion.poses[-1, :2] - away) < 0.1


def test_fixes_that_contradict_each_other_do_not_restart_the_position():
    motion = recorded("point")
    rng = np.random.default_rng(0)

    def scatter(frame: SensorFrame) -> SensorFrame:
        if frame.stamp < 1.0 or frame.position_fix is None:
            return frame
        side = 20.0 * (-1.0) ** round(frame.stamp / 0.1)
        return replace(frame, position_fix=frame.position_fix + side + rng.standard_normal(2))

    estimator = estimator_for(motion)
    errors = follow(motion, estimator, frames(motion), scatter)
    assert estimator.counts["position_fix_rejected"] > 20
    assert estimator.counts["position_fix_reinit"] == 0
    assert errors.position.max() < 0.5


def test_a_turned_around_robot_finds_its_heading_again():
    motion = recorded("point")
    estimator = estimator_for(motion)
    for frame in list(frames(motion))[:50]:
        estimator.update(frame)
    estimator._filter.replace((2,), (estimator._filter.x[2] + 2.5,), 1e-4)
    for frame in list(frames(motion))[50:80]:
        estimate = estimator.update(frame)
    assert estimate is not None
    assert abs(math.remainder(estimate.pose[2] - motion.poses[79, 2], 2 * math.pi)) < 0.2
    assert estimator.counts["magnetometer_reinit"] == 1


def test_a_biased_gyro_is_learnt():
    motion = recorded("car")
    bias = 0.1

    def damage(frame: SensorFrame) -> SensorFrame:
        return replace(frame, gyro=frame.gyro + [0.0, 0.0, bias])

    estimator = estimator_for(motion, bias_sigma=0.1)
    errors = follow(motion, estimator, frames(motion), damage)
    assert estimator._filter.x[5] == pytest.approx(bias, abs=0.05)
    assert errors.yaw_rms < math.radians(2.0)


def test_a_body_that_shivers_at_rest_is_not_taken_for_a_biased_gyro():
    """Sampled in step with the shiver, the gyro reads a turn that never happens; then the robot drives on."""
    motion = recorded("point")
    rest = 150
    still = {name: np.concatenate([np.repeat(v[:1], rest, 0), v]) for name, v in motion.sensors.items()}
    still["gyro"][:rest, 2] += 0.48
    poses = np.concatenate([np.repeat(motion.poses[:1], rest, 0), motion.poses])
    stamps = np.arange(len(poses)) * motion.stamps[1]
    shivering = replace(motion, stamps=stamps, poses=poses, upright=np.ones(len(poses)), sensors=still)
    errors = follow(shivering, estimator_for(motion), frames(shivering))
    assert np.abs(errors.yaw).max() < math.radians(8.0)
    assert np.sqrt(np.mean(errors.yaw[rest + 50 :] ** 2)) < math.radians(3.0)
    assert errors.estimates[-1].restarts == 0


def test_nothing_is_claimed_before_position_and_heading_are_measured():
    estimator = Estimator()
    still = {"accelerometer": np.array([0, 0, 9.81]), "gyro": np.zeros(3), "velocimeter": np.zeros(3)}
    north = np.array([-0.5, 0.0, 0.0])
    assert estimator.update(SensorFrame(0.0, **still)) is None
    assert estimator.update(SensorFrame(0.1, **still, magnetometer=north)) is None
    assert not estimator.ready
    estimate = estimator.update(SensorFrame(0.2, **still, position_fix=np.array([1.0, 2.0])))
    assert estimate is not None and estimator.ready
    np.testing.assert_allclose(estimate.pose, [1.0, 2.0, math.pi / 2], atol=0.02)


def test_between_fixes_the_uncertainty_grows_and_a_long_gap_starts_afresh():
    motion = recorded("point")
    estimator = estimator_for(motion)
    stream = list(frames(motion))
    known = estimator.update(stream[0])
    spread = [known.covariance[0, 0]]
    for frame in stream[1:20]:
        estimate = estimator.update(SensorFrame(frame.stamp))
        spread.append(estimate.covariance[0, 0])
    assert all(later > earlier for earlier, later in zip(spread, spread[1:], strict=False))
    assert estimator.update(SensorFrame(frame.stamp + 1.5)).stamp == frame.stamp
    assert estimator.update(SensorFrame(frame.stamp + 1.52)) is None
    assert estimator.counts["gap"] == 1


numbers = st.one_of(st.floats(-3.0, 3.0), st.sampled_from([math.nan, math.inf, 1e300, -1e300, 0.0]))
vectors = st.one_of(st.none(), st.lists(numbers, min_size=3, max_size=3).map(np.array))
random_frames = st.builds(
    SensorFrame,
    stamp=st.one_of(st.floats(0.0, 5.0), st.just(math.nan)),
    accelerometer=vectors,
    gyro=vectors,
    magnetometer=vectors,
    velocimeter=vectors,
    position_fix=st.one_of(st.none(), st.lists(numbers, min_size=2, max_size=2).map(np.array)),
    fix_stamp=st.one_of(st.none(), st.floats(0.0, 5.0), st.just(math.nan)),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(random_frames, max_size=60), st.booleans(), st.booleans())
def test_no_input_makes_the_state_infinite_or_the_covariance_lopsided(sequence, in_order, tilts):
    if in_order:
        sequence = sorted(sequence, key=lambda frame: frame.stamp if math.isfinite(frame.stamp) else 0.0)
    estimator = Estimator(EstimatorConfig(tilts=tilts))
    estimator.update(SensorFrame(-0.01, magnetometer=np.array([0.0, -0.5, 0.0]), position_fix=np.zeros(2)))
    for frame in sequence:
        estimate = estimator.update(frame)
        if estimate is None:
            continue
        assert np.isfinite(estimate.pose).all() and np.isfinite(estimate.velocity).all()
        assert -math.pi <= estimate.pose[2] < math.pi
        assert -1.0 <= estimate.upright <= 1.0
        np.testing.assert_array_equal(estimate.covariance, estimate.covariance.T)
        assert np.linalg.eigvalsh(estimate.covariance).min() > -1e-9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gyro_sigma": 0.0}, "gyro_sigma = 0.0"),
        ({"hold_after": 0}, "hold_after = 0"),
        ({"fix_sigma": math.nan}, "fix_sigma = nan"),
        ({"gate_probability": 1.0}, "gate_probability = 1.0"),
        ({"reinit_after": 1}, "reinit_after = 1"),
        ({"magnetic_field": (0.0, 0.0, -0.5)}, "magnetic_field"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        EstimatorConfig(**change)
