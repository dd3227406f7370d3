from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiernav.runtime.clock import FakeClock
from hiernav.runtime.timing import BUCKET_RATIO, Histogram, TickTimer


@given(st.lists(st.floats(2e-6, 9.0), min_size=1, max_size=200), st.sampled_from([1.0, 50.0, 99.0, 100.0]))
def test_a_percentile_is_at_most_one_bucket_above_the_exact_one(durations, percent):
    histogram = Histogram()
    for duration in durations:
        histogram.record(duration)
    exact = np.sort(durations)[max(1, math.ceil(len(durations) * percent / 100.0)) - 1]
    assert exact * (1 - 1e-9) <= histogram.percentile(percent) <= exact * BUCKET_RATIO * (1 + 1e-9)


@given(st.lists(st.floats(-1.0, 1e6), min_size=1, max_size=50))
def test_the_maximum_is_exact_and_bounds_every_percentile(durations):
    histogram = Histogram()
    for duration in durations:
        histogram.record(duration)
    assert histogram.count == len(durations)
    assert histogram.max == max(0.0, *durations)
    assert histogram.percentile(50) <= histogram.percentile(99) <= histogram.max


def test_an_hour_of_ticks_takes_no_more_memory_than_one():
    histogram = Histogram()
    histogram.record(1e-3)
    buckets = len(histogram._counts)
    for duration in np.geomspace(1e-9, 1e3, 5000):
        histogram.record(float(duration))
    assert len(histogram._counts) == buckets
    assert sum(histogram._counts) == histogram.count == 5001


def test_an_empty_histogram_says_so():
    assert Histogram().summary() == {"count": 0, "p50": None, "p99": None, "max": None}
    assert math.isnan(Histogram().percentile(50))


def test_nan_is_no_duration():
    with pytest.raises(ValueError, match="nan"):
        Histogram().record(math.nan)


def test_a_tick_is_the_sum_of_its_sections():
    clock = FakeClock()
    timer = TickTimer(("read", "send"), stopwatch=clock.now)
    for _ in range(5):
        timer.begin()
        clock.advance(0.002)
        timer.mark("read")
        clock.advance(0.003)
        timer.mark("send")
        assert timer.end() == pytest.approx(0.005)
        clock.advance(0.015)
    assert timer.sections["read"].max == pytest.approx(0.002)
    assert timer.sections["send"].max == pytest.approx(0.003)
    assert timer.rate == pytest.approx(50.0)


def test_time_spent_planning_is_not_counted_as_inference():
    clock = FakeClock()
    timer = TickTimer(stopwatch=clock.now)
    timer.begin()
    clock.advance(0.010)
    timer.mark_split("infer", "plan", 0.008)
    assert timer.sections["plan"].max == pytest.approx(0.008)
    assert timer.sections["infer"].max == pytest.approx(0.002)
