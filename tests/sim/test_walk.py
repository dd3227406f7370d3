"""Walks along plans count what the paper's Table II counts: waypoints at which a disc touches something."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scenery import layout_of

from hiernav.nav.option import PlanQuery
from hiernav.sim.walk import WalkResult, walk


class Recorded:
    """Ten waypoints 0.1 m apart along +x, or whatever `answer` makes of a query; keeps what it was asked."""

    def __init__(self, answer=None) -> None:
        self.answer = answer or (lambda query: query.position[:, None] + STEPS)
        self.positions: list[np.ndarray] = []
        self.previous: list[np.ndarray] = []
        self.visited: list[list[int]] = []

    def plan(self, query: PlanQuery) -> np.ndarray:
        self.positions.append(query.position.copy())
        self.previous.append(query.previous.copy())
        self.visited.append([int(np.count_nonzero(visits.counts)) for visits in query.visits])
        return self.answer(query)


STEPS = 0.1 * np.arange(1, 11)[:, None] * [1.0, 0.0]


def test_a_disc_moves_five_waypoints_and_asks_anew_until_the_goal_is_within_its_radius() -> None:
    planner = Recorded()
    result = walk(planner, [layout_of(start=(-1.03, 1.5, 0.0))])
    xs = [float(position[0, 0]) for position in planner.positions]
    assert xs == pytest.approx([-1.03, -0.53, -0.03, 0.47, 0.97])
    assert (bool(result.reached[0]), int(result.plans[0])) == (True, 5)
    assert result.collisions[0] == 0


def test_an_episode_that_needs_more_plans_than_it_may_ask_for_is_not_reached() -> None:
    for most, reached in ((5, True), (4, False)):
        result = walk(Recorded(), [layout_of(start=(-1.03, 1.5, 0.0))], max_plans=most)
        assert (bool(result.reached[0]), int(result.plans[0])) == (reached, most)


def test_every_waypoint_that_touches_an_obstacle_counts_one_and_those_beyond_the_stride_none() -> None:
    # a disc of 0.1 m touches the pillar of 0.2 m within 0.3 m of its centre, give or take a pixel
    touching = layout_of(start=(-1.03, 1.5, 0.0), pillars=[(-0.3, 1.5)])
    first = walk(Recorded(), [touching], max_plans=1)
    assert first.collisions[0] == 1, "at x = -0.53; the pillar's centre lies beyond the five waypoints of this plan"
    assert walk(Recorded(), [touching], max_plans=2).collisions[0] == 6
    assert walk(Recorded(), [touching]).collisions[0] == 6, "nothing more beyond it"
    assert walk(Recorded(), [touching], radius=0.2, max_plans=1).collisions[0] == 2


def test_a_waypoint_that_reaches_the_goal_ends_the_walk_and_is_itself_looked_at() -> None:
    beside = layout_of(start=(0.98, 1.5, 0.0), pillars=[(1.28, 1.2)])
    result = walk(Recorded(), [beside])
    assert (bool(result.reached[0]), int(result.plans[0])) == (True, 1)
    alone = walk(Recorded(lambda query: np.full((1, 10, 2), (1.28, 1.35))), [beside])
    assert bool(alone.reached[0]) and alone.collisions[0] == 1, "the only waypoint at which it was"


def test_the_planner_is_told_where_the_disc_was_and_what_it_answered_last() -> None:
    planner = Recorded()
    walk(planner, [layout_of(start=(-1.03, 1.5, 0.0))], max_plans=3)
    assert planner.visited == [[1], [6], [11]], "pixels: that of the start, and those of five waypoints a plan"
    assert np.isnan(planner.previous[0]).all()
    assert_array_equal(planner.previous[1], planner.positions[0][:, None] + STEPS)
    assert_array_equal(planner.previous[2], planner.positions[1][:, None] + STEPS)


def test_a_disc_without_a_plan_stays_and_the_others_go_on() -> None:
    def answer(query: PlanQuery) -> np.ndarray:
        plans = query.position[:, None] + STEPS
        plans[query.position[:, 0] < -1.2] = np.nan
        return plans

    layouts = [layout_of(start=(x, 1.5, 0.0)) for x in (-1.53, -1.03)]
    result = walk(Recorded(answer), layouts, max_plans=7)
    assert result.reached.tolist() == [False, True]
    assert result.plans.tolist() == [7, 5]


def test_a_walk_without_collisions_counts_as_such_only_if_it_arrives() -> None:
    result = WalkResult(np.array([0, 0, 3, 1]), np.array([True, False, True, False]), np.array([2, 60, 4, 60]))
    assert result.summary() == {
        "collisions_mean": 1.0, "collision_free_rate": 0.25, "reach_rate": 0.5, "plans_mean": 31.5,
    }  # fmt: skip
