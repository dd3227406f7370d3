"""Where the time of a tick goes: histograms of constant memory, one per named section."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

LOWEST_S = 1e-6
HIGHEST_S = 10.0
BUCKET_RATIO = 1.05
_LOG_RATIO = math.log(BUCKET_RATIO)
_LOG_LOWEST = math.log(LOWEST_S)
_BUCKETS = math.ceil(math.log(HIGHEST_S / LOWEST_S) / _LOG_RATIO)


class Histogram:
    """Counts of durations in log-spaced buckets 5 % wide from 1 us to 10 s, with one bucket below and one above."""

    def __init__(self) -> None:
        self._counts = [0] * (_BUCKETS + 2)
        self.count = 0
        self.max = 0.0

    def record(self, seconds: float) -> None:
        """Count one duration [s]. Negative durations count as zero; NaN is refused.

        Raises:
            ValueError: `seconds` is NaN.
        """
        if seconds <= LOWEST_S:
            index = 0
        elif seconds < HIGHEST_S:
            index = min(int((math.log(seconds) - _LOG_LOWEST) / _LOG_RATIO) + 1, _BUCKETS)
        elif seconds >= HIGHEST_S:
            index = _BUCKETS + 1
        else:
            raise ValueError(f"Histogram.record: duration {seconds} is not a number of seconds")
        self._counts[index] += 1
        self.count += 1
        if seconds > self.max:
            self.max = seconds

    def percentile(self, percent: float) -> float:
        """Upper edge [s] of the bucket that holds a percentile, at most `max`; NaN while nothing was counted."""
        if self.count == 0:
            return math.nan
        rank = max(1, math.ceil(self.count * percent / 100.0))
        index, seen = 0, self._counts[0]
        while seen < rank:
            index += 1
            seen += self._counts[index]
        if index > _BUCKETS:
            return self.max
        return min(LOWEST_S * BUCKET_RATIO**index, self.max)

    def summary(self) -> dict[str, float | int | None]:
        """count, p50, p99 and max [s]; None for the times while nothing was counted."""
        if self.count == 0:
            return {"count": 0, "p50": None, "p99": None, "max": None}
        return {"count": self.count, "p50": self.percentile(50), "p99": self.percentile(99), "max": self.max}


class TickTimer:
    """Splits each tick into named sections.

    Call `begin()`, then `mark(name)` after each section, then `end()`. Times come from `stopwatch`, which keeps
    measuring real work when the loop itself runs on a fake clock.
    """

    def __init__(self, sections: tuple[str, ...] = (), stopwatch: Callable[[], float] = time.perf_counter) -> None:
        self.sections: dict[str, Histogram] = {name: Histogram() for name in sections}
        self.tick = Histogram()
        self.last: dict[str, float] = {}
        """Durations of the present tick's sections so far [s]; a new one each tick."""
        self._stopwatch = stopwatch
        self._begun = self._last = stopwatch()
        self._recent: deque[float] = deque(maxlen=64)

    def begin(self) -> None:
        """Start of a tick."""
        self._begun = self._last = self._stopwatch()
        self._recent.append(self._begun)
        self.last = {}

    def mark(self, section: str) -> None:
        """End of `section`, which began at the last mark."""
        now = self._stopwatch()
        elapsed, self._last = now - self._last, now
        self.record(section, elapsed)

    def mark_split(self, section: str, other: str, other_seconds: float) -> None:
        """Like `mark`, where `other_seconds` [s] of the time since the last mark belong to the section `other`."""
        now = self._stopwatch()
        elapsed, self._last = now - self._last, now
        self.record(other, other_seconds)
        self.record(section, max(elapsed - other_seconds, 0.0))

    def record(self, section: str, seconds: float) -> None:
        """Count a duration [s] that was measured elsewhere."""
        histogram = self.sections.get(section)
        if histogram is None:
            histogram = self.sections[section] = Histogram()
        histogram.record(seconds)
        self.last[section] = seconds

    def end(self) -> float:
        """End of the tick; returns its duration [s]."""
        elapsed = self._stopwatch() - self._begun
        self.tick.record(elapsed)
        return elapsed

    @property
    def rate(self) -> float:
        """Ticks per second over the last 64 ticks, for the moment they end: a pause between two runs counts as well.

        0 before the second.
        """
        if len(self._recent) < 2 or self._recent[-1] <= self._recent[0]:
            return 0.0
        return (len(self._recent) - 1) / (self._recent[-1] - self._recent[0])
