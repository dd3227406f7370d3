"""A robot whose sensors can be made to fail, for rehearsals: in tests, and from the live page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from hiernav.runtime.robot import VECTOR_SENSORS, Robot, SensorFrame

Damage = Callable[[SensorFrame, SensorFrame, np.random.Generator], SensorFrame]
"""From a frame, the frame at which the fault began, and randomness, to what the robot says instead."""


def _silent(frame: SensorFrame, began: SensorFrame, rng: np.random.Generator) -> SensorFrame:
    return SensorFrame(frame.stamp, lidar=frame.lidar, extra=frame.extra)


def _no_fix(frame: SensorFrame, began: SensorFrame, rng: np.random.Generator) -> SensorFrame:
    return replace(frame, position_fix=None, fix_stamp=None)


def _frozen_gyro(frame: SensorFrame, began: SensorFrame, rng: np.random.Generator) -> SensorFrame:
    return replace(frame, gyro=began.gyro)


def _nan_velocity(frame: SensorFrame, began: SensorFrame, rng: np.random.Generator) -> SensorFrame:
    return replace(frame, velocimeter=np.full(3, np.nan))


def _spikes(frame: SensorFrame, began: SensorFrame, rng: np.random.Generator) -> SensorFrame:
    changes: dict[str, Any] = {}
    for name in (*VECTOR_SENSORS, "position_fix"):
        value = getattr(frame, name)
        if value is not None and rng.random() < 0.05:
            changes[name] = value + rng.choice([-1.0, 1.0], np.shape(value)) * 10.0 ** rng.uniform(-0.5, 1.5)
    return replace(frame, **changes)


def _moved_fix(frame: SensorFrame, began: SensorFrame, rng: np.random.Generator) -> SensorFrame:
    return frame if frame.position_fix is None else replace(frame, position_fix=frame.position_fix + (0.7, 0.7))


FAULTS: dict[str, tuple[Damage, float]] = {
    "all sensors silent for 0.5 s": (_silent, 0.5),
    "all sensors silent for 2 s": (_silent, 2.0),
    "no position fix for 4 s": (_no_fix, 4.0),
    "gyro frozen for 0.6 s": (_frozen_gyro, 0.6),
    "velocity NaN for 0.4 s": (_nan_velocity, 0.4),
    "spikes on 5 % of all samples for 5 s": (_spikes, 5.0),
    "position fix off by 1 m for 2 s": (_moved_fix, 2.0),
}
"""Faults by name, and how long they last [s]."""


class FaultyRobot:
    """Passes everything through to a robot, and damages what its sensors say while a fault lasts."""

    def __init__(self, robot: Robot, seed: int = 0) -> None:
        self.robot = robot
        self._rng = np.random.default_rng(seed)
        self._asked: list[str] = []
        self._active: list[tuple[Damage, SensorFrame, float]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.robot, name)

    def inject(self, name: str) -> None:
        """Let a fault begin at the next frame.

        Raises:
            KeyError: there is no such fault.
        """
        if name not in FAULTS:
            raise KeyError(name)
        self._asked.append(name)

    def read(self) -> SensorFrame:
        frame = self.robot.read()
        while self._asked:
            damage, seconds = FAULTS[self._asked.pop()]
            self._active.append((damage, frame, frame.stamp + seconds))
        self._active = [each for each in self._active if each[1].stamp <= frame.stamp < each[2]]
        for damage, began, _ in self._active:
            frame = damage(frame, began, self._rng)
        return frame
