from __future__ import annotations

import time

import pytest

from hiernav.runtime.clock import FakeClock, MonotonicClock


def test_a_sleep_never_returns_before_its_deadline():
    clock = MonotonicClock()
    for _ in range(20):
        deadline = clock.now() + 0.001
        clock.sleep_until(deadline)
        assert clock.now() >= deadline


def test_a_deadline_in_the_past_returns_without_sleeping():
    clock = MonotonicClock()
    before = clock.now()
    clock.sleep_until(before - 3600.0)
    assert clock.now() - before < 60.0


def test_without_clock_nanosleep_the_clock_falls_back_to_relative_sleeps(monkeypatch):
    monkeypatch.setattr("hiernav.runtime.clock._find_nanosleep", lambda: None)
    clock = MonotonicClock()
    assert not clock.absolute
    deadline = clock.now() + 0.002
    clock.sleep_until(deadline)
    assert clock.now() >= deadline


def test_a_failing_clock_nanosleep_is_replaced_by_relative_sleeps(monkeypatch):
    monkeypatch.setattr("hiernav.runtime.clock._find_nanosleep", lambda: lambda _: 22)
    clock = MonotonicClock()
    deadline = clock.now() + 0.002
    clock.sleep_until(deadline)
    assert clock.now() >= deadline
    assert not clock.absolute


def test_the_wall_clock_has_no_effect(monkeypatch):
    clock = MonotonicClock()
    before = clock.now()
    monkeypatch.setattr(time, "time", lambda: 3600.0)
    assert 0.0 <= clock.now() - before < 60.0


def test_a_fake_clock_moves_only_when_told():
    clock = FakeClock(5.0)
    clock.sleep_until(4.0)
    assert clock.now() == 5.0
    clock.sleep_until(6.5)
    clock.advance(0.25)
    assert clock.now() == 6.75


def test_a_fake_clock_refuses_to_go_back():
    with pytest.raises(ValueError, match="never goes back"):
        FakeClock().advance(-1.0)
    with pytest.raises(ValueError, match="never goes back"):
        FakeClock().advance(float("nan"))
