"""What the runtime asks of a robot: read, send, brake."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

VECTOR_SENSORS = ("accelerometer", "gyro", "magnetometer", "velocimeter")
_TERMS = (*VECTOR_SENSORS, "lidar")
READINGS = (*_TERMS, "position_fix", "rotation")
"""Fields of a frame that are an array, or None where nothing was read."""
SIZES = {**dict.fromkeys(VECTOR_SENSORS, 3), "position_fix": 2, "rotation": 4}
"""Number of values of the sensors that are alike on every robot."""
ABSURD = 1e6
"""No sensor reads more than this in its SI unit; such values, which could overflow the arithmetic, count as missing."""


@dataclass(frozen=True)
class SensorFrame:
    """What the robot's sensors say at one moment. A sensor that gave nothing is None; values may be garbage."""

    stamp: float
    """When the inertial sensors were read, on the robot's monotonic clock [s]."""
    accelerometer: np.ndarray | None = None
    """(3,) specific force in the body frame: +g along z at rest [m/s^2]."""
    gyro: np.ndarray | None = None
    """(3,) angular velocity in the body frame [rad/s]."""
    magnetometer: np.ndarray | None = None
    """(3,) magnetic field in the body frame."""
    velocimeter: np.ndarray | None = None
    """(3,) velocity of the body origin in the body frame [m/s]."""
    lidar: np.ndarray | None = None
    """(10,) closeness in [0, 1], body frame."""
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)
    """The robot's own observation terms by name."""
    position_fix: np.ndarray | None = None
    """(2,) position of the body origin in the world frame [m]."""
    fix_stamp: float | None = None
    """When the position was measured, on the same clock; `stamp` if None [s]. A fix with the stamp of the last one is
    that one, shown again."""
    rotation: np.ndarray | None = None
    """(4,) unit quaternion w, x, y, z: the angular velocity as the inertial unit integrates it by itself, at its own
    rate, from any start. Its change from frame to frame counts alone, so that it may drift. A body that shakes within a
    control period cannot do without: samples of `gyro` do not tell where it turned meanwhile."""

    def terms(self) -> dict[str, np.ndarray]:
        """Every observation term that this frame has, by name, 1-D each."""
        present = {name: value for name in _TERMS if (value := getattr(self, name)) is not None}
        present.update(self.extra)
        return present


@dataclass(frozen=True)
class Truth:
    """What really happened to a simulated robot. For recorder and summary alone; nothing that drives may see it."""

    time: float
    """Since the reset [s]."""
    pose: np.ndarray
    """(3,) x, y, yaw; world frame [m, m, rad]."""
    velocity: np.ndarray
    """(2,) world frame [m/s]."""
    upright: float
    """z component of the body's z axis."""
    collided: bool
    """Contact with an obstacle in the last control step."""
    collisions: int
    """Control steps with contact since the reset."""


class Robot(Protocol):
    """A robot, simulated or real.

    An adapter's process brakes it when commands stop coming (`CommandWatchdog`). While a method of this class blocks,
    or if that process is killed or crashes, nothing here can brake: the motor controller must stop by itself about
    100 ms after the last command, or the last brake, that it got (200 ms for a robot that is commanded at 10 Hz).
    """

    @property
    def control_period(self) -> float:
        """Time between two commands [s]."""
        ...

    @property
    def action_dim(self) -> int: ...

    def read(self) -> SensorFrame:
        """The newest sensor values, without waiting for newer ones.

        Always a `SensorFrame`, also where no sensor said anything: each field that is missing is None then. Anything
        else is an error that says so, and ends the adapter.
        """
        ...

    def send(self, action: np.ndarray) -> np.ndarray:
        """Command (A,) in [-1, 1], what a body makes of which is in `deploy/README.md`; returns what was really sent.

        What is returned is used only where the robot lives in the loop's own process, that is in simulation without
        real time (`--fast`). Behind an adapter's process it is ignored, and what a recording calls `sent` is what the
        loop gave, clipped to [-1, 1].
        """
        ...

    def brake(self) -> None:
        """Command the safe stop. May be called at any time and any number of times, also before the first command."""
        ...

    def close(self) -> None:
        """Release the robot; it has been braked before."""
        ...


class RobotGone(RuntimeError):
    """The robot cannot be read, nor will it ever be again: what drives it must be started anew."""


COMMAND_TIMEOUT = 0.05
"""Age at which a command is no longer followed [s]."""


class CommandWatchdog:
    """Tells an adapter that its last command is too old to be followed."""

    def __init__(self, control_period: float) -> None:
        """`control_period` is the robot's [s]; ValueError unless it is finite and positive."""
        if not 0.0 < control_period < float("inf"):
            raise ValueError(f"CommandWatchdog: control_period {control_period} s must be finite and positive")
        # one and a half periods are granted, so that a robot with a long one can be driven at all
        self.timeout = max(COMMAND_TIMEOUT, 1.5 * control_period)
        self.trips = 0
        self._fed_at: float | None = None
        self._tripped = False

    def feed(self, now: float) -> None:
        """A command that was given at `now` [s] is followed."""
        self._fed_at = now
        self._tripped = False

    def expired(self, now: float) -> bool:
        """Whether the robot must brake at `now` [s]; also before the first command. Each expiry counts as one trip."""
        if self._fed_at is None:
            return True
        if now - self._fed_at <= self.timeout:
            return False
        if not self._tripped:
            self._tripped = True
            self.trips += 1
        return True
