"""Planners search once per map, choose what is free of collision, and repair what is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_planners import WatchedPlanner, map_with_pillars, pillar_world, query_of
from numpy.testing import assert_allclose, assert_array_equal

from hiernav.nav import goselo
from hiernav.nav.goselo import GoseloFrame
from hiernav.nav.planners import CACHED_CELLS, GoseloPlanner, ShortestPathPlanner, VerifiedPlanner, swept_clearance

FREE = map_with_pillars()
PILLAR = map_with_pillars([(0.6, 0.0)])
seeds = st.integers(0, 2**32 - 1)


def straight(start: object, heading: float, spacing: float = 0.1) -> np.ndarray:
    """(10, 2) waypoints along a heading [rad]."""
    direction = np.array([np.cos(heading), np.sin(heading)])
    return np.asarray(start, float) + spacing * np.arange(1, 11)[:, None] * direction


# shortest paths


def test_the_expert_gives_the_waypoints_of_its_field() -> None:
    planner = ShortestPathPlanner(radius=0.1, soft_margin=0.15)
    query = query_of([(0.0, 0.0), (-1.0, 0.3)], [(1.5, 0.0), (1.5, 0.0)], PILLAR)
    plans = planner.plan(query)
    field = planner.field(PILLAR, np.array([1.5, 0.0]))
    for row in range(2):
        assert_array_equal(plans[row], field.waypoints(query.position[row]))
    assert (field.radius, field.soft_margin) == (0.1, 0.15)


def test_one_search_serves_all_robots_and_all_steps_on_a_map() -> None:
    planner = ShortestPathPlanner()
    planner.plan(query_of([(0.0, 0.0), (0.3, 0.5)], [(1.5, 0.0)] * 2, PILLAR))
    field = planner.field(PILLAR, np.array([1.5, 0.0]))
    planner.plan(query_of([(0.1, 0.0)], [(1.5, 0.0)], PILLAR))
    assert planner.field(PILLAR, np.array([1.5, 0.0])) is field
    assert len(planner._fields) == 1


def test_another_goal_or_another_map_is_searched_anew() -> None:
    planner = ShortestPathPlanner()
    same_content = map_with_pillars([(0.6, 0.0)])
    fields = [
        planner.field(occupancy, np.array(goal))
        for occupancy, goal in ((PILLAR, (1.5, 0.0)), (PILLAR, (1.5, 0.1)), (same_content, (1.5, 0.0)))
    ]
    assert len({id(field) for field in fields}) == 3
    assert fields[2].occupancy is same_content


def test_a_map_in_the_cache_is_kept_alive_so_that_no_other_can_take_its_identity() -> None:
    planner = ShortestPathPlanner(cache_size=3)
    for column in range(12):
        occupancy = map_with_pillars([(0.1 * column, 0.0)])
        assert planner.field(occupancy, np.array([1.5, 0.0])).occupancy is occupancy
        del occupancy
    assert len(planner._fields) == 3


def test_the_field_used_longest_ago_is_forgotten_first() -> None:
    planner = ShortestPathPlanner(cache_size=2)
    goals = np.array([[1.0, 0.0], [1.2, 0.0], [1.4, 0.0]])
    first, second = planner.field(FREE, goals[0]), planner.field(FREE, goals[1])
    assert planner.field(FREE, goals[0]) is first
    planner.field(FREE, goals[2])
    assert planner.field(FREE, goals[0]) is first
    assert planner.field(FREE, goals[1]) is not second


def test_fields_are_kept_up_to_a_number_of_cells_and_the_one_used_longest_ago_is_dropped() -> None:
    planner, goals = ShortestPathPlanner(cached_cells=3 * 1600), np.array([[0.1 * k, 0.0] for k in range(5)])
    small = map_with_pillars(half_size=(2.0, 2.0))
    fields = [planner.field(small, goal) for goal in goals[:3]]
    assert fields[0].cells == 1600 and planner.field(small, goals[0]) is fields[0]
    planner.field(small, goals[3])
    assert list(planner._fields.values())[:2] == [fields[2], fields[0]]
    large = map_with_pillars(half_size=(5.0, 5.0))
    field = planner.field(large, goals[4])
    assert list(planner._fields.values()) == [field], "the newest is kept, however large"
    assert planner.field(large, goals[4]) is field
    planner.field(small, goals[0])
    assert sum(kept.cells for kept in planner._fields.values()) <= 3 * 1600


def test_as_many_large_maps_as_a_robot_may_meet_do_not_take_all_its_memory() -> None:
    planner = ShortestPathPlanner()
    for number in range(20):
        planner.field(map_with_pillars(half_size=(10.0, 10.0)), np.array([0.1 * number, 0.0]))
    assert sum(field.cells for field in planner._fields.values()) <= CACHED_CELLS == 500_000


def test_the_fields_of_64_robots_side_by_side_are_all_kept() -> None:
    planner, goal = ShortestPathPlanner(), np.array([1.5, 0.0])
    maps = [map_with_pillars(half_size=(2.0, 2.0)) for _ in range(64)]
    fields = [planner.field(each, goal) for each in maps]
    assert all(planner.field(each, goal) is field for each, field in zip(maps, fields, strict=True))


def test_where_there_is_no_path_or_no_position_the_row_is_nan_and_the_others_are_not() -> None:
    box = map_with_pillars(half_size=(1.0, 1.0))
    box.occupied[:, 19:21] = True
    plans = ShortestPathPlanner().plan(query_of([(-0.5, 0.0), (0.3, 0.2), (np.nan, 0.0)], [(0.6, 0.0)] * 3, box))
    assert np.isnan(plans).all(axis=(1, 2)).tolist() == [True, False, True]
    assert np.isfinite(plans[1]).all()


# sweeping


def test_the_clearance_of_a_plan_is_the_smallest_on_its_way() -> None:
    past = straight((0.0, 0.35), 0.0)
    assert swept_clearance(np.array([[0.0, 0.35]]), past[None], PILLAR)[0] == pytest.approx(0.15, abs=0.03)
    assert swept_clearance(np.zeros((1, 2)), straight((0.0, 0.0), 0.0)[None], PILLAR)[0] == 0.0
    assert swept_clearance(np.zeros((1, 2)), straight((0.0, 0.0), np.pi)[None], PILLAR)[0] > 0.1


def test_an_obstacle_between_two_waypoints_is_met() -> None:
    thin = map_with_pillars([(0.55, 0.0)], radius=0.03)
    plan = 0.5 * np.arange(1, 11)[:, None] * [1.0, 0.0] + [-0.2, 0.0]
    assert thin.clearance_at(plan[:3]).min() > 0.1
    assert swept_clearance(np.array([[-0.2, 0.0]]), plan[None], thin)[0] < 0.03


def test_a_robot_too_close_to_an_obstacle_may_leave_it() -> None:
    """0.05 m from the pillar's edge: away from it nothing is held against the plan, towards it and along it is."""
    start = np.array([[0.35, 0.0]])
    clearance = {
        name: swept_clearance(start, straight(start[0], heading)[None], PILLAR)[0]
        for name, heading in (("away", np.pi), ("into", 0.0), ("around", np.pi / 3))
    }
    assert clearance["away"] >= 0.1
    assert clearance["into"] == 0.0
    assert clearance["around"] < 0.1


