"""Left-right mirrors of the robots: every transition has a twin that is just as true.

A mirror permutes and negates the entries of observation and action. Point and doggo are symmetric in the vertical
plane through their x axis; the car, which drives along its y axis, in the one through that. The magnetic field of the
simulation lies along the world's y axis, which fixes how the magnetometer's reading changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hiernav.nav.observation import ObservationLayout

_LEGS = [3, 2, 1, 0]
"""Leg 1 (front left) trades with 4, 2 (rear left) with 3."""
_JOINTS = [4 * kind + leg for kind in range(3) for leg in _LEGS]


@dataclass(frozen=True)
class Mirror:
    """Value i of the mirrored vector is `sign[i] * vector[index[i]]`."""

    observation_index: np.ndarray
    """(D,) int"""
    observation_sign: np.ndarray
    """(D,) float32"""
    action_index: np.ndarray
    """(A,) int"""
    action_sign: np.ndarray
    """(A,) float32"""

    def observation(self, values: np.ndarray) -> np.ndarray:
        """Mirrored observations (..., D)."""
        return values[..., self.observation_index] * self.observation_sign

    def action(self, values: np.ndarray) -> np.ndarray:
        """Mirrored actions (..., A)."""
        return values[..., self.action_index] * self.action_sign


def mirror_of(robot: str, layout: ObservationLayout) -> Mirror:
    """The mirror of a robot's observations in `layout`, and of its actions.

    Raises:
        ValueError: the robot, or a term of its layout, has no known mirror, or one of another size.
    """
    if robot not in _ROBOTS:
        raise ValueError(f"robot {robot!r} has no known mirror; known: {', '.join(_ROBOTS)}")
    across, (order, signs) = _ROBOTS[robot]
    terms = {**across, **_OWN}
    parts = []
    for term in layout.terms:
        if term.name not in terms:
            raise ValueError(f"observation term {term.name!r} has no known mirror")
        if len(terms[term.name][0]) != term.size:
            raise ValueError(
                f"observation term {term.name!r} has {term.size} values, its mirror {len(terms[term.name][0])}"
            )
        parts.append(terms[term.name])
    starts = np.cumsum([0, *(term.size for term in layout.terms)])
    return Mirror(
        np.concatenate([start + np.asarray(own) for start, (own, _) in zip(starts, parts, strict=False)]),
        np.concatenate([np.asarray(own, dtype=np.float32) for _, own in parts]),
        np.asarray(order),
        np.asarray(signs, dtype=np.float32),
    )


Rule = tuple[Sequence[int], Sequence[float]]


def _flip(*signs: float, repeat: int = 1) -> Rule:
    return list(range(len(signs) * repeat)), list(signs) * repeat


_ACROSS_Y: dict[str, Rule] = {
    "accelerometer": _flip(1, -1, 1),
    "velocimeter": _flip(1, -1, 1),
    "gyro": _flip(-1, 1, -1),
    "magnetometer": _flip(-1, 1, -1),
    "lidar": (list(range(9, -1, -1)), [1.0] * 10),
    "waypoints": _flip(1, -1, repeat=10),
    "world_waypoints": _flip(1, -1, repeat=10),
    "goal": _flip(1, -1),
}
_ACROSS_X: dict[str, Rule] = {
    "accelerometer": _flip(-1, 1, 1),
    "velocimeter": _flip(-1, 1, 1),
    "gyro": _flip(1, -1, -1),
    "magnetometer": _flip(-1, 1, 1),
    "lidar": ([(4 - i) % 10 for i in range(10)], [1.0] * 10),
    "waypoints": _flip(-1, 1, repeat=10),
    "world_waypoints": _flip(-1, 1, repeat=10),
    "goal": _flip(-1, 1),
}
_OWN: dict[str, Rule] = {
    "clock": _flip(-1, -1),  # half a period later: what the left legs did then, the right ones do now
    "rear_rotation": _flip(1, -1, -1, -1, 1, 1, -1, 1, 1),
    "rear_velocity": _flip(1, -1, -1),
    "joint_sin": (_JOINTS, [1.0] * 12),
    "joint_cos": (_JOINTS, [1.0] * 12),
    "joint_velocity": (_JOINTS, [1.0] * 12),
}
_ROBOTS: dict[str, tuple[dict[str, Rule], Rule]] = {
    "point": (_ACROSS_Y, _flip(1, -1)),
    "car": (_ACROSS_X, ([1, 0], [1.0, 1.0])),
    "doggo": (_ACROSS_Y, (_JOINTS, [1.0] * 12)),
}
"""How what every robot observes is mirrored, `_ACROSS_Y` for one whose forward is x, and its actions."""
