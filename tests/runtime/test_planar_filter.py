from __future__ import annotations

import math

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from hiernav.runtime.filter_check import TOLERANCE, filter_deviation
from hiernav.runtime.planar_filter import BIAS, POSITION, VELOCITY, YAW, PlanarFilter
from hiernav.runtime.tilt import TiltFilter, level_axes


def moving_filter(seed: int) -> PlanarFilter:
    """A filter in a random state with a random, correlated covariance."""
    rng = np.random.default_rng(seed)
    filter_ = PlanarFilter(velocity_walk=0.7, bias_walk=0.01)
    filter_.x = rng.normal(size=6).tolist()
    root = rng.normal(size=(6, 6))
    filter_.P = (root @ root.T / 10).tolist()
    return filter_


def general_filter(filter_: PlanarFilter) -> ExtendedKalmanFilter:
    """filterpy's, in the state of ours."""
    general = ExtendedKalmanFilter(dim_x=6, dim_z=2)
    general.x, general.P = np.array(filter_.x), np.array(filter_.P)
    return general


def test_over_a_whole_drive_it_stays_with_the_general_filter():
    assert filter_deviation(steps=500, seed=1) < 1e-10


def test_a_filter_that_forgets_a_correlation_is_found_out(monkeypatch):
    predict = PlanarFilter.predict_motion

    def forgetful(self, dt, yaw_rate, yaw_sigma):
        predict(self, dt, yaw_rate, yaw_sigma)
        self.P[0][3] = self.P[3][0] = 0.0

    monkeypatch.setattr(PlanarFilter, "predict_motion", forgetful)
    assert filter_deviation() > TOLERANCE


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("part", [POSITION, VELOCITY])
def test_a_pair_is_fused_as_the_general_filter_does(seed, part):
    ours = moving_filter(seed)
    general = general_filter(ours)
    measured = general.x[list(part)] + [0.05, -0.1]
    rows = np.eye(6)[list(part)]
    assert ours.correct_pair(part, tuple(measured - general.x[list(part)]), 0.04, gate=100.0)
    general.update(measured, lambda x: rows, lambda x: x[list(part)], R=np.eye(2) * 0.04)
    np.testing.assert_allclose(ours.x, general.x, atol=1e-10)
    np.testing.assert_allclose(ours.P, general.P, atol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_a_heading_is_fused_as_the_general_filter_does(seed):
    ours = moving_filter(seed)
    general = general_filter(ours)
    rows = np.eye(6)[YAW : YAW + 1]
    measured = general.x[YAW : YAW + 1] + 0.1
    assert ours.correct_yaw(0.1, 0.04, gate=100.0)
    general.update(measured, lambda x: rows, lambda x: x[YAW : YAW + 1], R=np.eye(1) * 0.04)
    np.testing.assert_allclose(np.delete(ours.x, YAW), np.delete(general.x, YAW), atol=1e-10)
    assert math.remainder(ours.x[YAW] - general.x[YAW], 2 * math.pi) == pytest.approx(0.0, abs=1e-10)
    np.testing.assert_allclose(ours.P, general.P, atol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_motion_spreads_uncertainty_as_the_general_filter_has_it(seed):
    """With the Jacobian taken from the motion itself, by differences, and the noise from a filter that is certain."""
    dt = 0.02

    def moved(state: np.ndarray, spread: float = 1.0) -> PlanarFilter:
        filter_ = moving_filter(seed)
        filter_.x, filter_.P = state.tolist(), (spread * np.array(filter_.P)).tolist()
        filter_.predict_motion(dt, yaw_rate=1.3, yaw_sigma=0.01)
        return filter_

    general = general_filter(moving_filter(seed))
    state, step = general.x.copy(), 1e-6
    ahead = [(np.array(moved(state + d).x), np.array(moved(state - d).x)) for d in np.eye(6) * step]
    change = np.column_stack([after - before for after, before in ahead])
    change[YAW] = (change[YAW] + np.pi) % (2 * np.pi) - np.pi
    general.F, general.Q = change / (2 * step), np.array(moved(state, 0.0).P)
    # The bias bends the path within one step as well; that second-order term is left out of the model.
    general.F[:2, BIAS] = 0.0
    general.predict()
    np.testing.assert_allclose(moved(state).P, general.P, atol=1e-8)


def test_the_noise_of_motion_is_that_of_an_integrated_random_walk():
    """Of the velocity, which then also says how far the position is off; whichever way the robot faces."""
    dt, walk, yaw = 0.1, 0.7, 0.6
    filter_ = PlanarFilter(walk, bias_walk=0.02)
    filter_.x, filter_.P = [0.0, 0.0, yaw, 0.0, 0.0, 0.0], np.zeros((6, 6)).tolist()
    filter_.predict_motion(dt, yaw_rate=0.0, yaw_sigma=0.03)
    turned = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    noise = np.zeros((6, 6))
    noise[:2, :2], noise[3:5, 3:5] = walk**2 * dt**3 / 3 * np.eye(2), walk**2 * dt * np.eye(2)
    noise[:2, 3:5], noise[3:5, :2] = walk**2 * dt**2 / 2 * turned, walk**2 * dt**2 / 2 * turned.T
    noise[YAW, YAW], noise[BIAS, BIAS] = 0.03**2, 0.02**2 * dt
    np.testing.assert_allclose(filter_.P, noise, atol=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_the_covariance_stays_symmetric_to_the_bit(seed):
    filter_ = moving_filter(seed)
    filter_.predict_motion(0.02, yaw_rate=1.3, yaw_sigma=0.01)
    filter_.correct_pair(POSITION, (0.01, 0.02), 0.04, gate=100.0)
    filter_.correct_yaw(0.1, 0.04, gate=100.0)
    covariance = np.array(filter_.P)
    np.testing.assert_array_equal(covariance, covariance.T)


@pytest.mark.parametrize("miss", [50.0, math.nan, math.inf])
def test_a_measurement_beyond_the_gate_leaves_no_trace(miss):
    filter_ = moving_filter(0)
    state, covariance = np.array(filter_.x), np.array(filter_.P)
    assert not filter_.correct_pair(POSITION, (miss, 0.0), 0.04, gate=14.0)
    assert not filter_.correct_yaw(miss, 0.04, gate=11.0)
    np.testing.assert_array_equal(filter_.x, state)
    np.testing.assert_array_equal(filter_.P, covariance)


def test_heading_wraps_on_the_way_round():
    filter_ = PlanarFilter(0.7, 0.01)
    filter_.x[YAW] = math.pi - 0.01
    filter_.predict_motion(0.1, yaw_rate=1.0, yaw_sigma=0.01)
    assert filter_.yaw == pytest.approx(-math.pi + 0.09)


def turned(roll: float, pitch: float) -> tuple[float, float, float]:
    return -math.sin(pitch), math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch)


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.6, 0.0), (0.0, -0.7), (0.5, 0.4), (3.0, 0.2)])
def test_level_axes_are_level_and_the_first_lies_above_the_body_axis(roll, pitch):
    up = turned(roll, pitch)
    forward, left = level_axes(up)
    frame = np.array([forward, left, up])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    assert frame[1] @ [1.0, 0.0, 0.0] == pytest.approx(0.0, abs=1e-12)
    assert frame[0] @ [1.0, 0.0, 0.0] >= 0.0


def test_a_body_whose_nose_points_straight_up_still_gets_axes():
    frame = np.array([*level_axes((1.0, 0.0, 0.0)), (1.0, 0.0, 0.0)])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)


def test_up_follows_the_gyro_through_a_roll():
    tilt = TiltFilter(0.0, 0.03)
    for _ in range(100):
        tilt.predict(0.01, (0.8, 0.0, 0.0), 0.0)
    np.testing.assert_allclose(tilt.up, turned(0.8, 0.0), atol=1e-9)


def test_up_is_found_from_gravity_alone():
    tilt = TiltFilter(0.0, 0.03)
    up = turned(0.3, -0.4)
    for _ in range(300):
        tilt.predict(0.02, (0.0, 0.0, 0.0), 0.006)
        tilt.correct(None, tuple(9.81 * component for component in up), (0.3, 3.0), gate=12.0)
    np.testing.assert_allclose(tilt.up, up, atol=1e-3)
    assert tilt.sigma < 0.1
