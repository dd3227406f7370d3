"""The wall clock is set forward and back by an hour while the robot drives."""

from __future__ import annotations

import time

import numpy as np
from recorded_drive import Memory, drive, equal

from hiernav.runtime.clock import MonotonicClock
from hiernav.runtime.loop import FixedRateLoop


def test_setting_the_wall_clock_changes_nothing_in_a_drive(monkeypatch):
    calm, jumping = Memory(), Memory()
    expected = drive(calm, seed=2)
    jumps = iter(np.tile([3600.0, -7200.0, 3600.0], 10**6).cumsum())
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + next(jumps))
    monkeypatch.setattr(time, "time_ns", lambda: int((now() + next(jumps)) * 1e9))
    result = drive(jumping, seed=2)
    assert (result.reason, result.steps, result.seconds) == (expected.reason, expected.steps, expected.seconds)
    assert all(equal(a.sent, b.sent) and equal(a.estimate, b.estimate)
               for a, b in zip(calm.records, jumping.records, strict=True))  # fmt: skip


def test_the_real_loop_neither_waits_nor_hurries_when_the_wall_clock_is_set(monkeypatch):
    began = time.monotonic()
    times: list[float] = []

    def tick(now: float) -> bool:
        times.append(now)
        hour = 3600.0 * (-1) ** len(times)
        monkeypatch.setattr(time, "time", lambda: hour)
        return len(times) == 20

    loop = FixedRateLoop(MonotonicClock(), 0.005, tick, lambda: None)
    loop.run()
    # not before the twentieth deadline, however many a busy machine has missed
    assert times[-1] - began >= 19 * 0.005
    assert time.monotonic() - began < 30.0
