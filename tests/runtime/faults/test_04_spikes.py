"""Spikes of 10 to 1000 sigma on 5 % of all samples, and sensors that say nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runtime_motion import FIX_SIGMA, SIGMA, estimator_for, follow, frames, recorded

from hiernav.runtime.estimate import Trust
from hiernav.runtime.robot import SensorFrame


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
@pytest.mark.parametrize("seed", range(6))
def test_spikes_are_gated_and_the_position_error_at_most_doubles(robot, seed):
    motion = recorded(robot)
    rng = np.random.default_rng([seed, 4])
    spikes = 0

    def spike(reading: np.ndarray | None, sigma: float) -> np.ndarray | None:
        nonlocal spikes
        if reading is None or rng.random() > 0.05:
            return reading
        spikes += 1
        return reading + sigma * 10.0 ** rng.uniform(1.0, 3.0) * rng.choice([-1.0, 1.0], len(reading))

    def damage(frame: SensorFrame) -> SensorFrame:
        values = {name: spike(getattr(frame, name), sigma) for name, sigma in SIGMA.items()}
        return replace(frame, **values, position_fix=spike(frame.position_fix, FIX_SIGMA))

    nominal = follow(motion, estimator_for(motion), frames(motion, seed))
    estimator = estimator_for(motion)
    spiked = follow(motion, estimator, frames(motion, seed), damage)
    assert spikes > 20
    assert sum(count for name, count in estimator.counts.items() if name.endswith("_rejected")) > 0
    assert spiked.position_rms <= 2.0 * nominal.position_rms
    assert all(estimate.trust is Trust.GOOD for estimate in spiked.estimates)


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
@pytest.mark.parametrize("sensor", ["position_fix", "magnetometer"])
@pytest.mark.parametrize("which", [0, 1])
def test_a_spike_among_the_first_readings_is_not_driven_on(robot, sensor, which):
    """Before there is a state, nothing tells a spike from the truth but the reading that comes next."""
    motion, seen = recorded(robot), [0]
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # as strong as the world's field

    def damage(frame: SensorFrame) -> SensorFrame:
        reading = getattr(frame, sensor)
        if reading is None:
            return frame
        seen[0] += 1
        spike = turned @ reading if sensor == "magnetometer" else reading + [3.0, -0.3]
        return replace(frame, **{sensor: spike}) if seen[0] == which + 1 else frame

    errors = follow(motion, estimator_for(motion), frames(motion), damage, confirmed=False)
    good = np.array([each.trust is Trust.GOOD for each in errors.estimates])
    assert good.mean() > 0.75 and not good[0] and good[-1]
    assert errors.position[good].max() < 0.15 and np.abs(errors.yaw[good]).max() < 0.3


@pytest.mark.parametrize("sensor", ["position_fix", "magnetometer"])
def test_a_first_spike_that_is_shown_again_and_again_does_not_confirm_itself(sensor):
    """An adapter at 50 Hz that shows what sensors of 10 Hz said last, under the stamp of each frame."""
    motion, shown = recorded("point"), {}

    def damage(frame: SensorFrame) -> SensorFrame:
        if not shown:
            spike = frame.position_fix + [3.0, -0.3], frame.magnetometer[[1, 0, 2]] * [-1.0, 1.0, 1.0]
            shown.update({sensor: spike[sensor == "magnetometer"]})
        elif round(frame.stamp / motion.stamps[1]) % 5 == 0:
            shown[sensor] = getattr(frame, sensor)
        return replace(frame, **shown, fix_stamp=None)

    errors = follow(motion, estimator_for(motion), frames(motion), damage, confirmed=False)
    good = np.array([each.trust is Trust.GOOD for each in errors.estimates])
    assert good.mean() > 0.75 and not good[:5].any() and good[-1]
    assert errors.position[good].max() < 0.2 and np.abs(errors.yaw[good]).max() < 0.4


def test_a_first_reading_that_others_do_not_fit_is_waited_for_not_lost():
    motion = recorded("doggo")
    errors = follow(motion, estimator_for(motion, magnetometer_sigma=1e-4), frames(motion), confirmed=False)
    trusts = [each.trust for each in errors.estimates]
    assert Trust.GOOD in trusts and Trust.LOST not in trusts[: trusts.index(Trust.GOOD)]


def test_sensors_that_are_noisier_than_was_said_are_believed_after_all():
    motion = recorded("point")
    estimator = estimator_for(motion, fix_sigma=1e-4)
    errors = follow(motion, estimator, frames(motion))
    assert any(each.trust is Trust.GOOD for each in errors.estimates if each.stamp < 1.5)


LIES = {
    "gyro": lambda reading, rng: reading + [0.0, 0.0, 300.0],
    "gyro, scattered": lambda reading, rng: rng.uniform(-90.0, 90.0, 3),
    "magnetometer": lambda reading, rng: 1.5 * reading,
    "velocimeter": lambda reading, rng: rng.uniform(-40.0, 40.0, 3),
    "position_fix": lambda reading, rng: reading + rng.uniform(-30.0, 30.0, 2),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_sensor_whose_every_reading_is_rejected_is_as_good_as_silent(lie):
    motion, rng, sensor = recorded("point"), np.random.default_rng(0), lie.partition(",")[0]

    def damage(frame: SensorFrame) -> SensorFrame:
        reading = getattr(frame, sensor)
        return frame if frame.stamp < 1.5 or reading is None else replace(frame, **{sensor: LIES[lie](reading, rng)})

    estimator = estimator_for(motion)
    errors = follow(motion, estimator, frames(motion), damage)
    config = estimator.config
    hold, lost = (
        (config.fix_hold_after, config.fix_lost_after)
        if sensor == "position_fix"
        else (config.hold_after, config.lost_after)
    )
    assert estimator.counts[f"{sensor}_rejected"] >= (10 if sensor == "position_fix" else 70)
    held = [each for each in errors.estimates if each.trust is not Trust.GOOD]
    assert all(each.why.startswith(f"{sensor} says nothing usable") for each in held)
    # a scattered lie may by chance be close to the truth
    slack = 0.2 if "scattered" in lie or sensor in ("position_fix", "velocimeter") else 0.03
    assert 1.5 + hold - 0.11 < held[0].stamp < 1.5 + hold + slack
    assert (held[-1].trust is Trust.LOST) == (1.5 + lost < motion.stamps[-1]) and held[-1] is errors.estimates[-1]
