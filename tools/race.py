"""Fair timing: all contenders in turn, in short stretches of one run, so that they see the same machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np

Stretch = Callable[[float], tuple[int, float]]
"""Seconds to run for -> what was counted, and the seconds it took."""


def race(contenders: Mapping[str, Stretch], seconds: float, stretch: float = 0.25) -> dict[str, np.ndarray]:
    """Each contender's stretches (S, 2) of counts and seconds, about `seconds` of them all told."""
    laps: dict[str, list[tuple[int, float]]] = {name: [] for name in contenders}
    for run in contenders.values():
        run(stretch)
    for _ in range(max(3, round(seconds / stretch))):
        for name, run in contenders.items():
            laps[name].append(run(stretch))
    return {name: np.array(each) for name, each in laps.items()}


def typical(laps: dict[str, np.ndarray]) -> dict[str, float]:
    """Median rates: for work that is the same each time, whatever else the machine did meanwhile."""
    return {name: float(np.median(each[:, 0] / each[:, 1])) for name, each in laps.items()}


def overall(laps: dict[str, np.ndarray]) -> dict[str, float]:
    """Mean rates: for work whose rare parts count too."""
    return {name: float(each[:, 0].sum() / each[:, 1].sum()) for name, each in laps.items()}


def timed(run: Callable[[], int], seconds: float) -> tuple[int, float]:
    """Call `run` for some time; what it counted and the time it took."""
    count, began = 0, time.perf_counter()
    while (spent := time.perf_counter() - began) < seconds:
        count += run()
    return count, spent
