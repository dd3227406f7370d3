"""A plan ends when it should, for the reason that is recorded, and only for the robots concerned."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nav_planners import WatchedPlanner, map_with_pillars
from numpy.testing import assert_allclose, assert_array_equal

from hiernav.nav.occupancy import OccupancyMap, draw_boxes
from hiernav.nav.option import WaypointOption
from hiernav.nav.path import nearest_vertex, polyline
from hiernav.nav.planners import StraightPlanner
from hiernav.nav.termination import ReplanRule, TerminationReason

NONE, START, D_UPDATE, HALF_INDEX, INVALID, GOAL, OUTDATED = TerminationReason
FREE = map_with_pillars()
FAR = (2.5, 0.0)
DEFAULT = ReplanRule()


class Drive:
    """An option and the robots under it; every call of `at` is one control step."""

    def __init__(self, num_rows: int = 1, rule: ReplanRule = DEFAULT, goal: object = FAR) -> None:
        self.planner = WatchedPlanner()
        self.option = WaypointOption(self.planner, num_rows, rule)
        self.goal = np.broadcast_to(np.asarray(goal, float), (num_rows, 2)).copy()
        self.map = FREE

    def at(self, *positions: object) -> list[TerminationReason]:
        step = self.option.step(np.asarray(positions, float), self.goal, [self.map] * len(positions))
        return [TerminationReason(reason) for reason in step.reason]


def test_the_first_step_plans_and_following_the_plan_replans_after_half_of_it() -> None:
    drive = Drive()
    reasons = {x: drive.at((x, 0.0))[0] for x in np.round(np.arange(0.0, 0.65, 0.05), 2).tolist()}
    assert reasons.pop(0.0) == START
    # the sixth of ten waypoints becomes the closest one beyond 0.55 m
    assert reasons.pop(0.6) == HALF_INDEX
    assert set(reasons.values()) == {NONE}
    assert_allclose(drive.option.plan[0, 0], [0.7, 0.0])
    assert_allclose(drive.option.start[0], [0.6, 0.0])


def test_leaving_the_plan_replans_from_where_the_robot_is() -> None:
    drive = Drive()
    drive.at((0.0, 0.0))
    assert drive.at((0.2, 0.299)) == [NONE]
    assert drive.at((0.2, 0.301)) == [D_UPDATE]
    assert_allclose(drive.option.line()[0, 0], [0.2, 0.301])


def test_the_position_a_plan_was_made_from_is_part_of_it() -> None:
    """Backing off counts from the start, not from the first waypoint."""
    drive = Drive()
    drive.at((0.0, 0.0))
    assert drive.at((-0.299, 0.0)) == [NONE]
    assert drive.at((-0.301, 0.0)) == [D_UPDATE]


def test_a_plan_to_a_goal_nearer_than_its_length_is_driven_to_the_goal() -> None:
    """All waypoints beyond the goal lie on it, so the index stops there and the goal ends the plan."""
    drive = Drive(goal=(0.5, 0.0))
    assert drive.at((0.0, 0.0)) == [START]
    assert_allclose(drive.option.plan[0, 4:], np.broadcast_to([0.5, 0.0], (6, 2)))
    assert drive.at((0.19, 0.0)) == [NONE]
    assert drive.at((0.21, 0.0)) == [GOAL]
    assert len(drive.planner.queries) == 1


def test_a_plan_within_0_2_m_ends_by_distance_alone() -> None:
    drive = Drive(goal=(0.2, 0.0))
    drive.option.goal_radius = 0.01
    assert drive.at((0.0, 0.0)) == [START]
    assert drive.at((0.18, 0.0)) == [NONE]
    assert drive.at((0.45, 0.0)) == [NONE]
    assert drive.at((0.51, 0.0)) == [D_UPDATE]


def test_at_the_goal_nothing_is_planned() -> None:
    drive = Drive(goal=(0.5, 0.0))
    drive.at((0.0, 0.0))
    plan = drive.option.plan.copy()
    assert drive.at((0.5, 0.2)) == [GOAL]
    assert_array_equal(drive.option.plan, plan)


def test_a_robot_that_starts_at_its_goal_still_gets_a_plan_first() -> None:
    drive = Drive(goal=(0.1, 0.0))
    assert drive.at((0.0, 0.0)) == [START]
    assert np.isfinite(drive.option.plan).all()
    assert drive.at((0.0, 0.0)) == [GOAL]


def test_after_a_reset_a_plan_is_made_anew_and_counts_and_visits_are_gone() -> None:
    drive = Drive(num_rows=2)
    drive.at((0.0, 0.0), (0.0, 1.0))
    drive.option.reset(np.array([1]))
    assert drive.option.visits[1] is None and drive.option.visits[0] is not None
    assert drive.option.counts[1].sum() == 0
    assert drive.at((0.0, 0.0), (0.0, 1.0)) == [NONE, START]
    assert np.isnan(drive.planner.queries[-1].previous).all()


def test_visits_move_with_a_map_that_grows_or_rolls_along() -> None:
    drive = Drive()
    drive.at((0.02, 0.02))
    drive.at((0.22, 0.02))
    rows, cols = FREE.occupied.shape
    x, y = FREE.origin
    drive.map = OccupancyMap(np.zeros((rows + 7, cols + 4), dtype=np.bool_), FREE.resolution, (x - 0.15, y - 0.2))
    drive.at((0.22, 0.02))
    visits = drive.option.visits[0]
    assert visits is not None and visits.lies_on(drive.map)
    assert visits.counts.sum() == 2, "resting where it was adds nothing"
    for place in ((0.02, 0.02), (0.22, 0.02)):
        assert visits.counts[drive.map.pixel_of(place)] == 1


def test_after_a_change_of_goal_the_plan_is_dropped_and_the_episode_kept() -> None:
    drive = Drive(num_rows=2)
    drive.at((0.0, 0.0), (0.0, 1.0))
    drive.goal[0] = (-2.0, 0.0)
    drive.option.drop(np.array([0]))
    assert drive.at((0.0, 0.0), (0.0, 1.0)) == [START, NONE]
    assert_allclose(drive.option.plan[0, 0], [-0.1, 0.0])
    assert drive.option.counts[:, START].tolist() == [2, 1]
    assert drive.option.visits[0].counts.sum() == 1
    assert np.isnan(drive.planner.queries[-1].previous).all(), "a plan to another goal is no plan to agree with"


@pytest.mark.parametrize("answer", ["refused", "later"])
def test_a_plan_that_was_dropped_is_not_followed_whatever_the_planner_says(answer: str) -> None:
    drive = Drive(num_rows=2)
    drive.at((0.0, 0.0), (0.0, 1.0))
    kept = drive.option.plan[1].copy()
    drive.option.drop(np.array([0]))
    drive.planner.silent = True
    if answer == "later":
        drive.planner.plan = lambda query: None  # type: ignore[method-assign]
    for x in (0.1, 0.11):
        step = drive.option.step(np.array([[x, 0.0], [0.1, 1.0]]), drive.goal, [FREE] * 2)
        assert_allclose(step.plan[0], np.broadcast_to([0.1, 0.0], (10, 2)))
        assert_array_equal(step.plan[1], kept)
    assert drive.option.started.tolist() == [False, True]


def test_with_a_period_plans_are_made_every_so_many_steps() -> None:
    drive = Drive(rule=ReplanRule(period=4))
    reasons = [drive.at((0.0, 3.0 * step / 13))[0] for step in range(13)]
    assert [k for k, reason in enumerate(reasons) if reason != NONE] == [0, 4, 8, 12]


def test_the_planner_is_told_the_plan_it_replaces() -> None:
    drive = Drive()
    drive.at((0.0, 0.0))
    plan = drive.option.plan.copy()
    assert drive.at((0.6, 0.0)) == [HALF_INDEX]
    assert_array_equal(drive.planner.queries[-1].previous, plan)


def test_reasons_are_counted_by_row() -> None:
    drive = Drive(num_rows=2)
    for x, y in [(0.0, 0.0), (0.3, 0.0), (0.6, 0.0), (0.6, 0.5), (2.5, 0.0)]:
        drive.at((x, y), (0.0, 0.0))
    expected = {NONE: 1, START: 1, HALF_INDEX: 1, D_UPDATE: 1, GOAL: 1, INVALID: 0, OUTDATED: 0}
    assert {reason: int(drive.option.counts[0, reason]) for reason in TerminationReason} == expected
    assert drive.option.counts[1].tolist() == [4, 1, 0, 0, 0, 0, 0]


# batches and subsets


def test_each_robot_of_a_batch_has_its_own_end() -> None:
    drive = Drive(num_rows=4)
    drive.at(*[(0.0, 0.0)] * 4)
    before = drive.option.plan.copy()
    assert drive.at((0.2, 0.0), (0.6, 0.0), (0.2, 0.4), (2.4, 0.0)) == [NONE, HALF_INDEX, D_UPDATE, GOAL]
    assert_array_equal(drive.option.plan[[0, 3]], before[[0, 3]])
    assert_array_equal(drive.planner.queries[-1].position, [(0.6, 0.0), (0.2, 0.4)])


def test_stepping_some_rows_leaves_the_others_untouched() -> None:
    drive = Drive(num_rows=3)
    drive.at(*[(0.0, 0.0)] * 3)
    option = drive.option
    names = ("plan", "start", "started", "age", "counts", "refused")
    before = {name: getattr(option, name).copy() for name in names}
    visits = [visit.counts.copy() for visit in option.visits]
    step = option.step(np.array([[0.0, 2.0], [0.6, 0.0]]), drive.goal[:2], [FREE] * 2, rows=np.array([2, 0]))
    assert step.reason.tolist() == [D_UPDATE, HALF_INDEX]
    assert_allclose(step.start, [[0.0, 2.0], [0.6, 0.0]])
    assert_allclose(option.start[[2, 0]], step.start)
    for name in names:
        assert_array_equal(getattr(option, name)[1], before[name][1], err_msg=name)
    assert_array_equal(option.visits[1].counts, visits[1])
    assert option.visits[2].counts.sum() == 2


# what is not a number


def test_without_a_plan_the_robot_holds_its_position_and_asks_again() -> None:
    drive = Drive()
    drive.planner.silent = True
    assert drive.at((0.4, 0.2)) == [START]
    assert_allclose(drive.option.plan[0], np.broadcast_to([0.4, 0.2], (10, 2)))
    assert drive.at((0.41, 0.2)) == [NONE], "an end is told once, however often a plan is asked for"
    assert len(drive.planner.queries) == 2 and drive.option.refused[0] == 2
    drive.planner.silent = False
    assert drive.at((0.41, 0.2)) == [NONE] and drive.option.started[0]
    assert drive.at((0.41, 0.2)) == [NONE]
    assert len(drive.planner.queries) == 3 and drive.option.refused[0] == 2


@pytest.mark.parametrize(
    ("rule", "position", "reason"),
    [
        (ReplanRule(), (0.6, 0.0), HALF_INDEX),
        (ReplanRule(), (0.0, 0.5), D_UPDATE),
        (ReplanRule(period=2), (0.1, 0.0), HALF_INDEX),
        (ReplanRule(), (0.2, 0.0), INVALID),
    ],
)
def test_a_refused_robot_keeps_its_plan_and_asks_again_at_every_step(
    rule: ReplanRule, position: tuple[float, float], reason: TerminationReason
) -> None:
    drive = Drive(rule=rule)
    drive.at((0.0, 0.0))
    drive.at((0.05, 0.0))
    if reason == INVALID:
        drive.map = map_with_pillars([(0.8, 0.0)])
    plan = drive.option.plan.copy()
    drive.planner.silent = True
    for count in (1, 2, 3):
        assert drive.at(position) == [reason if count == 1 else NONE]
        assert drive.option.refused[0] == count
        assert_array_equal(drive.option.plan, plan)
        assert_allclose(drive.option.start[0], 0.0)
    drive.planner.silent = False
    assert drive.at((0.05, 0.0)) == [NONE], "where the rule would let the old plan stand"
    assert_allclose(drive.option.start[0], (0.05, 0.0))


def test_a_position_that_is_not_a_number_keeps_the_plan_and_is_not_shown_to_the_planner() -> None:
    drive = Drive(num_rows=2)
    drive.at((0.0, 0.0), (0.0, 0.0))
    plan = drive.option.plan.copy()
    assert drive.at((np.nan, np.nan), (0.1, 0.0)) == [D_UPDATE, NONE]
    assert_array_equal(drive.option.plan, plan)
    assert len(drive.planner.queries) == 1
    assert drive.option.refused.tolist() == [1, 0]
    assert drive.at((0.1, 0.0), (0.1, 0.0)) == [NONE, NONE], "a reading was missed, the plan still holds"


def test_a_plan_that_is_wanted_is_asked_for_until_it_comes() -> None:
    drive = Drive()
    drive.at((0.0, 0.0))
    drive.option.waiting[0] = drive.planner.silent = True
    assert [drive.at((0.1, 0.0)) for _ in range(3)] == [[NONE]] * 3
    assert len(drive.planner.queries) == 4 and drive.option.refused[0] == 3
    drive.planner.silent = False
    drive.at((0.1, 0.0))
    assert_allclose(drive.option.start[0], [0.1, 0.0])
    assert not drive.option.waiting[0]
    drive.at((0.1, 0.0))
    assert len(drive.planner.queries) == 5


def test_a_missed_reading_does_not_end_the_wait_for_a_plan() -> None:
    drive = Drive(num_rows=2)
    drive.at((0.0, 0.0), (0.0, 1.0))
    drive.planner.plan = lambda query: None  # type: ignore[method-assign]
    drive.at((0.6, 0.0), (0.0, 1.0))
    assert drive.option.waiting.tolist() == [True, False]
    drive.at((np.nan, np.nan), (np.nan, np.nan))
    assert drive.option.waiting.tolist() == [True, False]
    assert drive.option.adopt(0, drive.option.plan[0] + 0.6, np.array([0.6, 0.0]), FREE)
    assert not drive.option.waiting.any()


def test_one_lost_robot_does_not_keep_the_others_from_planning() -> None:
    drive = Drive(num_rows=2)
    assert drive.at((np.nan, 0.0), (0.0, 0.0)) == [START, START]
    assert np.isfinite(drive.option.plan[1]).all()
    assert np.isnan(drive.option.plan[0]).any(axis=1).all()
    assert drive.at((0.0, 1.0), (0.0, 0.0)) == [START, NONE]
    assert np.isfinite(drive.option.plan).all()


def test_a_planner_that_answers_in_another_shape_is_named() -> None:
    drive = Drive()
    drive.option.num_waypoints = 7
    drive.option.__post_init__()
    with pytest.raises(ValueError, match=r"shape \(1, 10, 2\), expected \(1, 7, 2\)"):
        drive.at((0.0, 0.0))


# the map changes under the plan


@given(st.floats(0.1, 0.5), st.integers(1, 10))
def test_an_obstacle_on_the_remaining_plan_ends_it_and_one_on_the_used_part_does_not(x: float, waypoint: int) -> None:
    drive = Drive()
    drive.at((0.0, 0.0))
    drive.at((x, 0.0))
    line = drive.option.line()
    # narrower than the spacing, so that with the robot's radius it meets this waypoint alone
    drive.map = map_with_pillars([line[0, waypoint]], radius=0.04)
    drive.option.sweep_radius = 0.04
    ahead = waypoint >= nearest_vertex(np.array([[[x, 0.0]]]), line)[0][0, 0]
    assert drive.at((x, 0.0)) == [INVALID if ahead else NONE]


def map_with_wall(x: tuple[float, float], y: tuple[float, float]) -> OccupancyMap:
    """A free map but for an upright box [m]."""
    walled = map_with_pillars()
    center, half = np.array([[sum(x), sum(y)]]) / 2, np.array([[x[1] - x[0], y[1] - y[0]]]) / 2
    draw_boxes(walled.occupied, walled.origin, walled.resolution, center, half)
    return walled


def test_an_obstacle_between_the_robot_and_its_plan_ends_it() -> None:
    drive = Drive()
    drive.at((0.0, 0.0))
    assert drive.at((0.3, 0.29)) == [NONE]
    drive.map = map_with_wall((-3.0, 3.0), (0.1, 0.2))
    drive.planner.silent = True
    assert drive.at((0.3, 0.29)) == [INVALID]


def test_an_obstacle_between_two_waypoints_ends_the_plan() -> None:
    drive = Drive(goal=(2.9, 0.0))
    drive.planner.plan = StraightPlanner(spacing=0.3).plan  # type: ignore[method-assign]
    drive.at((0.0, 0.0))
    assert drive.at((0.06, 0.0)) == [NONE]
    drive.map = map_with_wall((0.4, 0.5), (-3.0, 3.0))
    drive.option.sweep_radius = 0.05
    assert drive.map.is_free(drive.option.plan[0], 0.05).all()
    assert drive.at((0.06, 0.0)) == [INVALID]


@pytest.mark.parametrize("turn", [0.5 * np.pi, 0.75 * np.pi, np.pi])
def test_a_robot_that_touches_an_obstacle_keeps_the_plan_that_leads_away(turn: float) -> None:
    """The map is another one at every step, as where obstacles move."""
    away = 2.5 * np.array([np.cos(turn), np.sin(turn)])
    drive = Drive(goal=away)
    drive.map = map_with_pillars([(0.27, 0.0)])
    assert not drive.map.is_free(np.zeros(2), 0.1)
    assert drive.at((0.0, 0.0)) == [START]
    for _ in range(5):
        drive.map = map_with_pillars([(0.27, 0.0)])
        assert drive.at((0.0, 0.0)) == [NONE]
    assert drive.at(0.06 * away / 2.5) == [NONE]


def test_a_plan_that_is_freed_again_goes_on() -> None:
    drive = Drive()
    drive.at((0.0, 0.0))
    drive.at((0.1, 0.0))
    drive.planner.silent, drive.map = True, map_with_pillars([(0.8, 0.0)])
    assert drive.at((0.1, 0.0)) == [INVALID]
    drive.map = FREE
    assert drive.at((0.1, 0.0)) == [NONE]


def test_where_obstacles_move_a_plan_gets_no_older_than_refresh() -> None:
    drive = Drive()
    drive.option = WaypointOption(drive.planner, 1, refresh=3)
    assert drive.at((0.0, 0.0)) == [START]
    # as long as the map is the one that it was made on, it may get as old as it likes
    assert [drive.at((0.1, 0.0)) for _ in range(4)] == [[NONE]] * 4
    drive.map = map_with_pillars([(0.0, 2.0)])
    assert drive.at((0.1, 0.0)) == [OUTDATED]
    # the new one is of this map
    assert [drive.at((0.1, 0.0)) for _ in range(4)] == [[NONE]] * 4
    reasons = []
    for step in range(7):  # one that moves all the time
        drive.map = map_with_pillars([(0.0, 2.0 - 0.05 * step)])
        reasons += drive.at((0.1, 0.0))
    assert reasons == [OUTDATED, NONE, NONE, OUTDATED, NONE, NONE, OUTDATED]
    assert drive.option.counts[0, OUTDATED] == 4


def test_without_refresh_only_what_is_in_the_way_ends_a_plan() -> None:
    drive = Drive()
    drive.at((0.0, 0.0))
    for step in range(30):
        drive.map = map_with_pillars([(0.0, 2.0 - 0.01 * step)])
        assert drive.at((0.1, 0.0)) == [NONE]


def test_an_outdated_plan_is_followed_until_a_planner_that_works_elsewhere_answers() -> None:
    class Elsewhere:
        def plan(self, query: object) -> None:
            return None

    option, plan = WaypointOption(Elsewhere(), 1, refresh=1), np.linspace([0.1, 0.0], [1.0, 0.0], 10)
    here, goal = np.zeros((1, 2)), np.array([FAR])
    option.step(here, goal, [FREE])
    assert option.adopt(0, plan, here[0], FREE)
    moved = map_with_pillars([(0.0, 2.0)])
    steps = [option.step(here, goal, [moved]) for _ in range(3)]
    assert [TerminationReason(step.reason[0]) for step in steps] == [OUTDATED, NONE, NONE]  # it ends once
    assert_array_equal(steps[-1].plan[0], plan)
    assert option.waiting[0]
    assert option.adopt(0, plan, here[0], moved)
    assert not option.waiting[0]


def test_in_the_paper_s_rule_the_map_does_not_end_a_plan() -> None:
    drive = Drive(rule=ReplanRule(invalid=False))
    drive.at((0.0, 0.0))
    drive.map = map_with_pillars([(0.8, 0.0)])
    assert [drive.at((0.1, 0.0)), drive.at((0.2, 0.0))] == [[NONE], [NONE]]


def test_a_blocked_proposal_is_not_asked_for_again_where_it_was_made() -> None:
    """The straight planner goes through the pillar; asking at every tick would give the same plan."""
    drive = Drive()
    drive.map = map_with_pillars([(0.8, 0.0)])
    assert drive.at((0.0, 0.0)) == [START]
    assert [drive.at((0.0, 0.0)), drive.at((0.04, 0.0))] == [[NONE], [NONE]]
    assert drive.at((0.06, 0.0)) == [INVALID]


def test_the_line_of_an_option_is_its_plan_behind_its_start() -> None:
    drive = Drive(num_rows=2)
    drive.at((0.0, 0.0), (0.3, 0.1))
    assert_array_equal(drive.option.line(), polyline(drive.option.start, drive.option.plan))


def test_an_obstacle_that_comes_while_the_robot_stands_ends_the_plan_at_once() -> None:
    drive = Drive()
    drive.at((0.0, 0.0))
    assert drive.at((0.0, 0.0)) == [NONE]
    drive.map = map_with_pillars((0.8, 0.0))
    assert drive.at((0.0, 0.0)) == [INVALID]


def test_a_plan_for_which_the_last_episode_waited_does_not_hide_the_start_of_the_next() -> None:
    class Elsewhere:
        def plan(self, query: object) -> None:
            return None

    option, here, goal = WaypointOption(Elsewhere(), 1), np.zeros((1, 2)), np.array([FAR])
    for _ in range(2):
        steps = [option.step(here, goal, [FREE]) for _ in range(3)]
        assert [TerminationReason(step.reason[0]) for step in steps] == [START, NONE, NONE]
        option.reset()
        assert not option.waiting[0]


def test_reach_is_counted_from_the_robot_wherever_on_its_map_it_is() -> None:
    drive = Drive(goal=(42.5, 0.0))
    assert drive.at((40.0, 0.0)) == [START]
    assert drive.option.started[0] and drive.option.refused == [0]
    plan, start = drive.option.plan[0] + [0.0, 0.1], np.array([40.0, 0.1])
    assert drive.option.adopt(0, plan, start, FREE)
    assert not drive.option.adopt(0, plan - [40.0, 0.0], start, FREE), "near the origin and far from the robot"


def test_the_place_where_a_robot_waits_for_its_first_plan_is_no_plan_that_is_replaced() -> None:
    drive = Drive()
    drive.planner.silent = True
    drive.at((0.0, 0.0))
    drive.at((0.0, 0.0))
    assert len(drive.planner.queries) == 2 and np.isnan(drive.planner.queries[-1].previous).all()


@pytest.mark.parametrize("far", [10.5, 1e9, np.inf, -1e300])
def test_a_plan_that_leads_out_of_reach_is_refused(far: float) -> None:
    drive = Drive()
    drive.at((0.0, 0.0))
    kept = drive.option.plan.copy()
    drive.planner.plan = lambda query: np.full((1, 10, 2), far)  # type: ignore[method-assign]
    drive.at((0.7, 0.0))
    assert_array_equal(drive.option.plan, kept)
    assert drive.option.refused == [1]