def test_leaving_one_obstacle_is_no_excuse_for_the_next() -> None:
    start = np.array([[0.35, 0.0]])
    between = map_with_pillars([(0.6, 0.0), (-0.3, 0.0)])
    assert swept_clearance(start, straight(start[0], np.pi)[None], between)[0] == 0.0


def test_a_plan_that_is_not_a_number_has_no_clearance_and_the_others_keep_theirs() -> None:
    plans = np.stack([straight((0.0, 0.0), np.pi), np.full((10, 2), np.nan)])
    clearance = swept_clearance(np.zeros((2, 2)), plans, FREE)
    assert clearance[0] > 0.1
    assert np.isnan(clearance[1])


@given(seeds)
@settings(max_examples=30)
def test_the_plans_of_the_expert_pass_the_sweep(seed: int) -> None:
    _, occupancy, start, goal = pillar_world(seed)
    plan = ShortestPathPlanner(radius=0.1, soft_margin=0.15).plan(query_of([start], [goal], occupancy))
    if np.isfinite(plan).all():
        assert swept_clearance(start[None], plan, occupancy)[0] >= 0.1 - 0.03


# verification


def verified(radius: float = 0.1) -> tuple[VerifiedPlanner, WatchedPlanner]:
    straight_planner = WatchedPlanner()
    return VerifiedPlanner(straight_planner, ShortestPathPlanner(radius, soft_margin=0.05), radius), straight_planner


