"""A robot for an adapter's process that writes down what is done to it, and when."""

from __future__ import annotations

import time

import numpy as np

from hiernav.runtime.robot import SensorFrame

PERIOD = 0.02


class ScriptedRobot:
    """Notes "send", "brake" and "close" with the monotonic time in a file, unbuffered."""

    control_period = PERIOD
    action_dim = 2

    def __init__(self, path: str) -> None:
        self._file = open(path, "ab", buffering=0)

    def read(self) -> SensorFrame:
        still = np.zeros(3)
        return SensorFrame(time.monotonic(), still, still, np.array([0.0, -0.5, 0.0]), still, position_fix=np.zeros(2))

    def send(self, action: np.ndarray) -> np.ndarray:
        self._note("send")
        return action

    def brake(self) -> None:
        self._note("brake")

    def close(self) -> None:
        self._note("close")

    def fail(self) -> None:
        raise OSError("bus error")

    def _note(self, what: str) -> None:
        self._file.write(f"{what} {time.monotonic()}\n".encode())


def make(path: str) -> ScriptedRobot:
    return ScriptedRobot(path)
