"""The skill's observation: one list of terms, read by one builder, shipped with every model.

Sizes are those of the paper's state table: 42 point, 54 car, 78 doggo. Values are raw SI units; `scale` is applied
inside the network, so a robot never has to know it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ObservationTerm:
    """One sensor: its name, number of values, unit, and the factor that brings it to order one."""

    name: str
    size: int
    unit: str
    scale: float


@dataclass(frozen=True)
class ObservationLayout:
    """Order of the terms in the observation vector."""

    terms: tuple[ObservationTerm, ...]

    @property
    def size(self) -> int:
        return sum(term.size for term in self.terms)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(term.name for term in self.terms)

    @property
    def sensors(self) -> dict[str, int]:
        """Name and size of the terms that a robot's sensors give, which are all but `GUIDES`."""
        return {term.name: term.size for term in self.terms if term.name not in GUIDES}

    @property
    def scale(self) -> np.ndarray:
        """(D,) float32, factor of each value."""
        return np.concatenate([np.full(t.size, t.scale, dtype=np.float32) for t in self.terms])

    @property
    def slices(self) -> dict[str, slice]:
        """Columns of each term, by name."""
        ends = np.cumsum([0] + [term.size for term in self.terms])
        return {t.name: slice(int(a), int(b)) for t, a, b in zip(self.terms, ends[:-1], ends[1:], strict=True)}

    def build(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Concatenate named arrays (N, d) to observations (N, D) float32.

        Raises:
            KeyError: a term has no value.
            ValueError: a value has the wrong size.
        """
        columns = []
        for term in self.terms:
            if term.name not in values:
                raise KeyError(f"observation term {term.name!r} has no value; given: {', '.join(sorted(values))}")
            value = np.asarray(values[term.name])
            value = value.reshape(len(value), -1)
            if value.shape[1] != term.size:
                raise ValueError(f"observation term {term.name!r} has {value.shape[1]} values, expected {term.size}")
            columns.append(value)
        return np.concatenate(columns, axis=1).astype(np.float32)


_BASE = (
    ObservationTerm("accelerometer", 3, "m/s^2", 0.1),
    ObservationTerm("velocimeter", 3, "m/s", 1.0),
    ObservationTerm("gyro", 3, "rad/s", 0.3),
    ObservationTerm("magnetometer", 3, "MuJoCo units", 2.0),
    ObservationTerm("lidar", 10, "closeness", 1.0),
)
_WAYPOINTS = ObservationTerm("waypoints", 20, "m, body frame", 2.0)
_WORLD_WAYPOINTS = ObservationTerm("world_waypoints", 20, "m, world frame", 0.5)
_GOAL = ObservationTerm("goal", 2, "m, body frame", 0.5)
WAYPOINT_GUIDES = (_WAYPOINTS.name, _WORLD_WAYPOINTS.name)
GUIDES = (*WAYPOINT_GUIDES, _GOAL.name, "clock")
"""Terms that the agent adds to those of the robot's sensors."""
CLOCK_HZ = 3.0
"""Frequency of the gait clock: about that of the fastest gaits of the quadruped under open-loop sinusoids."""
_CLOCK = ObservationTerm("clock", 2, f"sine and cosine of {CLOCK_HZ:g} Hz", 1.0)


def observation_layout(
    own: Sequence[ObservationTerm], guidance: str = "waypoints", clock: bool = False
) -> ObservationLayout:
    """The layout of a robot's skill.

    Args:
        own: terms that only this robot has (`RobotSpec.own_terms`).
        guidance: "waypoints" (path-conditioned), "goal" (the paper's baseline), or "world_waypoints" (in the
            world frame, where the others are in the body frame: to show what that is good for).
        clock: whether the skill sees a gait clock (beyond the paper). A gait is periodic: with the clock it is a
            function of the observation, and no pose of the robot is one that its mean action holds for ever.
    """
    guides = {term.name: term for term in (_WAYPOINTS, _WORLD_WAYPOINTS, _GOAL)}
    if guidance not in guides:
        raise ValueError(f"unknown guidance {guidance!r}; known: {', '.join(guides)}")
    return ObservationLayout((*_BASE, guides[guidance], *own, *((_CLOCK,) if clock else ())))


def clock_phase(time: np.ndarray) -> np.ndarray:
    """The gait clock (N, 2) at times (N,) since the start of the episode [s]."""
    angle = 2.0 * np.pi * CLOCK_HZ * np.asarray(time, dtype=np.float64)
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1)
