"""What sensors of different rates said since the loop looked last, as one frame."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

from hiernav.runtime.robot import READINGS, VECTOR_SENSORS, SensorFrame

GATHERED = tuple(name for name in READINGS if name != "position_fix")
"""A fix has a stamp of its own, and is shown until the next one (`Adapter`)."""


class Gathering:
    """Fills what a frame lacks from the frames before it that the loop has not taken.

    An adapter reads a robot several times in a control period, and the loop takes the newest frame alone: it would miss
    whatever came in between. Of each sensor the newest reading is shown, and not again once it was taken.
    """

    def __init__(self, period: float) -> None:
        """
        Args:
            period: of the control loop; a reading older than two of them is not worth showing any more [s].
        """
        self._oldest = 2.0 * period
        self._waiting: deque[tuple[int, SensorFrame]] = deque(maxlen=64)

    def add(self, frame: SensorFrame, number: int, taken: int) -> SensorFrame:
        """The frame that is to be shown.

        Its stamp is that of the newest one in which an inertial sensor spoke, or `frame`'s if none did.

        Args:
            frame: newest of the robot.
            number: under which it will be shown, one more than that of the last.
            taken: number of the last one that the loop took.
        """
        waiting = self._waiting
        while waiting and not (waiting[0][0] > taken and 0.0 <= frame.stamp - waiting[0][1].stamp <= self._oldest):
            waiting.popleft()
        waiting.append((number, frame))
        if len(waiting) == 1:
            return frame
        frames = [each for _, each in reversed(waiting)]
        fills: dict[str, Any] = {}
        for name in GATHERED:
            if getattr(frame, name) is None:
                fills[name] = next((value for each in frames if (value := getattr(each, name)) is not None), None)
        extra: dict[str, Any] = {}
        for each in reversed(frames):
            extra.update(each.extra)
        spoke = (each.stamp for each in frames if any(getattr(each, name) is not None for name in VECTOR_SENSORS))
        stamp = next(spoke, frame.stamp)
        fix_stamp = frame.fix_stamp
        if fix_stamp is None and frame.position_fix is not None:
            fix_stamp = frame.stamp
        return replace(frame, **fills, stamp=stamp, extra=extra, fix_stamp=fix_stamp)

    def forget(self) -> None:
        """The robot has started anew."""
        self._waiting.clear()
