"""Extended Kalman filter of a robot's planar motion, gated before every update.

The tests hold it against filterpy's `ExtendedKalmanFilter`. The control process does without filterpy itself: none of
its methods would be called, and with the parts of scipy that it imports it took half of the time that a robot needs to
start.
"""

from __future__ import annotations

import math

import numpy as np

X, Y, YAW, VX, VY, BIAS = range(6)
POSITION = slice(X, Y + 1)
VELOCITY = slice(VX, VY + 1)


class PlanarFilter:
    """State (6,): x, y [m], yaw [rad], velocity in the heading frame (forward, left) [m/s], yaw gyro bias [rad/s].

    The model is written out for this state, at a fraction of the time that a general `predict` and `update` take. A
    measurement must pass a chi-square gate before it may touch the state.
    """

    def __init__(self, velocity_walk: float, bias_walk: float, max_bias: float = math.inf) -> None:
        """
        Args:
            velocity_walk: random walk of the velocity [m/s per sqrt(s)].
            bias_walk: random walk of the gyro's bias [rad/s per sqrt(s)].
            max_bias: no gyro's bias is larger [rad/s].
        """
        self.x = np.zeros(6)
        self.P = np.eye(6)
        """(6, 6) covariance of the state."""
        self.F = np.eye(6)
        """(6, 6) Jacobian of the last motion."""
        self.Q = np.zeros((6, 6))
        """(6, 6) covariance of the last motion's noise."""
        self._velocity_density = velocity_walk**2
        self._bias_density = bias_walk**2
        self._max_bias = max_bias

    @property
    def yaw(self) -> float:
        return float(self.x[YAW])

    def predict_motion(self, dt: float, yaw_rate: float, yaw_sigma: float) -> None:
        """Move on by `dt` [s].

        Args:
            dt: positive [s].
            yaw_rate: measured turning rate with its bias, mean over the interval [rad/s].
            yaw_sigma: uncertainty of the turn, besides the bias [rad].
        """
        x, y, yaw, vx, vy, bias = self.x.tolist()
        turn = (yaw_rate - bias) * dt
        cos, sin = math.cos(yaw + 0.5 * turn), math.sin(yaw + 0.5 * turn)
        dx, dy = (cos * vx - sin * vy) * dt, (sin * vx + cos * vy) * dt
        self.x = np.array([x + dx, y + dy, wrap(yaw + turn), vx, vy, bias])

        jacobian = self.F
        jacobian[X, YAW], jacobian[Y, YAW], jacobian[YAW, BIAS] = -dy, dx, -dt
        jacobian[X, VX] = jacobian[Y, VY] = cos * dt
        jacobian[Y, VX] = sin * dt
        jacobian[X, VY] = -sin * dt

        # Position and velocity noise are correlated, as an integrated random walk: a later velocity reading then also
        # corrects the position, which is the trapezoidal rule.
        density, noise = self._velocity_density, self.Q
        noise[X, X] = noise[Y, Y] = density * dt**3 / 3.0
        noise[VX, VX] = noise[VY, VY] = density * dt
        half = 0.5 * density * dt**2
        noise[X, VX] = noise[VX, X] = noise[Y, VY] = noise[VY, Y] = half * cos
        noise[Y, VX] = noise[VX, Y] = half * sin
        noise[X, VY] = noise[VY, X] = -half * sin
        noise[YAW, YAW] = yaw_sigma**2
        noise[BIAS, BIAS] = self._bias_density * dt

        covariance = jacobian @ self.P @ jacobian.T + noise
        self.P = 0.5 * (covariance + covariance.T)

    def correct_pair(self, part: slice, residual: tuple[float, float], variance: float, gate: float) -> bool:
        """Update with a measurement of position or velocity.

        Args:
            part: `POSITION` or `VELOCITY`.
            residual: measured minus predicted.
            variance: of either component.
            gate: largest accepted squared Mahalanobis distance.

        Returns:
            Whether the measurement was accepted; if not, nothing has changed.
        """
        columns = self.P[:, part]
        (a, b), (_, d) = columns[part].tolist()
        a, d = a + variance, d + variance
        determinant = a * d - b * b
        first, second = residual
        distance = (d * first * first - 2.0 * b * first * second + a * second * second) / determinant
        if not 0.0 <= distance <= gate:
            return False
        inverse = np.array([[d, -b], [-b, a]]) / determinant
        gain = columns @ inverse
        self._apply(gain @ residual, gain @ columns.T)
        return True

    def correct_yaw(self, residual: float, variance: float, gate: float) -> bool:
        """Update with a measured heading; arguments as in `correct_pair`, `residual` in [-pi, pi)."""
        column = self.P[:, YAW]
        spread = float(column[YAW]) + variance
        if not 0.0 <= residual * residual / spread <= gate:
            return False
        self._apply(column * (residual / spread), (column / spread)[:, None] * column)
        return True

    def replace(self, part: slice, value: np.ndarray | tuple[float, ...], variance: float) -> None:
        """Forget a part of the state and its correlations, and start it at `value` with `variance`."""
        self.x[part] = value
        self.P[part, :] = 0.0
        self.P[:, part] = 0.0
        size = len(range(*part.indices(6)))
        self.P[part, part] = np.eye(size) * variance

    def _apply(self, change: np.ndarray, reduction: np.ndarray) -> None:
        self.x = self.x + change
        self.x[YAW] = wrap(float(self.x[YAW]))
        self.x[BIAS] = min(max(float(self.x[BIAS]), -self._max_bias), self._max_bias)
        covariance = self.P - reduction
        self.P = 0.5 * (covariance + covariance.T)


def wrap(angle: float) -> float:
    """`angle` [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
