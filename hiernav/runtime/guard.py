"""The last thing an action passes before the robot. It is always on: there is no switch to disable it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

MOST_BRAKED = 20
"""Ticks in a row that may be braked, at most, before it is a fault."""


@dataclass(frozen=True)
class GuardConfig:
    """Limits of what may reach the robot."""

    low: float = -1.0
    """Smallest command of an actuator."""
    high: float = 1.0
    """Largest command of an actuator."""
    slew_limit: float | None = None
    """Largest change of a command from one tick to the next; None where a policy was trained without it."""
    max_non_finite: int = 3
    """Actions with NaN or inf in a row that are a fault; a single one brakes for its tick."""
    tilt_limit: float | None = None
    """Angle of the body's z axis to the vertical that is a fault [rad]; None for a robot that cannot tilt."""
    max_tilted: int = 3
    """Ticks in a row beyond the tilt limit that are a fault; each of them is braked."""
    slow_ttc: float | None = None
    """Below this time to collision with the known map commands are scaled down in proportion [s]; None never does."""
    slowed: tuple[int, ...] | None = None
    """Actuators that are scaled, those that make the robot faster; all if None."""
    saturation: float | None = None
    """Command of these beyond which the robot gets no faster: what is scaled is at most that; None where there is none.
    """
    drive: float | None = None
    """Bearing in the body frame towards which they drive the robot together [rad]: what they have in common is scaled,
    unless it brakes, and what they differ by, which turns it, is left. None scales every command by itself."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= 0.0 <= self.high):
            raise ValueError(f"GuardConfig: limits {self.low} to {self.high} must be finite and include 0, the brake")
        if self.slew_limit is not None and not 0.0 < self.slew_limit < math.inf:
            raise ValueError(f"GuardConfig.slew_limit = {self.slew_limit} must be finite and positive, or None")
        if self.tilt_limit is not None and not 0.0 < self.tilt_limit < 0.5 * math.pi:
            raise ValueError(f"GuardConfig.tilt_limit = {self.tilt_limit} rad must be in (0, pi/2), or None")
        if self.slow_ttc is not None and not 0.0 < self.slow_ttc < math.inf:
            raise ValueError(f"GuardConfig.slow_ttc = {self.slow_ttc} s must be finite and positive, or None")
        if self.saturation is not None and not 0.0 < self.saturation < math.inf:
            raise ValueError(f"GuardConfig.saturation = {self.saturation} must be finite and positive, or None")
        if self.drive is not None and not math.isfinite(self.drive):
            raise ValueError(f"GuardConfig.drive = {self.drive} rad must be finite, or None")
        for name in ("max_non_finite", "max_tilted"):
            if not 1 <= getattr(self, name) <= MOST_BRAKED:
                raise ValueError(f"GuardConfig.{name} = {getattr(self, name)} must be from 1 to {MOST_BRAKED}")

    def limited(self, slew_limit: float | None) -> GuardConfig:
        """The same with the lower of this slew limit, that of a bundle, and its own; None is no limit."""
        limits = [limit for limit in (self.slew_limit, slew_limit) if limit is not None]
        return replace(self, slew_limit=min(limits, default=None))


@dataclass(frozen=True)
class Guarded:
    """What may be sent to the robot."""

    action: np.ndarray
    """(A,) float64, finite and within the limits."""
    fault: str | None = None
    """Why the run must end, or None."""
    scale: float = 1.0
    """Factor by which the robot was slowed down."""
    brake: bool = False
    """Whether the robot is to be braked instead: `action` is zeros, which need not be its brake."""


class Guard:
    """Makes actions safe: clips, slows and slews them, and brakes where one is not finite or the robot has tilted."""

    def __init__(self, action_dim: int, config: GuardConfig | None = None) -> None:
        """
        Raises:
            ValueError: `action_dim` is below 1, or `config.slowed` names an actuator that the robot does not have.
        """
        if action_dim < 1:
            raise ValueError(f"Guard: action_dim {action_dim} must be at least 1")
        self.action_dim = action_dim
        self.config = config or GuardConfig()
        self.counts: Counter[str] = Counter()
        """How often it acted: non_finite, clipped, slewed, tilted, slowed, slowed_for_plan."""
        limit = self.config.tilt_limit
        self._slowed = list(range(action_dim)) if self.config.slowed is None else list(self.config.slowed)
        if not set(self._slowed) <= set(range(action_dim)):
            raise ValueError(f"GuardConfig.slowed = {self._slowed}: the robot's actuators are 0 to {action_dim - 1}")
        self._least_upright = -math.inf if limit is None else math.cos(limit)
        self.reset()

    def reset(self) -> None:
        """A new run begins from standstill; counts are kept."""
        self.braked()
        self._non_finite = 0

    def braked(self, upright: float | None = None) -> str | None:
        """The robot got the brake, past this guard: what follows starts from zero.

        Args:
            upright: as in `check`; a robot may fall while it is braked, too.

        Returns:
            Why that is a fault, or None.
        """
        self._last = [0.0] * self.action_dim
        return self._tilt_fault(upright)

    def check(
        self,
        action: np.ndarray,
        upright: float | None = None,
        ttc: float = math.inf,
        speed: float = 1.0,
        velocity: tuple[float, float] = (0.0, 0.0),
    ) -> Guarded:
        """Make `action` safe to send.

        Args:
            action: (A,) from the policy, possibly garbage.
            upright: z component of the body's z axis; None where it is not known. NaN counts as fallen.
            ttc: time to collision with the known map [s].
            speed: factor in [0, 1] by which the robot is to be slowed down for another reason.
            velocity: forward and left, in the body's frame [m/s]; tells what `GuardConfig.drive` spares.
        """
        fault = self._tilt_fault(upright)
        if self._tilted:  # lying down it must not move, whether that is a fault yet or not
            return Guarded(self._brake(), fault, brake=True)
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (self.action_dim,):
            fault = f"action has shape {action.shape}, the robot takes ({self.action_dim},)"
            return Guarded(self._brake(), fault, brake=True)
        if not np.isfinite(action).all():
            return self._refuse(action)
        self._non_finite = 0
        # A handful of numbers: Python's own comparisons take a fraction of numpy's calls.
        low, high, slew = self.config.low, self.config.high, self.config.slew_limit
        values = action.tolist()
        limited = [min(max(value, low), high) for value in values]
        if limited != values:
            self.counts["clipped"] += 1
        scale = self._scale(ttc, speed)
        if scale < 1.0:
            self._slow(limited, scale, velocity)
        if slew is not None:
            steady = [min(max(v, last - slew), last + slew) for v, last in zip(limited, self._last, strict=True)]
            if steady != limited:
                self.counts["slewed"] += 1
            limited = steady
        self._last = limited
        return Guarded(np.array(limited), scale=scale)

    def _slow(self, action: list[float], scale: float, velocity: tuple[float, float]) -> None:
        """Scale what makes the robot faster, in place."""
        most, drive = self.config.saturation or math.inf, self.config.drive
        held = {k: min(max(action[k], -most), most) for k in self._slowed}
        if drive is None:
            for k, value in held.items():
                action[k] = scale * value
            return
        common = sum(held.values()) / max(len(held), 1)
        if common * (velocity[0] * math.cos(drive) + velocity[1] * math.sin(drive)) < 0.0:
            return
        for k, value in held.items():
            action[k] = value - (1.0 - scale) * common

    def _scale(self, ttc: float, speed: float) -> float:
        if speed < 1.0:
            self.counts["slowed_for_plan"] += 1
        slow = self.config.slow_ttc
        if slow is not None and not ttc >= slow:
            self.counts["slowed"] += 1
            speed = min(speed, max(ttc, 0.0) / slow) if ttc == ttc else 0.0
        return max(speed, 0.0)

    def _refuse(self, action: np.ndarray) -> Guarded:
        self.counts["non_finite"] += 1
        self._non_finite += 1
        fault = None
        if self._non_finite >= self.config.max_non_finite:
            channel = int(np.flatnonzero(~np.isfinite(action))[0])
            fault = f"action not finite {self._non_finite} times in a row, first in channel {channel}"
        return Guarded(self._brake(), fault, brake=True)

    def _tilt_fault(self, upright: float | None) -> str | None:
        if self.config.tilt_limit is None or upright is None or upright >= self._least_upright:
            self._tilted = 0
            return None
        self.counts["tilted"] += 1
        self._tilted += 1
        if self._tilted < self.config.max_tilted:
            return None
        angle = math.degrees(math.acos(min(max(upright, -1.0), 1.0))) if math.isfinite(upright) else math.nan
        return f"tilted by {angle:.0f} degrees, the limit is {math.degrees(self.config.tilt_limit):.0f}"

    def _brake(self) -> np.ndarray:
        # The stop is not slewed; what follows it starts from zero again.
        self._last = [0.0] * self.action_dim
        return np.zeros(self.action_dim)
