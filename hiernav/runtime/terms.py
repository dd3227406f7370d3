"""Observation terms from sensors that may be silent or broken."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hiernav.runtime.robot import ABSURD, SIZES, SensorFrame

_LIMIT = ABSURD * ABSURD


def is_sound(name: str, value: np.ndarray) -> bool:
    """Whether every component of an observation term is finite and within what its sensor can read."""
    # One short call finds NaN, infinity and absurd numbers alike; the square of a length may be too strict by a factor.
    if not np.vdot(value, value) < _LIMIT:
        return False
    if name != "lidar":
        return True
    closeness = value.ravel().tolist()
    return 0.0 <= min(closeness, default=0.0) and max(closeness, default=0.0) <= 1.0


class TermHold:
    """Observation terms without holes: what a sensor does not give, or gives as nonsense, keeps its last good value."""

    def __init__(self, sizes: Mapping[str, int] | None = None) -> None:
        """
        Args:
            sizes: how many values each sensor gives that the skill observes; None: as many as come.
        """
        self._sizes = SIZES | dict(sizes or {})
        self._last: dict[str, np.ndarray] = {}

    def fill(self, frame: SensorFrame) -> dict[str, np.ndarray]:
        """Terms by name, (1, d) each, after taking in a frame; once per tick.

        A component that was never good reads zero. A reading of another size than its sensor's is none; a sensor
        without any is absent.
        """
        last = self._last
        for name, value in frame.terms().items():
            value, before = np.asarray(value, dtype=np.float64).reshape(1, -1), last.get(name)
            if value.size != self._sizes.get(name, value.size):
                continue
            if not is_sound(name, value):
                good = (0.0 <= value) & (value <= 1.0) if name == "lidar" else np.abs(value) < ABSURD
                if before is None or before.shape != value.shape:
                    before = np.zeros_like(value)
                value = np.where(good, value, before)
            last[name] = value
        return dict(last)
