"""What the driver waits for, and for how long."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hiernav.nav.goal import GOAL_RADIUS

AT_MOST = {
    "first_estimate": 60.0, "no_way_at_start": 60.0, "no_way_hold": 10.0, "no_way": 600.0, "plan_slow": 10.0,
    "plan_hold": 10.0, "hold_timeout": 600.0, "stop_speed": 1.0, "stop_turn": 10.0, "stop_timeout": 30.0,
}  # fmt: skip
"""Values beyond which a watch would be none, by the names in `DriverConfig`."""


@dataclass(frozen=True)
class DriverConfig:
    """When a robot waits, when it gives up, and when a run ends."""

    goal_radius: float = GOAL_RADIUS
    """The goal is reached within this distance of the estimated position [m]."""
    goal_tolerance: float = 0.3
    """A goal inside an obstacle may be moved this far, to where the robot fits or at least to a free point [m]."""
    robot_radius: float = 0.1
    """Disc that must not meet the map [m]."""
    max_steps: int = 300
    """Control steps after which a run ends by timeout."""
    first_estimate: float = 2.0
    """Time the sensors are given to tell position and heading, once there is a goal [s]."""
    no_way_at_start: float = 1.5
    """Time a planner is given to find a first plan, if it says that there is no way [s]."""
    no_way_hold: float = 0.3
    """Time without a way after which a robot under way waits [s]."""
    no_way: float = 10.0
    """Time without a way after which a goal that was driven to counts as unreachable [s]."""
    plan_slow: float = 0.3
    """A robot whose plan has ended this long ago, with no new one, slows down [s]."""
    plan_hold: float = 1.0
    """A robot whose plan has ended this long ago waits [s]."""
    hold_timeout: float = 10.0
    """Waiting longer than this is a fault, unless somebody paused the robot [s]."""
    stop_speed: float = 0.1
    """A robot slower than this, and than `stop_turn`, stands [m/s]."""
    stop_turn: float = 1.0
    """A robot that turns slower than this, and is slower than `stop_speed`, stands [rad/s]. The simulated point, whose
    heading is held by a stiff servo, shivers at 0.5 where it stands."""
    stop_timeout: float = 3.0
    """Time the robot is given to stop once it is braked, and whenever it moves again [s]."""
    max_recoveries: int = 20
    """Recoveries on the way to one goal after which the robot is stuck, wherever they were."""
    predict: bool = True
    """Whether plans are made on maps as they will be where obstacles move (`hiernav.nav.prediction`)."""

    def __post_init__(self) -> None:
        for name, value in self.__dict__.items():
            if not (isinstance(value, bool) or math.isfinite(value) and value > 0):
                raise ValueError(f"DriverConfig.{name} = {value} must be finite and positive")
            if value > AT_MOST.get(name, math.inf):
                raise ValueError(f"DriverConfig.{name} = {value} must be at most {AT_MOST[name]:g}")
        if not self.plan_slow < self.plan_hold:
            raise ValueError(f"DriverConfig.plan_slow = {self.plan_slow} must be less than plan_hold")
