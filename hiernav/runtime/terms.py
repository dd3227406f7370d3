"""Observation terms from sensors that may be silent or broken."""

from __future__ import annotations

import numpy as np

from hiernav.runtime.robot import SensorFrame


class TermHold:
    """Observation terms without holes: what a sensor does not give, or gives as NaN, keeps its last good value."""

    def __init__(self) -> None:
        self._last: dict[str, np.ndarray] = {}

    def fill(self, frame: SensorFrame) -> dict[str, np.ndarray]:
        """Terms by name, (1, d) each. A sensor that never gave a good value reads zero, one never seen is absent."""
        last = self._last
        for name, value in frame.terms().items():
            value = np.asarray(value, dtype=np.float64).reshape(1, -1)
            # the square of the length is finite only if every component is: one short call instead of three
            if not np.vdot(value, value) < np.inf:
                value = np.where(np.isfinite(value), value, last.get(name, np.zeros_like(value)))
            last[name] = value
        return dict(last)