def counts(planner: VerifiedPlanner) -> tuple[int, int, int]:
    return planner.tally["proposals"], planner.tally["repairs"], planner.tally["refusals"]


def test_a_plan_through_a_pillar_is_replaced_by_the_way_around_it() -> None:
    planner, proposer = verified()
    query = query_of([(0.0, 0.0), (0.0, 1.0)], [(1.5, 0.0), (1.5, 1.0)], PILLAR)
    plans = planner.plan(query)
    assert counts(planner) == (2, 1, 0)
    assert_array_equal(plans[1], proposer.plan(query)[1])
    assert_array_equal(plans[0], planner.repair.plan(query)[0])
    assert swept_clearance(query.position[:1], plans[:1], PILLAR)[0] >= 0.1 - 0.03


def test_free_plans_are_passed_on_unchanged_and_counted() -> None:
    planner, proposer = verified()
    query = query_of([(0.0, 0.0)] * 3, [(1.5, 0.0), (0.0, 1.5), (-1.5, 0.0)], FREE)
    assert_array_equal(planner.plan(query), proposer.plan(query))
    assert counts(planner) == (3, 0, 0)


def test_where_no_path_exists_either_the_plan_is_refused() -> None:
    planner, _ = verified()
    box = map_with_pillars(half_size=(1.0, 1.0))
    box.occupied[:, 19:21] = True
    plans = planner.plan(query_of([(-0.5, 0.0), (0.3, 0.0)], [(0.6, 0.0)] * 2, box))
    assert np.isnan(plans[0]).all() and np.isfinite(plans[1]).all()
    assert counts(planner) == (2, 0, 1)


def test_a_planner_that_finds_nothing_is_repaired() -> None:
    planner, proposer = verified()
    proposer.silent = True
    assert np.isfinite(planner.plan(query_of([(0.0, 0.0)], [(1.5, 0.0)], PILLAR))).all()
    assert counts(planner) == (1, 1, 0)


def test_the_planner_s_own_answer_is_not_written_into() -> None:
    answer = straight((0.0, 0.0), 0.0)[None]

    class Same:
        def plan(self, query: object) -> np.ndarray:
            return answer

    planner = VerifiedPlanner(Same(), ShortestPathPlanner())
    planner.plan(query_of([(0.0, 0.0)], [(1.5, 0.0)], PILLAR))
    assert_array_equal(answer, straight((0.0, 0.0), 0.0)[None])


# the network's hypotheses


