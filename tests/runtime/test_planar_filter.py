from __future__ import annotations

import math

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from hiernav.runtime.planar_filter import POSITION, VELOCITY, YAW, PlanarFilter
from hiernav.runtime.tilt import TiltFilter, level_axes


def moving_filter(seed: int) -> PlanarFilter:
    """A filter in a random state with a random, correlated covariance."""
    rng = np.random.default_rng(seed)
    filter_ = PlanarFilter(velocity_walk=0.7, bias_walk=0.01)
    filter_.x = rng.normal(size=6)
    root = rng.normal(size=(6, 6))
    filter_.P = root @ root.T / 10
    return filter_


def general_filter(filter_: PlanarFilter) -> ExtendedKalmanFilter:
    """filterpy's, in the state of ours."""
    general = ExtendedKalmanFilter(dim_x=6, dim_z=2)
    general.x, general.P = filter_.x.copy(), filter_.P.copy()
    return general


@pytest.mark.parametrize("seed", range(5))
def test_uncertainty_grows_as_the_general_filter_has_it(seed):
    ours = moving_filter(seed)
    general = general_filter(ours)
    ours.predict_motion(0.02, yaw_rate=1.3, yaw_sigma=0.01)
    general.F, general.Q = ours.F, ours.Q
    general.predict()
    np.testing.assert_allclose(ours.P, general.P, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("part", [POSITION, VELOCITY])
def test_a_pair_is_fused_as_the_general_filter_does(seed, part):
    ours = moving_filter(seed)
    general = general_filter(ours)
    measured = ours.x[part] + [0.05, -0.1]
    rows = np.eye(6)[part]
    assert ours.correct_pair(part, tuple(measured - ours.x[part]), 0.04, gate=100.0)
    general.update(measured, lambda x: rows, lambda x: x[part], R=np.eye(2) * 0.04)
    np.testing.assert_allclose(ours.x, general.x, atol=1e-10)
    np.testing.assert_allclose(ours.P, general.P, atol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_a_heading_is_fused_as_the_general_filter_does(seed):
    ours = moving_filter(seed)
    general = general_filter(ours)
    rows = np.eye(6)[YAW : YAW + 1]
    measured = ours.x[YAW : YAW + 1] + 0.1
    assert ours.correct_yaw(0.1, 0.04, gate=100.0)
    general.update(measured, lambda x: rows, lambda x: x[YAW : YAW + 1], R=np.eye(1) * 0.04)
    np.testing.assert_allclose(np.delete(ours.x, YAW), np.delete(general.x, YAW), atol=1e-10)
    assert math.remainder(ours.x[YAW] - general.x[YAW], 2 * math.pi) == pytest.approx(0.0, abs=1e-10)
    np.testing.assert_allclose(ours.P, general.P, atol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobian_is_the_derivative_of_the_motion(seed):
    def moved(state: np.ndarray) -> np.ndarray:
        filter_ = moving_filter(seed)
        filter_.x = state
        filter_.predict_motion(0.02, yaw_rate=1.3, yaw_sigma=0.01)
        return filter_.x

    reference = moving_filter(seed)
    state = reference.x.copy()
    reference.predict_motion(0.02, yaw_rate=1.3, yaw_sigma=0.01)
    step = 1e-6
    numeric = np.column_stack([(moved(state + d) - moved(state - d)) / (2 * step) for d in np.eye(6) * step])
    numeric[YAW] = (numeric[YAW] * step * 2 + np.pi) % (2 * np.pi) / (2 * step) - np.pi / (2 * step)
    # The bias bends the path within one step as well; that second-order term is left out of the model.
    np.testing.assert_allclose(reference.F[:, :5], numeric[:, :5], atol=1e-4)
    np.testing.assert_allclose(reference.F[:, 5], numeric[:, 5], atol=1e-3)


@pytest.mark.parametrize("miss", [50.0, math.nan, math.inf])
def test_a_measurement_beyond_the_gate_leaves_no_trace(miss):
    filter_ = moving_filter(0)
    state, covariance = filter_.x.copy(), filter_.P.copy()
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
    tilt = TiltFilter(0.0, 0.3, 0.03, (0.3, 3.0))
    for _ in range(100):
        tilt.predict(0.01, (0.8, 0.0, 0.0), 0.0)
    np.testing.assert_allclose(tilt.up, turned(0.8, 0.0), atol=1e-9)


def test_up_is_found_from_gravity_alone():
    tilt = TiltFilter(0.0, 0.3, 0.03, (0.3, 3.0))
    up = turned(0.3, -0.4)
    for _ in range(300):
        tilt.predict(0.02, (0.0, 0.0, 0.0), 0.0)
        tilt.correct(None, tuple(9.81 * component for component in up), gate=12.0)
    np.testing.assert_allclose(tilt.up, up, atol=1e-3)
    assert tilt.sigma < 0.1
