"""Errors of simulated sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class SensorNoise:
    """Errors of the simulated sensors: standard deviations per component, rates, delays and losses."""

    accelerometer: float = 0.1
    """[m/s^2]"""
    gyro: float = 0.02
    """[rad/s]"""
    magnetometer: float = 0.01
    """In units of the field, which is 0.5."""
    velocimeter: float = 0.02
    """[m/s]"""
    lidar: float = 0.0
    """Of the distance to whatever is seen [m]."""
    extra: float = 0.0
    """Of the robot's own terms, in their units."""
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[rad/s]"""
    fix: float = 0.02
    """[m]"""
    fix_period: float = 0.1
    """Time between position fixes [s]; never shorter than the control period."""
    fix_latency: float = 0.0
    """Time from measurement to delivery of a fix [s]."""
    dropout: float = 0.0
    """Probability that a sensor gives nothing in a tick, for each inertial sensor by itself."""
    fix_dropout: float = 0.0
    """Probability that a fix is lost."""

    def __post_init__(self) -> None:
        for name in ("accelerometer", "gyro", "magnetometer", "velocimeter", "lidar", "extra", "fix", "fix_latency"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"SensorNoise.{name} = {value} must be finite and not negative")
        if not all(map(math.isfinite, self.gyro_bias)):
            raise ValueError(f"SensorNoise.gyro_bias = {self.gyro_bias} rad/s must be finite")
        for name in ("dropout", "fix_dropout"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"SensorNoise.{name} = {getattr(self, name)} must be a probability")
        if not 0.0 < self.fix_period < math.inf:
            raise ValueError(f"SensorNoise.fix_period = {self.fix_period} s must be finite and positive")


EXACT = SensorNoise(accelerometer=0.0, gyro=0.0, magnetometer=0.0, velocimeter=0.0, fix=0.0)
"""Sensors without errors; the fix still comes at its own rate."""
