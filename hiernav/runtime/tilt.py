"""Which way is up, seen from a body that rolls and pitches."""

from __future__ import annotations

import math

GRAVITY = 9.81

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""w, x, y, z"""


class TiltFilter:
    """Direction of the world's z axis in the body frame, from gyro, accelerometer and magnetometer.

    The gyro turns it. The magnetic field pulls it: its angle to the vertical is known, which is a sharp measurement
    of one of the two tilt angles even while the legs hammer. The accelerometer pulls it the less, the further its
    reading is from g.

    The error has two level components, `along` the field and `across` it. Only the field tells them apart, so they
    stay uncorrelated and two variances are the whole covariance.
    """

    def __init__(self, dip_sine: float, magnetometer_sigma: float) -> None:
        """
        Args:
            dip_sine: z component of the unit vector along the world's magnetic field.
            magnetometer_sigma: of the field's direction [rad].
        """
        self._dip_sine = dip_sine
        self._magnetometer_variance = magnetometer_sigma**2
        self.reset()

    def reset(self) -> None:
        """Start again from a level body that may be tilted by some 20 degrees."""
        self.up: Vector = (0.0, 0.0, 1.0)
        self._along = self._across = 0.1

    @property
    def sigma(self) -> float:
        """Uncertainty of the direction, mean of its two components [rad]."""
        return math.sqrt(0.5 * (self._along + self._across))

    def predict(self, dt: float, rate: Vector, sigma: float) -> None:
        """Turn by the mean body rate [rad/s] over `dt` [s]; `sigma` is the uncertainty of that turn [rad]."""
        turn = (-rate[0] * dt, -rate[1] * dt, -rate[2] * dt)
        angle = math.sqrt(dot(turn, turn))
        if angle > 1e-9:
            # Rodrigues: u + sin(a)/a t x u + (1 - cos(a))/a^2 t x (t x u)
            once = cross(turn, self.up)
            twice = cross(turn, once)
            first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
            ux, uy, uz = self.up
            self._set(
                ux + first * once[0] + second * twice[0],
                uy + first * once[1] + second * twice[1],
                uz + first * once[2] + second * twice[2],
            )
        self._along = min(self._along + sigma**2, 1.0)
        self._across = min(self._across + sigma**2, 1.0)

    def correct(
        self,
        magnetometer: Vector | None,
        accelerometer: Vector | None,
        accelerometer_sigma: tuple[float, float],
        gate: float,
    ) -> None:
        """Pull towards what the sensors say.

        Args:
            magnetometer: one beyond `gate` (squared Mahalanobis distance) is ignored.
            accelerometer: [m/s^2].
            accelerometer_sigma: of the direction of gravity [rad] at a reading of g, and its growth per g of excess.
            gate: see there.
        """
        along = None
        if magnetometer is not None:
            along = self._correct_field(magnetometer, gate)
        if along is None:
            # Without the field the two components cannot be told apart.
            self._along = self._across = 0.5 * (self._along + self._across)
            along = level_axes(self.up)[0]
        if accelerometer is not None:
            self._correct_gravity(accelerometer, accelerometer_sigma, along)

    def _correct_field(self, field: Vector, gate: float) -> Vector | None:
        """Returns the level direction along the field; None if the field is of no use."""
        length = math.sqrt(dot(field, field))
        if length < 1e-9:
            return None
        field = (field[0] / length, field[1] / length, field[2] / length)
        sine = dot(field, self.up)
        level, along = _levelled(field, self.up, sine)
        if level < 0.2:
            return None
        residual = self._dip_sine - sine
        spread = level * level * self._along + self._magnetometer_variance
        if residual * residual <= gate * spread:
            gain = level * self._along / spread
            self._move(along, gain * residual)
            self._along *= 1.0 - gain * level
        return along

    def _correct_gravity(self, force: Vector, sigma: tuple[float, float], along: Vector) -> None:
        length = math.sqrt(dot(force, force))
        if length < 1e-9:
            return
        base, growth = sigma
        variance = (base + growth * abs(length / GRAVITY - 1.0)) ** 2
        across = cross(self.up, along)
        gain_along = self._along / (self._along + variance)
        gain_across = self._across / (self._across + variance)
        miss_along, miss_across = dot(force, along) / length, dot(force, across) / length
        self._move(along, gain_along * miss_along)
        self._move(across, gain_across * miss_across)
        self._along *= 1.0 - gain_along
        self._across *= 1.0 - gain_across

    def _move(self, direction: Vector, by: float) -> None:
        ux, uy, uz = self.up
        self._set(ux + by * direction[0], uy + by * direction[1], uz + by * direction[2])

    def _set(self, x: float, y: float, z: float) -> None:
        length = math.sqrt(x * x + y * y + z * z)
        if length > 1e-6:
            self.up = (x / length, y / length, z / length)


def level_axes(up: Vector) -> tuple[Vector, Vector]:
    """Body-frame unit vectors of the heading frame: forward (the body's x axis, levelled) and left.

    A body whose x axis points straight up has no heading; forward is then an arbitrary level direction.
    """
    _, forward = _levelled((1.0, 0.0, 0.0), up, up[0])
    return forward, cross(up, forward)


def rotation_between(before: Quaternion, after: Quaternion) -> Vector:
    """The rotation vector [rad] that leads from one orientation to another, in the body's frame; at most pi long."""
    w, x, y, z = before
    a, b, c, d = after
    real = w * a + x * b + y * c + z * d
    first, second, third = w * b - x * a - y * d + z * c, w * c + x * d - y * a - z * b, w * d - x * c + y * b - z * a
    half = math.sqrt(first * first + second * second + third * third)
    if half < 1e-12:
        return 0.0, 0.0, 0.0
    scale = 2.0 * math.atan2(math.copysign(half, real), abs(real)) / half
    return scale * first, scale * second, scale * third


def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _levelled(direction: Vector, up: Vector, sine: float) -> tuple[float, Vector]:
    """Length and unit vector of a direction's level part, `sine` being its component along `up`."""
    x, y, z = direction[0] - sine * up[0], direction[1] - sine * up[1], direction[2] - sine * up[2]
    length = math.sqrt(x * x + y * y + z * z)
    if length > 1e-6:
        return length, (x / length, y / length, z / length)
    other = cross(up, (0.0, 1.0, 0.0) if abs(up[1]) < 0.9 else (1.0, 0.0, 0.0))
    size = math.sqrt(dot(other, other))
    return length, (other[0] / size, other[1] / size, other[2] / size)
