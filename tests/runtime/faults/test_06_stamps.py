"""Stamps that repeat themselves, go backwards or are no numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from runtime_motion import estimator_for, frames, recorded

MOTION = recorded("point")
STREAM = list(frames(MOTION))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 199), st.integers(0, 199)), max_size=40))
def test_frames_from_the_past_mixed_in_change_nothing(insertions):
    late = {at: earlier for at, earlier in insertions if earlier < at}
    clean, disturbed = estimator_for(MOTION), estimator_for(MOTION)
    for k, frame in enumerate(STREAM):
        expected = clean.update(frame)
        estimate = disturbed.update(frame)
        if k in late:
            estimate = disturbed.update(STREAM[late[k]])
        assert expected is not None and estimate is not None
        np.testing.assert_array_equal(estimate.pose, expected.pose)
        np.testing.assert_array_equal(estimate.covariance, expected.covariance)
        assert estimate.stamp == frame.stamp
    assert disturbed.counts["stale_frame"] == len(late)


@pytest.mark.parametrize("stamp", [math.nan, math.inf, -math.inf, -5.0, 0.5])
def test_a_stamp_that_makes_no_sense_drops_its_frame(stamp):
    estimator = estimator_for(MOTION)
    for frame in STREAM[:60]:
        before = estimator.update(frame)
    after = estimator.update(replace(STREAM[60], stamp=stamp))
    assert before is not None and after is not None
    assert after.stamp == before.stamp
    np.testing.assert_array_equal(after.pose, before.pose)
