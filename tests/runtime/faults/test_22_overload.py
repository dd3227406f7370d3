"""A machine that stalls or is overloaded: deadlines are skipped, not caught up; three in a row are waited out."""

from __future__ import annotations

import multiprocessing

import numpy as np
import pytest
from puck import GOAL, Listener, Puck, Scripted, driver_of
from punctual import punctual

from hiernav.runtime.clock import FakeClock, MonotonicClock
from hiernav.runtime.supervisor import Mode

PERIOD = 0.02


def drive(stall_at: dict[int, float]) -> tuple[Listener, object, object]:
    clock, seen = FakeClock(), Listener()

    def script(step: int, straight: np.ndarray) -> np.ndarray:
        clock.advance(stall_at.get(step, 0.0))
        return straight

    driver = driver_of(Puck(control_period=PERIOD, noise=1e-3), Scripted(script), clock=clock, observers=[seen])
    return seen, driver, driver.run(GOAL)


def test_a_stall_of_200_ms_is_skipped_without_a_burst():
    seen, driver, result = drive({10: 0.205})
    times = np.array([record.time for record in seen.records])
    gaps = np.round(np.diff(times) / PERIOD).astype(int)
    assert gaps[10] == 11 and (np.delete(gaps, 10) == 1).all()
    assert driver.loop.overruns == 10
    assert result.reached and not result.holds


def test_three_overruns_in_a_row_are_waited_out_and_then_driven_on():
    seen, driver, result = drive({10: 0.03, 11: 0.03, 12: 0.03})
    held = [record for record in seen.records if record.mode is Mode.HOLD]
    assert held[0].index == 13 and all(record.sent is None for record in held)
    assert len(held) == 10
    assert result.reached and result.holds == {"3 overruns in a row": 1}


def test_two_overruns_in_a_row_are_driven_through():
    _, _, result = drive({10: 0.03, 11: 0.03})
    assert result.reached and not result.holds


def _hog() -> None:
    while True:
        pass


@pytest.mark.realtime
def test_two_hogs_cost_at_most_2_percent_of_the_ticks():
    hogs = [multiprocessing.Process(target=_hog, daemon=True) for _ in range(2)]
    driver = driver_of(Puck(control_period=PERIOD, noise=1e-3), clock=MonotonicClock())
    for hog in hogs:
        hog.start()
    try:
        with punctual():
            driver.run(np.array([1.95, 1.95]), max_steps=10**6)
    finally:
        for hog in hogs:
            hog.kill()
            hog.join()
    assert driver.loop.ticks > 100
    assert driver.loop.overruns <= 0.02 * driver.loop.ticks
