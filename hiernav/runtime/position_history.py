"""Where the robot was lately: a position fix that comes late is compared with where the robot was when it was made."""

from __future__ import annotations

from collections import deque


class PositionHistory:
    """Estimated positions of the last moments, in order of time."""

    def __init__(self, seconds: float) -> None:
        """`seconds`: for how long a position is kept."""
        self._seconds = seconds
        self._entries: deque[list[float]] = deque()

    def add(self, stamp: float, x: float, y: float) -> None:
        """The position at `stamp` [s], which is after all others [m]."""
        self._entries.append([stamp, x, y])
        while self._entries[0][0] < stamp - self._seconds:
            self._entries.popleft()

    def reaches(self, stamp: float) -> bool:
        """Whether positions are known from `stamp` [s] on."""
        return not stamp < self._entries[0][0]

    def at(self, stamp: float) -> tuple[float, float]:
        """The position at `stamp` [s], to which the history reaches [m]."""
        later = self._entries[-1]
        for entry in reversed(self._entries):
            if entry[0] <= stamp:
                share = (stamp - entry[0]) / (later[0] - entry[0]) if later is not entry else 0.0
                return entry[1] + share * (later[1] - entry[1]), entry[2] + share * (later[2] - entry[2])
            later = entry
        return later[1], later[2]

    def shift(self, stamp: float, dx: float, dy: float) -> None:
        """Correct all positions from `stamp` [s] on [m], so that the next late fix is not compared with what is already
        mended."""
        for entry in reversed(self._entries):
            if entry[0] < stamp:
                break
            entry[1] += dx
            entry[2] += dy
