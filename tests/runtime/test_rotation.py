"""The rotation that an inertial unit integrates by itself: what a body that shakes cannot do without."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from hiernav.runtime.estimate import EstimatorConfig
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.messages import _frame, _sensors
from hiernav.runtime.noise import SensorNoise
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.sim_robot import SimRobot
from hiernav.runtime.tilt import rotation_between
from hiernav.runtime.wire import decode_frame, encode_frame
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.worlds import sample_layout


def shaken(ticks: int = 150, seed: int = 0) -> list[tuple[SensorFrame, float]]:
    """Frames of a quadruped whose legs swing at 3 Hz, and how upright it really was."""
    robot = SimRobot(get_robot("doggo"), sample_layout(parse_world("pillar(2,2,0)"), 3), SensorNoise(), seed)
    rng, seen = np.random.default_rng(seed), []
    phase, centre = rng.uniform(0.0, 2.0 * np.pi, 12), rng.uniform(-0.3, 0.3, 12)
    for tick in range(ticks):
        seen.append((robot.read(), robot.truth().upright))
        robot.send(np.clip(centre + np.sin(0.6 * np.pi * tick + phase), -1.0, 1.0))
    robot.close()
    return seen


def tilt_errors(frames: list[tuple[SensorFrame, float]], estimator: Estimator | None = None) -> np.ndarray:
    """Estimated less true angle to the vertical [deg]."""
    estimator = estimator or Estimator(EstimatorConfig(tilts=True))
    errors = []
    for frame, upright in frames:
        estimate = estimator.update(frame)
        if estimate is not None:
            errors.append(math.degrees(math.acos(min(1.0, estimate.upright)) - math.acos(min(1.0, upright))))
    return np.abs(errors)


def test_the_tilt_of_a_body_that_shakes_is_known_by_the_rotation_and_not_by_samples_of_the_gyro() -> None:
    frames = shaken()
    sampled = tilt_errors([(replace(frame, rotation=None), upright) for frame, upright in frames])
    integrated = tilt_errors(frames)
    assert np.percentile(integrated, 95) < 8.0
    assert np.percentile(sampled, 95) > 2.0 * np.percentile(integrated, 95)


def test_frames_that_are_lost_lose_no_rotation() -> None:
    frames = shaken(seed=3)[::2]  # that of seed 0 is on the edge of falling over, and does with some releases of MuJoCo
    assert np.percentile(tilt_errors(frames), 95) < 12.0


def test_a_rotation_that_jumps_is_not_followed() -> None:
    frames, estimator = shaken(), Estimator(EstimatorConfig(tilts=True))
    flipped = np.array([0.0, 1.0, 0.0, 0.0])
    frames[100] = (replace(frames[100][0], rotation=flipped), frames[100][1])
    errors = tilt_errors(frames, estimator)
    assert estimator.counts["rotation_rejected"] >= 1
    assert errors.max() < 45.0, "half a turn would be 180"


def test_a_rotation_that_hangs_counts_as_none() -> None:
    frames = shaken(60)
    frozen = frames[0][0].rotation
    hangs = tilt_errors([(replace(frame, rotation=frozen), upright) for frame, upright in frames])
    none = tilt_errors([(replace(frame, rotation=None), upright) for frame, upright in frames])
    np.testing.assert_array_equal(hangs, none)


@pytest.mark.parametrize("garbage", [np.full(4, np.nan), np.zeros(4), np.full(4, 9.0), np.zeros(3)])
def test_garbage_counts_as_no_rotation(garbage: np.ndarray) -> None:
    frames = shaken(40)
    bad = tilt_errors([(replace(frame, rotation=garbage), upright) for frame, upright in frames])
    none = tilt_errors([(replace(frame, rotation=None), upright) for frame, upright in frames])
    np.testing.assert_array_equal(bad, none)


@pytest.mark.parametrize("seed", range(5))
def test_the_rotation_between_two_orientations_leads_from_one_to_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, after = (q / np.linalg.norm(q) for q in rng.normal(size=(2, 4)))
    expected, reached = np.zeros(3), before.copy()
    mujoco.mju_subQuat(expected, after, before)
    turn = np.array(rotation_between(tuple(before), tuple(after)))
    np.testing.assert_allclose(turn, expected, atol=1e-12)
    mujoco.mju_quatIntegrate(reached, turn, 1.0)
    assert abs(reached @ after) == pytest.approx(1.0)
    assert rotation_between(tuple(before), tuple(before)) == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(rotation_between(tuple(before), tuple(-after)), turn, atol=1e-12)


def test_the_rotation_crosses_processes_and_is_recorded() -> None:
    frame = shaken(3)[-1][0]
    np.testing.assert_array_equal(decode_frame(encode_frame(frame, None))[0].rotation, frame.rotation)
    np.testing.assert_array_equal(_frame(_sensors(frame)).rotation, frame.rotation)