@dataclass
class Fan:
    """Hypotheses straight ahead, to the left and to the right of the goal; remembers what it was shown."""

    scores: tuple[float, ...] = (0.0, 0.0, 0.0)
    image: np.ndarray | None = None
    distance: np.ndarray | None = None

    def __call__(self, image: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.image, self.distance = image, distance
        fan = np.stack([straight((0.0, 0.0), np.pi / 2 + turn) for turn in (0.0, 0.9, -0.9)])[: len(self.scores)]
        return np.repeat(fan[None], len(image), axis=0).astype(np.float32), np.tile(self.scores, (len(image), 1))


def test_the_network_s_waypoints_are_turned_into_the_world() -> None:
    network = Fan(scores=(0.0,))
    plans = GoseloPlanner(network).plan(query_of([(0.0, 0.0), (1.0, 1.0)], [(2.0, 0.0), (1.0, -0.5)], FREE))
    assert_allclose(plans, [straight((0.0, 0.0), 0.0), straight((1.0, 1.0), -np.pi / 2)], atol=1e-6)


def test_the_network_is_shown_the_image_and_the_distance() -> None:
    network = Fan()
    query = query_of([(0.0, 0.0), (0.2, 0.1)], [(1.5, 0.0), (0.2, 0.6)], PILLAR)
    GoseloPlanner(network).plan(query)
    frame = GoseloFrame.of(query.position, query.goal)
    assert_array_equal(network.image, goselo.images(query.occupancy, query.visits, frame))
    assert network.distance.dtype == np.float32
    assert_allclose(network.distance, [1.5, 0.5], rtol=1e-6)


def test_a_hypothesis_free_of_collision_beats_one_with_a_better_score() -> None:
    ahead_blocked = query_of([(0.0, 0.0)], [(2.0, 0.0)], PILLAR)
    plan = GoseloPlanner(Fan(scores=(5.0, 0.0, 1.0))).plan(ahead_blocked)[0]
    assert plan[-1, 1] < -0.5, "to the right, which scores better than the left"
    in_the_open = query_of([(0.0, 0.0)], [(2.0, 0.0)], FREE)
    assert_allclose(GoseloPlanner(Fan(scores=(5.0, 0.0, 1.0))).plan(in_the_open)[0], straight((0, 0), 0.0), atol=1e-6)


def test_a_hypothesis_that_is_exactly_free_beats_one_a_little_short_of_it_however_good_its_score() -> None:
    level = straight((0.0, 0.0), 0.0)
    walled = map_with_pillars()
    walled.occupied[63:] = True  # from y = 0.15 m on
    candidates = np.stack([level + [0.0, 0.055], level - [0.0, 0.05]])[None]
    clearance = swept_clearance(np.zeros((2, 2)), candidates[0], walled)
    assert 0.085 < clearance[0] < 0.1 <= clearance[1]
    query = query_of([(0.0, 0.0)], [(2.0, 0.0)], walled)
    for scores in ((0.0, 0.0), (50.0, 0.0)):
        assert_array_equal(GoseloPlanner(Fan()).select(candidates, np.array([scores]), query)[0], candidates[0, 1])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("occupancy", [FREE, PILLAR], ids=["free", "in the way"])
def test_a_hypothesis_that_is_no_number_comes_last(bad: float, occupancy) -> None:
    level = straight((0.0, 0.0), 0.0)
    broken = level.copy()
    broken[4] = bad
    query = query_of([(0.0, 0.0)], [(2.0, 0.0)], occupancy)
    planner = GoseloPlanner(Fan())
    for candidates in (np.stack([broken, level]), np.stack([level, broken])):
        assert_array_equal(planner.select(candidates[None], np.array([[0.0, 0.0]]), query)[0], level)
    for scores in ((bad, 0.0), (0.0, bad)):
        chosen = planner.select(np.stack([level, level])[None] + 0.0, np.array([scores]), query)[0]
        assert np.isfinite(chosen).all()
    assert planner.select(np.stack([broken, broken])[None], np.array([[0.0, 0.0]]), query).shape == (1, 10, 2)


def test_of_hypotheses_that_all_collide_the_one_with_most_room_is_taken() -> None:
    walled = map_with_pillars([(0.6, 0.05), (0.45, 0.75), (0.65, -0.45)])
    clearance = [swept_clearance(np.zeros((1, 2)), straight((0, 0), a)[None], walled)[0] for a in (0.0, 0.9, -0.9)]
    assert max(clearance) < 0.1 and clearance[2] > max(clearance[:2])
    plan = GoseloPlanner(Fan(scores=(2.0, 1.0, 0.0))).plan(query_of([(0.0, 0.0)], [(2.0, 0.0)], walled))[0]
    assert plan[-1, 1] < -0.5


@pytest.mark.parametrize(("ahead", "chosen"), [(0.0, 1), (1.0, 1), (4.0, 0)])
def test_of_free_hypotheses_one_with_room_is_worth_some_score(ahead: float, chosen: int) -> None:
    narrow = map_with_pillars([(0.5, 0.37)])
    plans = np.stack([straight((0.0, 0.0), 0.0), straight((0.0, 0.0), -0.8)])
    near, far = swept_clearance(np.zeros((2, 2)), plans, narrow)
    assert 0.1 < near < 0.2 and far > 0.3
    query = query_of([(0.0, 0.0)], [(2.0, 0.0)], narrow)
    planner = GoseloPlanner(Fan(scores=(0.0, 0.0, 0.0)))
    assert_array_equal(planner.select(plans[None], np.array([[ahead, 0.0]]), query)[0], plans[chosen])


@pytest.mark.parametrize(("side", "turn"), [("left", 0.9), ("right", -0.9)])
def test_between_equals_the_side_of_the_plan_before_is_kept(side: str, turn: float) -> None:
    previous = straight((-0.1, 0.0), turn)[None]
    query = query_of([(0.0, 0.0)], [(2.0, 0.0)], PILLAR, previous)
    for scores in ((0.0, 0.1, -0.1), (0.0, -0.1, 0.1)):
        plan = GoseloPlanner(Fan(scores=scores)).plan(query)[0]
        assert np.sign(plan[-1, 1]) == np.sign(turn), side


def test_without_hysteresis_or_against_a_much_better_score_the_side_changes() -> None:
    previous = straight((-0.1, 0.0), 0.9)[None]
    query = query_of([(0.0, 0.0)], [(2.0, 0.0)], PILLAR, previous)
    assert GoseloPlanner(Fan(scores=(0.0, -0.1, 0.1)), hysteresis=0.0).plan(query)[0, -1, 1] < 0
    assert GoseloPlanner(Fan(scores=(0.0, -2.0, 2.0))).plan(query)[0, -1, 1] < 0


def test_a_plan_before_that_now_collides_is_not_kept() -> None:
    blocked_left = map_with_pillars([(0.6, 0.0), (0.4, 0.5)])
    query = query_of([(0.0, 0.0)], [(2.0, 0.0)], blocked_left, straight((0.0, 0.0), 0.9)[None])
    assert GoseloPlanner(Fan(scores=(0.0, 1.0, 0.0))).plan(query)[0, -1, 1] < 0


def test_each_robot_of_a_batch_chooses_for_itself() -> None:
    previous = np.stack([straight((0.0, 0.0), 0.9), straight((0.0, 0.0), -0.9)])
    query = query_of([(0.0, 0.0)] * 2, [(2.0, 0.0)] * 2, PILLAR, previous)
    assert np.sign(GoseloPlanner(Fan()).plan(query)[:, -1, 1]).tolist() == [1.0, -1.0]


def test_a_plan_that_leads_where_the_robot_has_been_is_replaced_by_the_shortest_path() -> None:
    planner, proposer = verified()
    query = query_of([(0.0, 0.0), (0.0, 0.0)], [(1.5, 0.0), (1.5, 0.0)], FREE)
    aside = np.stack([straight((0.0, 0.0), np.pi / 5), straight((0.0, 0.0), np.pi / 5)])
    proposer.plan = lambda query: aside.copy()
    query.visits[1].add(aside[1, :6])
    plans = planner.plan(query)
    assert_array_equal(plans[0], aside[0])
    assert_array_equal(plans[1], planner.repair.plan(query)[1])
    assert (*counts(planner), planner.tally["loops"]) == (2, 1, 0, 1)


def test_a_plan_that_begins_where_the_robot_has_just_been_is_no_loop() -> None:
    planner, proposer = verified()
    query = query_of([(0.0, 0.0)], [(1.5, 0.0)], FREE)
    aside = straight((0.0, 0.0), np.pi / 5)[None]
    proposer.plan = lambda query: aside.copy()
    query.visits[0].add(np.linspace([-0.5, 0.0], [0.1, 0.0], 13))
    assert_array_equal(planner.plan(query), aside)
    assert counts(planner) == (1, 0, 0)


def test_a_plan_that_does_not_bring_the_robot_nearer_to_the_goal_is_replaced() -> None:
    planner, proposer = verified()
    query = query_of([(0.0, 0.0)] * 2, [(1.5, 0.0)] * 2, FREE)
    proposed = np.stack([straight((0.0, 0.0), np.pi / 2), straight((0.0, 0.0), np.pi / 5)])
    proposer.plan = lambda query: proposed.copy()
    plans = planner.plan(query)
    assert_array_equal(plans[0], planner.repair.plan(query)[0])
    assert_array_equal(plans[1], proposed[1])
    assert (*counts(planner), planner.tally["loops"], planner.tally["detours"]) == (2, 1, 0, 0, 1)


def test_nearer_means_on_the_way_around_obstacles() -> None:
    """Behind a wall, the way to the goal leads away from it first."""
    planner, proposer = verified()
    walled = map_with_pillars()
    walled.occupied[:80, 70:72] = True  # up to y = 1, at x = 0.5
    query = query_of([(0.0, 0.0)], [(1.5, 0.0)], walled)
    shortest = planner.repair.plan(query)
    assert shortest[0, -1, 1] > 0.5
    proposer.plan = lambda query: shortest.copy()
    assert_array_equal(planner.plan(query), shortest)
    assert planner.tally["detours"] == 0


def test_a_free_plan_that_leads_back_stands_where_there_is_no_path() -> None:
    planner, proposer = verified()
    walled = map_with_pillars(half_size=(1.0, 1.0))
    walled.occupied[:, 19:21] = True
    query = query_of([(-0.5, 0.0)], [(0.6, 0.0)], walled)
    back = np.repeat([[[-0.5, -0.4]]], 10, axis=1)
    proposer.plan = lambda query: back
    query.visits[0].add([(-0.5, -0.4)])
    assert_array_equal(planner.plan(query), back)
    assert (*counts(planner), planner.tally["loops"]) == (1, 0, 0, 0)
