"""The disc that is swept along lines: what it meets, and when a robot that touches an obstacle may go."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nav_planners import map_with_pillars, pillar_world
from numpy.testing import assert_allclose

from hiernav.nav.planners import swept_clearance
from hiernav.nav.sweep import meets_map, sweep

PILLAR = map_with_pillars([(0.45, 0.0)], radius=0.2)


@given(st.integers(0, 50), st.floats(-2.1, 2.1), st.floats(-2.1, 2.1))
def test_the_clearance_of_one_point_is_that_of_many(seed: int, x: float, y: float) -> None:
    occupancy = pillar_world(seed)[1]
    assert occupancy.clearance_of(x, y) == pytest.approx(float(occupancy.clearance_at([x, y])), abs=1e-6)


@given(st.integers(0, 200))
def test_the_sweep_of_a_plan_agrees_with_what_its_planner_was_checked_by(seed: int) -> None:
    occupancy, rng = pillar_world(seed % 20)[1], np.random.default_rng(seed)
    start = rng.uniform(-1.5, 1.5, (1, 2))
    plans = start[:, None] + np.cumsum(rng.uniform(-0.1, 0.15, (1, 10, 2)), axis=1)
    meets = sweep(np.concatenate([start[:, None], plans], axis=1), occupancy, 0.1)[2]
    assert meets.any() == (swept_clearance(start, plans, occupancy)[0] < 0.1)


@given(st.integers(0, 300), st.floats(0.02, 0.6), st.floats(-3.2, 3.2))
def test_a_segment_is_judged_alike_in_one_go_and_walked_along(seed: int, length: float, angle: float) -> None:
    occupancy = pillar_world(seed % 20)[1]
    begin = np.random.default_rng(seed).uniform(-1.9, 1.9, 2)
    end = begin + length * np.array([np.cos(angle), np.sin(angle)])
    t = np.linspace(0.0, 1.0, 200)[:, None]
    clearance = occupancy.clearance_at((1.0 - t) * begin + t * end)
    walked = meets_map(occupancy, begin.tolist(), end.tolist(), 0.1)
    if clearance.min() > 0.11:
        assert not walked
    elif clearance[0] > 0.1 and clearance.min() < 0.07:
        assert walked


@pytest.mark.parametrize(
    ("begin", "end", "meets"),
    [
        ((0.0, 0.0), (0.1, 0.0), False),
        ((0.0, 0.0), (0.2, 0.0), True),
        ((0.0, 0.0), (0.9, 0.0), True),
        ((0.19, 0.0), (0.0, 0.0), False),  # touches, and leads away
        ((0.19, 0.0), (0.22, 0.0), True),  # touches, and leads on into it
        ((np.nan, 0.0), (0.9, 0.0), False),
        ((0.0, 0.0), (0.0, 0.0), False),
        ((0.0, 0.0), (-5.0, 0.0), True),  # off the map
    ],
)
def test_what_a_disc_meets_on_a_segment(begin: tuple[float, float], end: tuple[float, float], meets: bool) -> None:
    assert meets_map(PILLAR, begin, end, 0.1) is meets


def test_places_are_counted_in_vertices() -> None:
    index, clearance, meets = sweep(np.array([[[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]]]), PILLAR, 0.1)
    assert_allclose(index, [0.5, 1.0, 1.5, 2.0])
    assert_allclose(clearance, PILLAR.clearance_at(np.array([[[0.05, 0.0], [0.1, 0.0], [0.15, 0.0], [0.2, 0.0]]])))
    assert meets.tolist() == [[False, False, clearance[0, 2] < 0.1, True]]
