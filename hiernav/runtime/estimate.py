"""What the state estimator is told and what it tells."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np

from hiernav.runtime.robot import SensorFrame


class Trust(IntEnum):
    """What an estimate is good for."""

    GOOD = 0
    HOLD = 1
    """Too old or too vague to drive on; the robot waits, braked."""
    LOST = 2
    """Waiting does not help any more: a fault."""


AT_MOST = {"hold_after": 10.0, "lost_after": 10.0, "fix_hold_after": 60.0, "fix_lost_after": 60.0}
"""Times beyond which sensors would not be watched [s], by the names in `EstimatorConfig`."""


@dataclass(frozen=True)
class EstimatorConfig:
    """Noise of the sensors (standard deviations per component) and limits of trust."""

    gyro_sigma: float = 0.02
    """[rad/s]"""
    velocimeter_sigma: float = 0.02
    """[m/s]"""
    magnetometer_sigma: float = 0.01
    """In units of the magnetic field."""
    fix_sigma: float = 0.02
    """[m]"""
    magnetic_field: tuple[float, float, float] = (0.0, -0.5, 0.0)
    """In the world frame; MuJoCo's default."""
    tilts: bool = True
    """Whether the body can roll and pitch. False for a robot that is flat by construction: up is then known."""
    velocity_walk: float = 0.7
    """How fast the velocity wanders between readings [m/s per sqrt(s)]."""
    yaw_walk: float = 0.03
    """Error of the integrated gyro, besides its noise and its change within a tick [rad per sqrt(s)]."""
    bias_walk: float = 0.002
    """How fast the gyro's bias wanders [rad/s per sqrt(s)]."""
    bias_sigma: float = 0.05
    """Gyro bias to be expected at the start [rad/s]."""
    gate_probability: float = 0.9995
    """Share of good measurements that pass the chi-square gate."""
    reinit_after: int = 10
    """Fixes (or headings) rejected in a row after which that part of the state starts again."""
    resync_after: int = 3
    """Velocities or turning rates rejected in a row after which they are believed."""
    reinit_spread: float = 0.3
    """The last two rejected measurements must agree to this to be believed [m, m/s, rad; rad/s: `max_jump`]."""
    max_gap: float = 1.0
    """Without a frame for this long, nothing of the state is worth keeping; a lone stamp this far ahead is not believed
    [s]."""
    confirm: bool = True
    """Whether a first position and a first heading are driven on only once a second reading agrees: either may be a
    spike."""
    history: float = 0.5
    """Oldest fix that can still be used [s]."""
    max_jump: float = 6.0
    """A gyro reading that differs more than this from the last is taken for a spike [rad/s]."""
    hold_after: float = 0.25
    """A sensor, the position fix aside, that says nothing usable for this long is not driven without [s]."""
    lost_after: float = 0.8
    """A sensor, the position fix aside, that says nothing usable for this long is lost [s]."""
    fix_hold_after: float = 2.0
    """Without a new position fix for this long, dead reckoning is not driven on [s]."""
    fix_lost_after: float = 5.0
    """Without a new position fix for this long, the position is lost [s]."""

    def __post_init__(self) -> None:
        for name, value in self.__dict__.items():
            numeric = isinstance(value, int | float) and not isinstance(value, bool)
            if numeric and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"EstimatorConfig.{name} = {value} must be finite and positive")
            if numeric and value > AT_MOST.get(name, math.inf):
                raise ValueError(f"EstimatorConfig.{name} = {value} must be at most {AT_MOST[name]:g}")
        if not self.gate_probability < 1.0:
            raise ValueError(f"EstimatorConfig.gate_probability = {self.gate_probability} must be below 1")
        for name in ("reinit_after", "resync_after"):
            if getattr(self, name) < 2:
                raise ValueError(f"EstimatorConfig.{name} = {getattr(self, name)} must be at least 2")
        for first, second in (("hold_after", "lost_after"), ("fix_hold_after", "fix_lost_after")):
            if not getattr(self, first) < getattr(self, second):
                raise ValueError(
                    f"EstimatorConfig.{first} = {getattr(self, first)} must be less than {second} = "
                    f"{getattr(self, second)}"
                )
        if not (all(map(math.isfinite, self.magnetic_field)) and math.hypot(*self.magnetic_field[:2]) > 0.0):
            raise ValueError(
                f"EstimatorConfig.magnetic_field = {self.magnetic_field} must be finite and have a horizontal part"
            )


@dataclass(frozen=True)
class Estimate:
    """State at `stamp`."""

    stamp: float
    """On the robot's clock [s]."""
    pose: np.ndarray
    """(3,) x, y, yaw; world frame [m, m, rad]."""
    velocity: np.ndarray
    """(2,) world frame [m/s]."""
    covariance: np.ndarray
    """(6, 6) of x, y, yaw, forward and left velocity (heading frame), gyro bias."""
    upright: float
    """z component of the body's z axis: 1 upright, 0 on its side, -1 on its back."""
    yaw_rate: float
    """Turning rate of the heading without the gyro's bias [rad/s]."""
    trust: Trust = Trust.GOOD
    why: str = ""
    """What the estimate suffers from, where it is not good."""
    restarts: int = 0
    """How often position or heading were far off (`reinit_spread`) and started again, as after being carried away, or
    everything did. It never goes down. Plans made before are void."""

    def body_velocity(self) -> tuple[float, float]:
        """Forward and left, heading frame [m/s]."""
        (vx, vy), yaw = self.velocity.tolist(), float(self.pose[2])
        cosine, sine = math.cos(yaw), math.sin(yaw)
        return cosine * vx + sine * vy, cosine * vy - sine * vx


class StateEstimator(Protocol):
    """What the `Driver` asks of whatever estimates the state; `Estimator` is the one that ships.

    But for estimates that do not come, nothing else watches the sensors: one that falls silent, freezes or lies must
    show in `Estimate.trust`, or the robot drives on. `hiernav replay` goes through `Estimator`, and tells at which tick
    another one said otherwise.
    """

    skill_sensors: Mapping[str, int] | None
    """How many values each sensor gives that the skill observes. The driver says so before each `reset`."""
    driven: bool
    """Whether the policies have driven the robot since the last frame. The driver says so before each `update`."""

    @property
    def config(self) -> EstimatorConfig:
        """Its limits of trust are those of the driver's own watches, too."""
        ...

    @property
    def counts(self) -> Counter[str]:
        """How often something was dropped, rejected or started again, by name, since it was made."""
        ...

    @property
    def lacks(self) -> str:
        """Which sensors keep the first estimate waiting, and what is wrong with them; nothing once there is one."""
        ...

    def reset(self) -> None:
        """Forget the state: the loop starts."""
        ...

    def renew(self) -> None:
        """Somebody acknowledged a fault."""
        ...

    def update(self, frame: SensorFrame) -> Estimate | None:
        """Take in one frame, whatever is in it; the state at the newest stamp, None until it is known."""
        ...

    def hears(self, sensor: str) -> bool:
        """Whether a sensor, such as "velocimeter", has ever said something, as far as is known."""
        ...

    def silence(self, sensor: str) -> float:
        """For how long a sensor, such as "velocimeter", has said nothing usable [s]; 0 for one never heard of."""
        ...
