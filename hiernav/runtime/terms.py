"""Observation terms from sensors that may be silent or broken."""

from __future__ import annotations

import numpy as np

from hiernav.runtime.robot import SensorFrame


class TermHold:
    """Observation terms without holes: what a sensor does not give, or gives as NaN, keeps its last good value."""

    def __init__(self) -> None:
        self._last: dict[str, np.ndarray] = {}
        self.held = 0
        """How often a value was held."""

    def fill(self, frame: SensorFrame) -> dict[str, np.ndarray]:
        """Terms by name, (1, d) each. A sensor that never gave a good value reads zero, one never seen is absent."""
        present = frame.terms()
        for name, value in present.items():
            value = np.asarray(value, dtype=np.float64).reshape(1, -1)
            good = np.isfinite(value)
            if not good.all():
                self.held += 1
                value = np.where(good, value, self._last.get(name, np.zeros_like(value)))
            self._last[name] = value
        self.held += sum(name not in present for name in self._last)
        return dict(self._last)
