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
        ValueError: the robot, or a term of its layout, has no known mirror.
    """
    if robot not in _ACTIONS:
        raise ValueError(f"robot {robot!r} has no known mirror; known: {', '.join(_ACTIONS)}")
    terms = {**(_ACROSS_X if robot == "car" else _ACROSS_Y), **_OWN}
    index, sign, start = [], [], 0
    for term in layout.terms:
        if term.name not in terms:
            raise ValueError(f"observation term {term.name!r} has no known mirror")
        order, signs = terms[term.name]
        index.append(start + np.asarray(order))
        sign.append(np.asarray(signs, dtype=np.float32))
        start += term.size
    order, signs = _ACTIONS[robot]
    return Mirror(np.concatenate(index), np.concatenate(sign), np.asarray(order), np.asarray(signs, dtype=np.float32))


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
_ACTIONS: dict[str, Rule] = {"point": _flip(1, -1), "car": ([1, 0], [1.0, 1.0]), "doggo": (_JOINTS, [1.0] * 12)}
