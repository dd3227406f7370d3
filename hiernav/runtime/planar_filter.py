"""Extended Kalman filter of a robot's planar motion, gated before every update.

Six numbers and their covariance are too few for numpy, whose calls take longer to begin than these sums take in plain
Python; and plain sums give the same on every processor. Importing filterpy took as long as all the rest of a control
process's start, so its `ExtendedKalmanFilter` is what this filter is held against instead: in the tests, and on the
robot's own machine by a dry run (`filter_check`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

X, Y, YAW, VX, VY, BIAS = range(6)
POSITION = (X, Y)
VELOCITY = (VX, VY)


class PlanarFilter:
    """State: x, y [m], yaw [rad], velocity in the heading frame (forward, left) [m/s], yaw gyro bias [rad/s].

    A measurement must pass a chi-square gate before it may touch the state.
    """

    def __init__(self, velocity_walk: float, bias_walk: float, max_bias: float = math.inf) -> None:
        """
        Args:
            velocity_walk: random walk of the velocity [m/s per sqrt(s)].
            bias_walk: random walk of the gyro's bias [rad/s per sqrt(s)].
            max_bias: no gyro's bias is larger [rad/s].
        """
        self.x = [0.0] * 6
        """State (6,)."""
        self.P = [[float(row == column) for column in range(6)] for row in range(6)]
        """Its covariance (6, 6), symmetric to the bit."""
        self._velocity_density = velocity_walk**2
        self._bias_density = bias_walk**2
        self._max_bias = max_bias

    @property
    def yaw(self) -> float:
        return self.x[YAW]

    def predict_motion(self, dt: float, yaw_rate: float, yaw_sigma: float) -> None:
        """Move on by `dt` [s].

        Args:
            dt: positive [s].
            yaw_rate: measured turning rate with its bias, mean over the interval [rad/s].
            yaw_sigma: uncertainty of the turn, besides the bias [rad].
        """
        x, y, yaw, vx, vy, bias = self.x
        turn = (yaw_rate - bias) * dt
        cos, sin = math.cos(yaw + 0.5 * turn), math.sin(yaw + 0.5 * turn)
        c, s = cos * dt, sin * dt
        dx, dy = c * vx - s * vy, s * vx + c * vy
        self.x = [x + dx, y + dy, wrap(yaw + turn), vx, vy, bias]

        # Position and velocity noise are correlated, as an integrated random walk: a later velocity reading then also
        # corrects the position, which is the trapezoidal rule.
        density = self._velocity_density
        place, half, walk = density * dt**3 / 3.0, 0.5 * density * dt**2, density * dt

        # F P F' + Q; F adds to x: -dy yaw + c vx - s vy, to y: dx yaw + s vx + c vy, to yaw: -dt bias
        on_x, on_y, on_yaw, on_vx, on_vy, on_bias = self.P
        of_yaw = zip(on_yaw, on_vx, on_vy, on_x, on_y, strict=True)
        moved = [(a - dy * h + c * v - s * w, b + dx * h + s * v + c * w) for h, v, w, a, b in of_yaw]
        (xx, _), (xy, yy), (xh, yh), (xv, yv), (xw, yw), (xb, yb) = moved
        _, _, hh, hv, hw, hb = (h - dt * g for h, g in zip(on_yaw, on_bias, strict=True))
        xx, yy = xx - dy * xh + c * xv - s * xw + place, yy + dx * yh + s * yv + c * yw + place
        xy = xy + dx * xh + s * xv + c * xw
        xh, yh, hh = xh - dt * xb, yh - dt * yb, hh - dt * hb + yaw_sigma**2
        xv, xw, yv, yw = xv + half * cos, xw - half * sin, yv + half * sin, yw + half * cos
        vv, vw, vb = on_vx[VX] + walk, on_vx[VY], on_vx[BIAS]
        ww, wb, bb = on_vy[VY] + walk, on_vy[BIAS], on_bias[BIAS] + self._bias_density * dt
        self.P = [
            [xx, xy, xh, xv, xw, xb],
            [xy, yy, yh, yv, yw, yb],
            [xh, yh, hh, hv, hw, hb],
            [xv, yv, hv, vv, vw, vb],
            [xw, yw, hw, vw, ww, wb],
            [xb, yb, hb, vb, wb, bb],
        ]

    def correct_pair(self, part: tuple[int, int], residual: tuple[float, float], variance: float, gate: float) -> bool:
        """Update with a measurement of position or velocity.

        Args:
            part: `POSITION` or `VELOCITY`.
            residual: measured minus predicted.
            variance: of either component.
            gate: largest accepted squared Mahalanobis distance.

        Returns:
            Whether the measurement was accepted; if not, nothing has changed.
        """
        p, q = (self.P[index].copy() for index in part)
        a, b, d = p[part[0]] + variance, p[part[1]], q[part[1]] + variance
        determinant = a * d - b * b
        first, second = residual
        distance = (d * first * first - 2.0 * b * first * second + a * second * second) / determinant
        if not 0.0 <= distance <= gate:
            return False
        gains = [((u * d - v * b) / determinant, (v * a - u * b) / determinant) for u, v in zip(p, q, strict=True)]
        self._apply([k * first + m * second for k, m in gains])
        for i, (row, (k, m)) in enumerate(zip(self.P, gains, strict=True)):
            for j in range(i + 1):
                row[j] = self.P[j][i] = row[j] - k * p[j] - m * q[j]
        return True

    def correct_yaw(self, residual: float, variance: float, gate: float) -> bool:
        """Update with a measured heading; arguments as in `correct_pair`, `residual` in [-pi, pi)."""
        column = self.P[YAW].copy()
        spread = column[YAW] + variance
        if not 0.0 <= residual * residual / spread <= gate:
            return False
        gains = [u / spread for u in column]
        self._apply([k * residual for k in gains])
        for i, (row, k) in enumerate(zip(self.P, gains, strict=True)):
            for j in range(i + 1):
                row[j] = self.P[j][i] = row[j] - k * column[j]
        return True

    def replace(self, part: Sequence[int], value: Sequence[float], variance: float) -> None:
        """Forget a part of the state and its correlations, and start it at `value` with `variance`."""
        for index, number in zip(part, value, strict=True):
            self.x[index] = number
            for other in range(6):
                self.P[index][other] = self.P[other][index] = 0.0
            self.P[index][index] = variance

    def _apply(self, change: list[float]) -> None:
        self.x = [value + by for value, by in zip(self.x, change, strict=True)]
        self.x[YAW] = wrap(self.x[YAW])
        self.x[BIAS] = min(max(self.x[BIAS], -self._max_bias), self._max_bias)


def wrap(angle: float) -> float:
    """`angle` [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
