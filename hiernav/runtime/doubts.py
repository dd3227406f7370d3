"""Which readings of a sensor are believed: a lone one that fits nothing is a spike, many that agree are the truth."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from hiernav.runtime.estimate import EstimatorConfig


class _First(NamedTuple):
    """A first reading, or the newest that took its place."""

    reading: Sequence[float]
    stamp: float
    """Of its frame [s]."""
    others: int
    """Readings so far that did not agree with the one before."""


class Doubts:
    """Remembers first readings that no other has confirmed yet, and readings that were rejected in a row."""

    def __init__(self, config: EstimatorConfig, counts: Counter[str]) -> None:
        """
        Args:
            config: how many readings must agree, and how well.
            counts: of all that is rejected (`..._rejected`) or believed after all (`..._reinit`), which is added to.
        """
        self._config, self._counts = config, counts
        self._unsure: dict[str, _First] = {}
        """By sensor, the first reading, as long as no other has agreed with it."""
        self._rejected: Counter[str] = Counter()
        self._rejected_at: dict[str, float] = {}
        self._last_miss: dict[str, tuple[float, ...]] = {}

    @property
    def unsure(self) -> Iterable[str]:
        """Sensors with a first reading that no other has agreed with yet."""
        return self._unsure

    def accept(self, sensor: str) -> None:
        """A measurement was used."""
        self._rejected[sensor] = 0

    def reject(self, sensor: str, miss: tuple[float, ...], stamp: float, spread: float) -> bool:
        """Count a measurement that was rejected at `stamp` [s].

        True if it is to be believed after all: there were so many in a row that the state must be wrong, and it agrees
        to `spread` with the one before, so that it is no lone spike.
        """
        last = self._last_miss.get(sensor)
        self._last_miss[sensor] = miss
        agrees = last is not None and math.dist(miss, last) <= spread
        self._counts[f"{sensor}_rejected"] += 1
        self._rejected[sensor] += 1
        self._rejected_at[sensor] = stamp
        if self._rejected[sensor] < self._patience(sensor) or not agrees:
            return False
        self._counts[f"{sensor}_reinit"] += 1
        return True

    def begin(self, sensor: str, reading: Sequence[float], stamp: float, others: int = 0) -> None:
        """Drive on no reading that may be a spike, before another agrees with it."""
        if self._config.confirm:
            self._unsure[sensor] = _First(reading, stamp, others)

    def confirm(self, sensor: str, reading: Sequence[float], stamp: float, patience: float) -> None:
        """A reading agrees with the first. The same to the bit is that one shown again, unless it stays for long."""
        first = self._unsure.get(sensor)
        if first is not None and (reading != first.reading or stamp - first.stamp >= patience):
            del self._unsure[sensor]

    def agrees_roughly(self, sensor: str, reading: Sequence[float], miss: tuple[float, ...], stamp: float) -> bool:
        """Whether a reading that takes the place of the first one is to be believed, though it does not pass the gate.

        Only where many others did not either: then the sensor is noisier than it is said to be.
        """
        others = self._unsure[sensor].others + 1
        self._counts[f"{sensor}_rejected"] += 1
        self._rejected_at[sensor] = stamp
        if others < self._config.reinit_after or math.hypot(*miss) > self._config.reinit_spread:
            self.begin(sensor, reading, stamp, others)
            return False
        del self._unsure[sensor]
        return True

    def may_yet_be_believed(self, sensor: str, stamp: float) -> bool:
        """Whether a sensor speaks, is rejected, and has not had as many measurements as would be believed after all."""
        speaks = stamp - self._rejected_at.get(sensor, -math.inf) < self._config.hold_after
        unsure = sensor in self._unsure and self._unsure[sensor].others < self._config.reinit_after
        return speaks and (unsure or 0 < self._rejected[sensor] < self._patience(sensor))

    def _patience(self, sensor: str) -> int:
        """Rejected measurements in a row after which the state must be wrong."""
        return self._config.resync_after if sensor in ("velocimeter", "gyro") else self._config.reinit_after
