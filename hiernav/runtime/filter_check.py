"""The estimator's filter beside filterpy's on the machine that is to drive: the same sums, written twice."""

from __future__ import annotations

import math

import numpy as np

from hiernav.runtime.planar_filter import BIAS, POSITION, VELOCITY, VX, VY, YAW, PlanarFilter, wrap

TOLERANCE = 1e-8
_DT, _YAW_SIGMA, _GATE = 0.02, 0.01, 1e9
_READINGS = {POSITION: 4e-4, VELOCITY: 2.5e-3}
_HEADING = 1e-2


def filter_deviation(steps: int = 200, seed: int = 0) -> float:
    """Largest difference of state or covariance from filterpy's `ExtendedKalmanFilter`, over a drive with noise.

    Both are told the same turns and readings, and each of them goes on from its own state.
    """
    from filterpy.kalman import ExtendedKalmanFilter  # takes half a second, and only this check needs it

    rng = np.random.default_rng(seed)
    ours, theirs = PlanarFilter(velocity_walk=0.7, bias_walk=0.01), ExtendedKalmanFilter(dim_x=6, dim_z=2)
    theirs.x, theirs.P = np.array(ours.x), np.array(ours.P)
    worst = 0.0
    for step in range(steps):
        rate = 2.0 * math.sin(0.05 * step) + 0.1 * rng.normal()
        theirs.F, theirs.Q, moved = _motion(theirs.x, rate)
        theirs.predict()
        theirs.x = moved
        ours.predict_motion(_DT, rate, _YAW_SIGMA)
        for part, variance in _READINGS.items():
            rows = np.eye(6)[list(part)]
            residual = math.sqrt(variance) * rng.normal(size=2)
            measured = rows @ theirs.x + residual
            theirs.update(measured, lambda x, h=rows: h, lambda x, h=rows: h @ x, R=variance * np.eye(2))
            first, second = (float(value) - ours.x[index] for value, index in zip(measured, part, strict=True))
            ours.correct_pair(part, (first, second), variance, _GATE)
        rows = np.eye(6)[[YAW]]
        heading = theirs.x[YAW] + math.sqrt(_HEADING) * rng.normal()
        theirs.update(np.array([heading]), lambda x, h=rows: h, lambda x, h=rows: h @ x, R=_HEADING * np.eye(1))
        ours.correct_yaw(wrap(float(heading) - ours.yaw), _HEADING, _GATE)
        apart = np.array(ours.x) - theirs.x
        apart[YAW] = wrap(apart[YAW])
        worst = max(worst, float(np.abs(apart).max()), float(np.abs(np.array(ours.P) - theirs.P).max()))
    return worst


def _motion(state: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Jacobian (6, 6), noise (6, 6) and outcome (6,) of one step of the filter's model of motion."""
    turn = (rate - state[BIAS]) * _DT
    cos, sin = math.cos(state[YAW] + 0.5 * turn), math.sin(state[YAW] + 0.5 * turn)
    turned = np.array([[cos, -sin], [sin, cos]])
    way = _DT * turned @ state[[VX, VY]]
    jacobian = np.eye(6)
    jacobian[:2, YAW] = -way[1], way[0]
    jacobian[:2, VX : VY + 1] = _DT * turned
    jacobian[YAW, BIAS] = -_DT
    density, noise = 0.7**2, np.zeros((6, 6))
    noise[:2, :2] = density * _DT**3 / 3.0 * np.eye(2)
    noise[:2, VX : VY + 1] = density * _DT**2 / 2.0 * turned
    noise[VX : VY + 1, :2] = noise[:2, VX : VY + 1].T
    noise[VX : VY + 1, VX : VY + 1] = density * _DT * np.eye(2)
    noise[YAW, YAW], noise[BIAS, BIAS] = _YAW_SIGMA**2, 0.01**2 * _DT
    return jacobian, noise, state + np.array([*way, turn, 0.0, 0.0, 0.0])
