"""A robot for an adapter's process that writes down what is done to it, and when, and fails where it is told to."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from hiernav.runtime.robot import SensorFrame

PERIOD = 0.02


class ScriptedRobot:
    """Notes "send", "brake" and "close" with the monotonic time in a file, unbuffered.

    What `fails` names works `good` times, then raises `failures` times. The first `slow_reads` readings take `slow`
    seconds each, and every brake `slow_brake`.
    """

    control_period = PERIOD
    action_dim = 2

    def __init__(
        self,
        path: str,
        fails: str = "",
        good: int = 0,
        failures: int = 1,
        slow: float = 0.0,
        slow_reads: int = 1,
        slow_brake: float = 0.0,
    ) -> None:
        self._file = open(path, "ab", buffering=0)
        self._fails, self._good, self._failures = fails, good, failures
        self._done, self._slow, self._slow_reads, self._slow_brake = 0, slow, slow_reads, slow_brake

    def read(self) -> SensorFrame:
        self._try("read")
        time.sleep(self._slow if self._slow_reads > 0 else 0.0)
        self._slow_reads -= 1
        still = np.zeros(3)
        return SensorFrame(time.monotonic(), still, still, np.array([0.0, -0.5, 0.0]), still, position_fix=np.zeros(2))

    def send(self, action: np.ndarray) -> np.ndarray:
        self._note("send")
        return action

    def brake(self) -> None:
        self._note("brake")
        time.sleep(self._slow_brake)

    def close(self) -> None:
        self._note("close")

    def fail(self) -> None:
        raise OSError("bus error")

    def _note(self, what: str) -> None:
        self._file.write(f"{what} {time.monotonic()}\n".encode())
        self._try(what)

    def _try(self, what: str) -> None:
        self._done += what == self._fails
        if what == self._fails and self._good < self._done <= self._good + self._failures:
            raise OSError(f"{what}: bus error")


def write_adapter(log: Path, file: Path) -> Path:
    """A file whose `make`, without arguments, makes a robot that writes to `log`."""
    file.write_text(
        f"import sys\nsys.path.insert(0, {str(Path(__file__).parent)!r})\nimport scripted_robot\n"
        f"def make():\n    return scripted_robot.make({str(log)!r})\n"
    )
    return file


def make(path: str, **manners: Any) -> ScriptedRobot:
    return ScriptedRobot(path, **manners)
